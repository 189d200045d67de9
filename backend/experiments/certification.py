"""Trials of a certificate: fresh independent scenes at one accepted risk.

Every scene has an outline, a mounting and a gripping of its own. Its seed decides all of them. The
seeds of an attempt follow from the hash of model, bench, method and outlines and from the number of
the attempt, so that nobody can choose them. A scene with an outline on which the piece has no
stable place is drawn again. Every scene counts, whatever its outcome; the bound is that of the
unsafe ones among the releases.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from hashlib import sha256
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from touchdown.backend.config import SimulationSettings, StackSettings, bench_sha256, parse_settings
from touchdown.backend.core import InputError, Outcome
from touchdown.backend.experiments.results import program_version
from touchdown.backend.experiments.strategies import uninformed_model
from touchdown.backend.experiments.tables import PIECES, job_code
from touchdown.backend.experiments.trials import (
    FRESH,
    MixedBottomLockstep,
    SceneSetup,
    stack_in_lockstep,
)
from touchdown.backend.geometry import (
    FRESH_CLASSES,
    Piece,
    ShapeFamily,
    Tower,
    can_be_placed,
    draw_start,
    fresh_bottom,
    load_pieces,
    start_generator,
)
from touchdown.backend.jobs import JobContext, JobSpec, JobStore
from touchdown.backend.learning import use_one_thread
from touchdown.backend.learning.fused import (
    RISK_LIMIT,
    Attempt,
    AttemptLog,
    ReleaseCounts,
    load_fused,
    method_sha256,
)
from touchdown.backend.sensing import EpisodeLimits
from touchdown.backend.simulation import Scene

LEAST_SCENES = 3000
SCENES_PER_JOB = 50
SEED_DIGITS = 10  # hexadecimal; beyond the seeds of every other experiment
CONVEX = "convex"  # bottoms of a network that knows convex outlines only
FAMILIES = {
    CONVEX: "convex outlines of 8 to 32 mm",
    FRESH: f"outlines of 14 to 30 mm of the classes {', '.join(FRESH_CLASSES)}",
}
REDRAW = 10**6  # between the numbers of two outlines of one scene, of the same class


def fresh_scene(piece: Piece, seed: int, bench: SimulationSettings, outlines: str) -> Scene:
    """Return the scene of one seed: an outline of ``FAMILIES``, and an unstable start over it."""
    family = ShapeFamily.of(load_pieces())
    for redraw in count():
        if outlines == CONVEX:
            rng = np.random.default_rng([seed, redraw])
            body = family.bottom(rng, free=True)
        else:
            body = fresh_bottom(f"{seed:x}", seed % len(FRESH_CLASSES) + redraw * REDRAW).body()
        tower = Tower((body,))
        if can_be_placed(piece, tower):
            # The piece may stand wherever the faces overlap.
            with suppress(InputError):
                start = draw_start(
                    start_generator(seed, piece.name, body.name), piece.body(), tower
                )
                return Scene(piece, tower, start, seed, bench)
    raise AssertionError


@dataclass(frozen=True, slots=True)
class Certification:
    """Scenes of one attempt, a third of them with each piece, at every risk of ``risks``.

    ``weights``: checkpoint of the network; ``name``: of the bench.
    """

    bench: SimulationSettings
    name: str
    weights: Path
    risks: tuple[float, ...]
    scenes: int = LEAST_SCENES
    code: str = ""

    @property
    def outlines(self) -> str:
        """Family of the bottoms: the test outlines, or convex ones where others are refused."""
        return FRESH if load_fused(self.weights).card.outlines == "any" else CONVEX

    def method(self, risk: float | None = None) -> StackSettings:
        """Return the method with the network, at the risk of a level."""
        fused: dict[str, object] = {"weights": str(self.weights)}
        if risk is not None:
            fused["risk"] = risk
        return parse_settings(StackSettings, {"strategy": "fused", "fused": fused}, "--level")

    def begin(self, log: AttemptLog) -> Attempt:
        """Write the attempt to its log, or continue the open one; raises ``InputError``."""
        number = len(log.attempts()) + 1
        planned = Attempt(
            number=number,
            bench=self.name,
            bench_sha256=bench_sha256(self.bench),
            weights_sha256=load_fused(self.weights).card.weights_sha256,
            method_sha256=method_sha256(self.method()),
            family=FAMILIES[self.outlines],
            risks=self.risks,
            limit=RISK_LIMIT,
            scenes=self.scenes,
            date=datetime.now(UTC),
            sources=job_code("certify", self.code),
            program_version=program_version(),
        )
        told = f"{planned.plan()} {number}".encode()
        seed = int(sha256(told).hexdigest()[:SEED_DIGITS], 16)
        return log.begin(planned.model_copy(update={"seed": seed}))

    def jobs(self, attempt: Attempt) -> list[JobSpec]:
        """Return the jobs of an attempt; each risk has seeds of its own."""
        return [
            self._job(attempt, level, first)
            for first in range(0, self.scenes, SCENES_PER_JOB)
            for level in range(len(self.risks))
        ]

    def _job(self, attempt: Attempt, level: int, first: int) -> JobSpec:
        params = {
            "bench": self.bench.model_dump(mode="json"),
            "method": self.method(self.risks[level]).model_dump(mode="json"),
            "fused_sha256": attempt.weights_sha256,
            "outlines": self.outlines,
            "piece": PIECES[first // SCENES_PER_JOB % len(PIECES)],
            "trials": min(SCENES_PER_JOB, self.scenes - first),
        }
        seed = attempt.seed + level * self.scenes + first
        return JobSpec("certify", params, seed, (), attempt.sources)

    @staticmethod
    def effort(spec: JobSpec) -> int:
        """Return the relative duration of a job."""
        return int(spec.params["trials"])

    def counts(self, attempt: Attempt, store: JobStore) -> list[ReleaseCounts]:
        """Return the counts of each risk; none while a job is missing."""
        jobs = self.jobs(attempt)
        if not all(store.has(job.id) for job in jobs):
            return []
        found = []
        for level, risk in enumerate(self.risks):
            trials = [t for job in jobs[level :: len(self.risks)] for t in _trials(store, job)]
            words = Counter(t["outcome"] for t in trials)
            found.append(
                ReleaseCounts.of(
                    risk,
                    attempt.error,
                    scenes=len(trials),
                    placed=words[Outcome.PLACED.value],
                    unsafe=words[Outcome.FELL.value],
                    toppled=words[Outcome.KNOCKED_OVER.value],
                )
            )
        return found

    def by_piece(self, attempt: Attempt, store: JobStore) -> list[dict[str, Any]]:
        """Return the outcomes of all finished scenes by risk and piece."""
        rows: dict[tuple[float, str], Counter[str]] = {}
        for job in self.jobs(attempt):
            if store.has(job.id):
                key = job.params["method"]["fused"]["risk"], job.params["piece"]
                rows.setdefault(key, Counter()).update(t["outcome"] for t in _trials(store, job))
        return [
            {"risk": risk, "piece": piece, "scenes": words.total(), "outcomes": dict(words)}
            for (risk, piece), words in sorted(rows.items())
        ]


def _trials(store: JobStore, job: JobSpec) -> Sequence[Mapping[str, Any]]:
    trials: Sequence[Mapping[str, Any]] = store.result(job.id)["trials"]
    return trials


def run_certified_scenes(spec: JobSpec, place: JobContext) -> Mapping[str, Any]:
    """Run one trial per seed; every trial counts."""
    p = spec.params
    use_one_thread()
    piece = load_pieces().top(p["piece"])
    bench = parse_settings(SimulationSettings, p["bench"], "job")
    method = parse_settings(StackSettings, p["method"], "job")
    if load_fused(Path(method.fused.weights)).card.weights_sha256 != p["fused_sha256"]:
        raise InputError(
            "The network changed since the attempt began.",
            method.fused.weights,
            "Restore it; the attempt is spent otherwise.",
        )
    seeds = range(spec.seed, spec.seed + p["trials"])
    scenes = [fresh_scene(piece, seed, bench, p["outlines"]) for seed in seeds]
    model = uninformed_model(SceneSetup(piece, (), bench))
    results = stack_in_lockstep(scenes, model, method, EpisodeLimits(), world=MixedBottomLockstep)
    return {"bench_sha256": bench_sha256(bench), "trials": [end.as_json() for end in results]}
