"""Trials of a certificate: fresh independent scenes at one accepted risk.

Every scene has an outline, a mounting and a gripping of its own. Its seed decides all of them. The
seeds of an attempt follow from the hash of model, bench, method and outlines and from the number of
the attempt, so that nobody can choose them. A scene with an outline on which the piece has no
stable place is drawn again. Every scene counts, whatever its outcome; the bound is that of the
unsafe ones among the releases.

A laboratory uses its own trials instead: runs on its devices whose outcomes a person entered.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from hashlib import sha256
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from touchdown.backend import config, core, geometry
from touchdown.backend.experiments.strategies import uninformed_model
from touchdown.backend.experiments.tables import PIECES, job_code
from touchdown.backend.experiments.trials import FRESH, SceneSetup, stack_in_lockstep
from touchdown.backend.jobs import JobContext, JobSpec, JobStore
from touchdown.backend.learning import use_one_thread
from touchdown.backend.learning.fused import (
    RISK_LIMIT,
    Attempt,
    AttemptLog,
    ReleaseCertificate,
    ReleaseCounts,
    attempt_error,
    certificate_of_attempt,
    load_fused,
    method_sha256,
    releases_needed,
    write_certificate,
)
from touchdown.backend.runs import EVENT_LOG_NAME, read_events
from touchdown.backend.sensing import EpisodeLimits
from touchdown.backend.simulation import Scene

LEAST_SCENES = 3000
SCENES_PER_JOB = 50
SEED_DIGITS = 10  # hexadecimal; beyond the seeds of every other experiment
CONVEX = "convex"  # bottoms of a network that knows convex outlines only
FAMILIES = {
    CONVEX: "convex outlines of 8 to 32 mm",
    FRESH: f"outlines of 14 to 30 mm of the classes {', '.join(geometry.FRESH_CLASSES)}",
}
REDRAW = 10**6  # between the numbers of two outlines of one scene, of the same class


def fresh_scene(
    piece: geometry.Piece, seed: int, bench: config.SimulationSettings, outlines: str
) -> Scene:
    """Return the scene of one seed: an outline of ``FAMILIES``, and an unstable start over it."""
    family = geometry.ShapeFamily.of(geometry.load_pieces())
    for redraw in count():
        if outlines == CONVEX:
            rng = np.random.default_rng([seed, redraw])
            body = family.bottom(rng, free=True)
        else:
            body = geometry.fresh_bottom(
                f"{seed:x}", seed % len(geometry.FRESH_CLASSES) + redraw * REDRAW
            ).body()
        tower = geometry.Tower((body,))
        if geometry.can_be_placed(piece, tower):
            # The piece may stand wherever the faces overlap.
            with suppress(core.InputError):
                start = geometry.draw_start(
                    geometry.start_generator(seed, piece.name, body.name), piece.body(), tower
                )
                return Scene(piece, tower, start, seed, bench)
    raise AssertionError


@dataclass(frozen=True, slots=True)
class Certification:
    """Scenes of one attempt, a third of them with each piece, at every risk of ``risks``.

    ``weights``: checkpoint of the network; ``name``: of the bench.
    """

    bench: config.SimulationSettings
    name: str
    weights: Path
    risks: tuple[float, ...]
    scenes: int = LEAST_SCENES
    code: str = ""

    @property
    def outlines(self) -> str:
        """Family of the bottoms: the test outlines, or convex ones where others are refused."""
        return FRESH if load_fused(self.weights).card.outlines == "any" else CONVEX

    def method(self, risk: float | None = None) -> config.StackSettings:
        """Return the method with the network, at the risk of a level."""
        fused: dict[str, object] = {"weights": str(self.weights)}
        if risk is not None:
            fused["risk"] = risk
        return config.parse_settings(
            config.StackSettings, {"strategy": "fused", "fused": fused}, "--level"
        )

    def begin(self, log: AttemptLog) -> Attempt:
        """Write the attempt to its log, or continue the open one; raises ``InputError``."""
        number = len(log.attempts()) + 1
        planned = Attempt(
            number=number,
            bench=self.name,
            bench_sha256=config.bench_sha256(self.bench),
            weights_sha256=load_fused(self.weights).card.weights_sha256,
            method_sha256=method_sha256(self.method()),
            family=FAMILIES[self.outlines],
            risks=self.risks,
            limit=RISK_LIMIT,
            scenes=self.scenes,
            date=datetime.now(UTC),
            sources=job_code("certify", self.code),
            program_version=core.program_version(),
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

    def counts(self, attempt: Attempt, store: JobStore) -> list[ReleaseCounts]:
        """Return the counts of each risk; none while a job is missing."""
        jobs = self.jobs(attempt)
        if not all(store.has(job.id) for job in jobs):
            return []
        found = []
        for level, risk in enumerate(self.risks):
            trials = [t for job in jobs[level :: len(self.risks)] for t in _trials(store, job)]
            released = [t["outcome"] for t in trials if t["released"]]
            placed = released.count(core.Outcome.PLACED.value)
            toppled = [t["outcome"] for t in trials if not t["released"]]
            found.append(
                ReleaseCounts.of(
                    risk,
                    attempt.error,
                    scenes=len(trials),
                    placed=placed,
                    unsafe=len(released) - placed,
                    toppled=toppled.count(core.Outcome.KNOCKED_OVER.value),
                )
            )
        return found


def _trials(store: JobStore, job: JobSpec) -> Sequence[Mapping[str, Any]]:
    trials: Sequence[Mapping[str, Any]] = store.result(job.id)["trials"]
    return trials


def run_certified_scenes(spec: JobSpec, place: JobContext) -> Mapping[str, Any]:
    """Run one trial per seed; every trial counts."""
    p = spec.params
    use_one_thread()
    piece = geometry.load_pieces().top(p["piece"])
    bench = config.parse_settings(config.SimulationSettings, p["bench"], "job")
    method = config.parse_settings(config.StackSettings, p["method"], "job")
    if load_fused(Path(method.fused.weights)).card.weights_sha256 != p["fused_sha256"]:
        what = "The network changed since the attempt began."
        fix = "Restore it; the attempt is spent otherwise."
        raise core.InputError(what, method.fused.weights, fix)
    seeds = range(spec.seed, spec.seed + p["trials"])
    scenes = [fresh_scene(piece, seed, bench, p["outlines"]) for seed in seeds]
    model = uninformed_model(SceneSetup(piece, (), bench))
    results = stack_in_lockstep(scenes, model, method, EpisodeLimits())
    # A release over a bottom that a press toppled is unsafe, whatever became of the piece.
    ends = [(end, bool(end.steps) and end.steps[-1].action.kind == "release") for end in results]
    trials = [{**end.as_json(), "released": released} for end, released in ends]
    return {"bench_sha256": config.bench_sha256(bench), "trials": trials}


LABORATORY_LIMIT = 0.05  # default bound of a certificate of a laboratory's own trials
LABORATORY_NAME = "release-risk"


@dataclass(frozen=True, slots=True)
class LabelledTrial:
    """Trial of a laboratory: ``released`` once the jaws opened, and the outcome a person entered.

    ``outcome`` is None if the run ended before it was entered. ``about``: the part ``release`` of
    the run's record.
    """

    name: str
    piece: str
    bottom: str
    released: bool
    outcome: core.Outcome | None
    about: Mapping[str, Any]

    @property
    def unsafe(self) -> bool:
        """True for a release without a piece that stands; a void or missing outcome is one."""
        return self.released and self.outcome is not core.Outcome.PLACED


def labelled_trials(folder: Path) -> Iterator[LabelledTrial]:
    """Yield the trials of ``fused`` on devices in the runs of a folder, oldest first.

    Runs on a simulated or emulated bench, and those of a program that did not record what a
    certificate needs, have none. Raises ``InputError`` for a damaged log.
    """
    for log in sorted(folder.rglob(EVENT_LOG_NAME)):
        yield from _trials_of(log)


def _trials_of(log: Path) -> Iterator[LabelledTrial]:
    head: core.RunStarted | None = None
    about: Mapping[str, Any] = {}
    trial, released = 0, False

    def ended(outcome: core.Outcome | None) -> LabelledTrial:
        assert head is not None
        name = f"{head.run_id} {trial}"
        return LabelledTrial(name, head.piece, head.bottom, released, outcome, about)

    for event in read_events(log):
        if isinstance(event, core.RunStarted):
            head, about = event, json.loads(event.settings).get("release") or {}
            if event.simulated or not about.get("bench_sha256") or about["weighed"]:
                return
        elif isinstance(event, core.TrialStarted):
            trial, released = event.trial, False
        elif isinstance(event, core.PhaseEntered) and event.phase == "release":
            released = True
        elif isinstance(event, core.TrialFinished):
            yield ended(event.outcome)
            trial = 0
    if trial and released:
        yield ended(None)


@dataclass(frozen=True, slots=True)
class LaboratoryRisk:
    """Result of ``certify_laboratory``: the attempt, and the certificate if its bound holds."""

    attempt: Attempt
    certificate: ReleaseCertificate | None
    path: Path | None
    left_out: Mapping[str, int]


def certify_laboratory(
    trials: Sequence[LabelledTrial], bench: config.BenchIdentity, limit: float = LABORATORY_LIMIT
) -> LaboratoryRisk:
    """Bound the unsafe releases on a laboratory's bench from its own trials.

    The trials are those of the newest run's model, risk and settings that no earlier attempt used.
    They count as independent: each is set up and handed over anew. Their number must not depend on
    their outcomes.

    Parameters
    ----------
    trials : sequence of LabelledTrial
        Trials in order of time.
    bench : BenchIdentity
        Bench of the laboratory, with the folder of its calibrations.
    limit : float, default: 0.05
        Largest bound of a certificate.

    Returns
    -------
    LaboratoryRisk
        The attempt with its counts, and the certificate.

    Raises
    ------
    InputError
        If there are too few releases for ``limit``, before an attempt is spent.

    """
    assert bench.calibrations is not None
    log = AttemptLog(bench.calibrations / f"{LABORATORY_NAME}.attempts.jsonl")
    attempts = log.attempts()
    open_one = attempts[-1] if attempts and attempts[-1].state == "begun" else None
    used = {name for a in attempts if a.state == "ended" for name in a.trials}
    here = [t for t in trials if t.about["bench_sha256"] == bench.sha256]
    if open_one is not None:  # a crash interrupted it: finish it with its own trials
        here = [t for t in here if t.name in open_one.trials]
    newest = _settings_of(here[-1]) if here else None
    own = [t for t in here if _settings_of(t) == newest and t.name not in used]
    left_out = Counter(
        "of another bench" if t.about["bench_sha256"] != bench.sha256
        else "of an earlier attempt" if t.name in used
        else "of another model or method" if open_one is None else "for the next attempt"
        for t in trials if t not in own
    )  # fmt: skip
    released = [t for t in own if t.released]
    number = len(attempts) + (open_one is None)
    needed = releases_needed(limit, attempt_error(number))
    if newest is None or len(released) < needed:
        others = "".join(f" {n} trials are {why}." for why, n in sorted(left_out.items()))
        raise core.InputError(
            f"{len(released)} releases with an outcome cannot show at most {100 * limit:g} %: "
            f"attempt {number} needs {needed}, none of them unsafe.{others}",
            bench.name,
            "Run 'touchdown stack' with --strategy fused on this bench, and enter each outcome.",
        )
    weights, method, risk = newest
    bottoms = sorted({t.bottom for t in released})
    attempt = open_one or log.begin(
        Attempt(
            number=number,
            bench=bench.name,
            bench_sha256=bench.sha256,
            weights_sha256=weights,
            method_sha256=method,
            family=", ".join(bottoms),
            risks=(risk,),
            limit=limit,
            scenes=len(own),
            trials=tuple(t.name for t in own),
            date=datetime.now(UTC),
            program_version=core.program_version(),
        )
    )
    unsafe = sum(t.unsafe for t in released)
    placed = len(released) - unsafe
    counts = ReleaseCounts.of(
        risk, attempt.error, scenes=len(own), placed=placed, unsafe=unsafe, toppled=0
    )
    attempt = log.closed(attempt, [counts])
    pieces = sorted({t.piece for t in released})
    found = certificate_of_attempt(attempt, simulated=False, pieces=pieces, bottoms=bottoms)
    path = None if found is None else write_certificate(bench.calibrations, LABORATORY_NAME, found)
    log.append(attempt)
    return LaboratoryRisk(attempt, found, path, left_out)


def _settings_of(trial: LabelledTrial) -> tuple[str, str, float]:
    about = trial.about
    return about["weights_sha256"], about["method_sha256"], float(about["risk"])
