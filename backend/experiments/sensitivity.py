"""How much each nuisance of the bench costs: one at a time, from nothing to three times its size.

Every factor is asked on the same seeds, so that differences are paired by group.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from backend.config.bench_facts import bench_sha256
from backend.config.simulation import SimulationSettings
from backend.experiments.asking import Place, presses_jobs, trials_jobs
from backend.experiments.beyond import counted
from backend.experiments.elsewhere import interval, press_figures
from backend.experiments.nuisances import FACTORS, NUISANCES, Nuisance, scaled
from backend.experiments.paired import iou_change, signed
from backend.jobs.spec import JobSpec
from backend.jobs.store import JobStore

FORMAT = "touchdown-sensitivity/1"
Json = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Sensitivity:
    """What to ask. ``model``: job or file it comes from; ``groups`` and ``trials`` per bottom."""

    bench: SimulationSettings
    code: str
    piece: str
    model: str
    bottoms: tuple[str, ...] = ("short", "long")
    strategy: str = "paper"
    groups: int = 20
    trials: int = 0
    nuisances: tuple[Nuisance, ...] = NUISANCES

    def jobs(self) -> list[JobSpec]:
        """Return every job once; the ends of the range come before what lies between."""
        order = sorted(FACTORS, key=lambda factor: (factor != 1.0, factor not in FACTORS[::4]))
        found: dict[str, JobSpec] = {}
        for factor in order:
            for nuisance in self.nuisances:
                for jobs in self._cell(nuisance, factor):
                    found |= {spec.id: spec for spec in jobs}
        return list(found.values())

    def answer(self, store: JobStore) -> Json:
        """Return what is finished: for each nuisance a row per factor."""
        return {
            "format": FORMAT,
            "simulated": True,
            "bench_sha256": bench_sha256(self.bench),
            "code": self.code,
            "piece": self.piece,
            "bottoms": list(self.bottoms),
            "model": self.model,
            "strategy": self.strategy,
            "nuisances": [
                {
                    "name": nuisance.name,
                    "title": nuisance.title,
                    "keys": list(nuisance.keys),
                    "limit": nuisance.limit,
                    "at": list(self._rows(nuisance, store)),
                }
                for nuisance in self.nuisances
            ],
        }

    def _rows(self, nuisance: Nuisance, store: JobStore) -> Iterator[Json]:
        reference, _ = self._cell(nuisance, 1.0)
        for factor in FACTORS:
            asked, tried = self._cell(nuisance, factor)
            presses, trials = _done(asked, store), _done(tried, store)
            if not presses:
                continue
            row: Json = {"factor": factor, **press_figures(presses, _MODEL)}
            both = [
                (a.params["bottom"], (store.result(a.id), store.result(b.id)))
                for a, b in zip(reference, asked, strict=True)
                if store.has(a.id) and store.has(b.id)
            ]
            row["iou_change"] = iou_change([pair for _, pair in both], _MODEL, _MODEL)
            row["iou_change_on"] = {
                bottom: iou_change([pair for on, pair in both if on == bottom], _MODEL, _MODEL)
                for bottom in self.bottoms
            }
            if trials:
                row["trials"] = counted([trial for part in trials for trial in part["trials"]])
            yield row

    def _cell(self, nuisance: Nuisance, factor: float) -> tuple[list[JobSpec], list[JobSpec]]:
        # At the bench's own size it is the bench itself, whichever nuisance is meant.
        bench = self.bench if factor == 1.0 else scaled(self.bench, nuisance, factor)
        place = Place("bench", bench)
        presses: list[JobSpec] = []
        trials: list[JobSpec] = []
        for bottom in self.bottoms:
            pair = (self.piece, bottom)
            presses += presses_jobs(place, pair, {_MODEL: self.model}, self.groups, self.code)
            strategy = (self.strategy, self.model)
            trials += trials_jobs(place, pair, strategy, self.trials, self.code)
        return presses, trials


_MODEL = "FT+Tac"


def sensitivity_rows(answer: Json) -> list[tuple[str, ...]]:
    """Return per nuisance its change of IoU at each factor, and stability right at the ends."""
    rows = []
    for nuisance in answer["nuisances"]:
        at = {row["factor"]: row for row in nuisance["at"]}
        changes = [signed(at.get(factor, {}).get("iou_change")) for factor in FACTORS]
        right = [
            interval(at[f]["stable_1"]["accuracy"]) if f in at else "" for f in (0.0, 1.0, 3.0)
        ]
        rows.append((nuisance["title"], *changes[:2], *changes[3:], *right))
    return rows


def _done(jobs: Sequence[JobSpec], store: JobStore) -> list[Mapping[str, Any]]:
    return [store.result(spec.id) for spec in jobs if store.has(spec.id)]
