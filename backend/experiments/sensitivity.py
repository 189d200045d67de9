"""Sensitivity of a model to each nuisance of the bench, scaled one at a time from 0 to 3.

All factors use the same seeds, so differences are paired by group. The report shows one small chart
per nuisance above the table of changes.
"""

from __future__ import annotations

import html
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from touchdown.backend.config import SimulationSettings, bench_sha256
from touchdown.backend.experiments.document import (
    BLUE,
    FAINT,
    INK,
    ORANGE,
    PictureGallery,
    Report,
    ReportPicture,
    ReportSection,
    ReportTable,
)
from touchdown.backend.experiments.domain_shift import (
    format_interval,
    iou_of,
    press_scores,
    stability_of,
)
from touchdown.backend.experiments.evaluation import (
    FACTORS,
    NUISANCES,
    EvaluationBench,
    Nuisance,
    press_jobs,
    scale_nuisance,
    trial_jobs,
)
from touchdown.backend.experiments.statistics import format_change, iou_change
from touchdown.backend.experiments.strategies import count_outcomes
from touchdown.backend.jobs import JobSpec, JobStore

FORMAT = "touchdown-sensitivity/1"
Json = dict[str, Any]
JsonMapping = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class NuisanceSensitivity:
    """Sensitivity analysis of ``model`` (a job or file); ``groups`` and ``trials`` per bottom."""

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
        """Return every job once; the ends of the range come first."""
        order = sorted(FACTORS, key=lambda factor: (factor != 1.0, factor not in FACTORS[::4]))
        found: dict[str, JobSpec] = {}
        for factor in order:
            for nuisance in self.nuisances:
                for jobs in self._cell(nuisance, factor):
                    found |= {spec.id: spec for spec in jobs}
        return list(found.values())

    def answer(self, store: JobStore) -> Json:
        """Return the finished results: one row per nuisance and factor."""
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
            press_specs, trial_specs = self._cell(nuisance, factor)
            presses = _finished_results(press_specs, store)
            trials = _finished_results(trial_specs, store)
            if not presses:
                continue
            row: Json = {"factor": factor, **press_scores(presses, _MODEL)}
            both = [
                (a.params["bottom"], (store.result(a.id), store.result(b.id)))
                for a, b in zip(reference, press_specs, strict=True)
                if store.has(a.id) and store.has(b.id)
            ]
            row["iou_change"] = iou_change([pair for _, pair in both], _MODEL, _MODEL)
            row["iou_change_on"] = {
                bottom: iou_change([pair for on, pair in both if on == bottom], _MODEL, _MODEL)
                for bottom in self.bottoms
            }
            if trials:
                row["trials"] = count_outcomes([t for part in trials for t in part["trials"]])
            yield row

    def _cell(self, nuisance: Nuisance, factor: float) -> tuple[list[JobSpec], list[JobSpec]]:
        place = EvaluationBench("bench", scale_nuisance(self.bench, nuisance, factor))
        presses: list[JobSpec] = []
        trials: list[JobSpec] = []
        for bottom in self.bottoms:
            pair = (self.piece, bottom)
            presses += press_jobs(place, pair, {_MODEL: self.model}, self.groups, self.code)
            strategy = (self.strategy, self.model)
            trials += trial_jobs(place, pair, strategy, self.trials, self.code)
        return presses, trials


_MODEL = "FT+Tac"


def sensitivity_table(answer: JsonMapping) -> ReportTable:
    """Return the change of IoU at each factor and stability at both ends, by nuisance."""
    rows = []
    for nuisance in answer["nuisances"]:
        at = {row["factor"]: row for row in nuisance["at"]}
        changes = [format_change(at.get(factor, {}).get("iou_change")) for factor in FACTORS]
        right = [
            format_interval(at[f]["stable_1"]["accuracy"]) if f in at else ""
            for f in (0.0, 1.0, 3.0)
        ]
        rows.append((nuisance["title"], *changes[:2], *changes[3:], *right))
    header = ("nuisance", "0", "0.5", "2", "3", "stable right, 0", "1", "3")
    title = "Change of the IoU in points, paired by group; stability right, %"
    return ReportTable.of_texts(title, header, rows)


def _finished_results(jobs: Sequence[JobSpec], store: JobStore) -> list[Mapping[str, Any]]:
    return [store.result(spec.id) for spec in jobs if store.has(spec.id)]


WIDE, TALL, LEFT, BOTTOM, TOP = 260, 190, 34, 34, 30
LOW, HIGH = 0.3, 1.0  # range of the vertical axis


def sensitivity_report(answer: JsonMapping) -> Report:
    """Return the report: one chart per nuisance, and the table of changes."""
    about = (
        f"{answer['piece'].title()} on {' and '.join(answer['bottoms'])}, one model as it is, "
        f"bench {answer['bench_sha256'][:16]}, program {answer['code']}. Each nuisance alone is 0 "
        "to 3 times as large as on the bench; all else, seeds included, stays. Blue line with "
        "dots: IoU of single presses. Orange dashed line with squares: stability right after one "
        "press, on as many stable as unstable places. Bars: 95 % intervals, each value for "
        "itself. Values of one chart share their presses, so that small changes mean more than "
        "the bars say: see the table."
    )
    charts = tuple(ReportPicture(_chart(n)) for n in answer["nuisances"] if n["at"])
    parts = (PictureGallery("", charts), sensitivity_table(answer))
    title = "Touchdown: sensitivity to each nuisance of the bench"
    return Report(title, (about,), (ReportSection("", (), parts),))


def _chart(nuisance: JsonMapping) -> str:
    rows: Sequence[JsonMapping] = nuisance["at"]
    parts = [_axes()]
    for get, colour, square in ((iou_of, BLUE, False), (stability_of, ORANGE, True)):
        at = [(row["factor"], get(row)) for row in rows if get(row)["value"] is not None]
        line = " ".join(f"{_x(f):.1f},{_y(e['value']):.1f}" for f, e in at)
        dash = ' stroke-dasharray="5 3"' if square else ""
        parts.append(f'<polyline points="{line}" fill="none" stroke="{colour}"{dash}/>')
        parts += [_mark(_x(factor), estimate, colour, square=square) for factor, estimate in at]
    limit = f"draws end at {nuisance['limit']}" if nuisance["limit"] else ""
    parts.append(_text(WIDE / 2, 14, nuisance["title"], 11))
    parts.append(_text(WIDE / 2, 25, limit, 8))
    title = html.escape(nuisance["title"])
    return (
        f'<svg viewBox="0 0 {WIDE} {TALL}" width="{WIDE}" height="{TALL}" role="img" '
        f'aria-label="{title}">{"".join(parts)}</svg>'
    )


def _axes() -> str:
    parts = []
    for share in (0.4, 0.6, 0.8, 1.0):
        y = _y(share)
        parts.append(f'<path d="M{LEFT} {y:.1f}H{WIDE - 10}" stroke="{FAINT}" stroke-width=".7"/>')
        parts.append(_text(LEFT - 12, y + 3, f"{100 * share:.0f}", 9))
    for factor in FACTORS:
        parts.append(_text(_x(factor), TALL - BOTTOM + 16, f"{factor:g}", 9))
    now = _x(1.0)
    parts.append(
        f'<path d="M{now:.1f} {TOP}V{TALL - BOTTOM}" stroke="{FAINT}" stroke-dasharray="2 3"/>'
    )
    parts.append(_text(WIDE / 2, TALL - 6, "times its size on the bench; %", 9))
    return "".join(parts)


def _mark(x: float, estimate: JsonMapping, colour: str, *, square: bool) -> str:
    y, low, high = (_y(estimate[key]) for key in ("value", "low", "high"))
    x += 2.0 if square else -2.0
    bar = f'<path d="M{x:.1f} {low:.1f}V{high:.1f}" stroke="{colour}" stroke-opacity=".45"/>'
    if square:
        return (
            bar
            + f'<rect x="{x - 2.5:.1f}" y="{y - 2.5:.1f}" width="5" height="5" fill="{colour}"/>'
        )
    return bar + f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.8" fill="{colour}"/>'


def _x(factor: float) -> float:
    return LEFT + 12 + (WIDE - LEFT - 34) * factor / FACTORS[-1]


def _y(share: float) -> float:
    within = min(max(share, LOW), HIGH)
    return TALL - BOTTOM - (TALL - BOTTOM - TOP) * (within - LOW) / (HIGH - LOW)


def _text(x: float, y: float, text: str, size: int) -> str:
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}" text-anchor="middle" '
        f'fill="{INK}">{html.escape(text)}</text>'
    )
