"""Two labellers compared over the episodes that both answered."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean, median

import numpy as np

from backend.catalogue import agreement
from backend.catalogue.agreement import Bias
from backend.catalogue.database import Database
from backend.catalogue.geometry import GeometryStore
from backend.catalogue.values import Label, Verdict

PAUSE_MS = 60_000
"""A longer look is a pause, and counts as this much at most."""


@dataclass(frozen=True, slots=True)
class Answer:
    """What one person last said of one episode."""

    episode: str
    geometry: str
    label: Label
    verdict: Verdict | None
    seen_ms: int | None
    blind: bool


@dataclass(frozen=True, slots=True)
class Comparison:
    """Figures of the first person minus the second; NaN where there is too little.

    ``drift_mm`` (x, y): mean difference in the later half minus that in the earlier one.
    ``seconds``: median time of each per answer, where it was measured.
    """

    episodes: int
    bias_x_mm: Bias
    bias_y_mm: Bias
    rms_mm: float
    icc_x: float
    icc_y: float
    patch_iou: float
    kappa: float
    alpha: float
    drift_mm: tuple[float, float]
    seconds: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Sway:
    """What a suggestion in sight does: answers made blind minus those made with it shown."""

    episodes: int
    x_mm: Bias
    y_mm: Bias


def sway(database: Database, people: Sequence[str]) -> Sway:
    """Return blind minus shown over the episodes that were answered both ways, by whomever."""
    blind: dict[str, Label] = {}
    shown: dict[str, Label] = {}
    for person in people:
        for kind, found in ((True, blind), (False, shown)):
            given = answers(database, person, blind=kind).items()
            found.update((uuid, answer.label) for uuid, answer in given if answer.label.is_set)
    both = [uuid for uuid in blind if uuid in shown]
    a = np.array([blind[u].offset_mm for u in both], dtype=np.float64).reshape(-1, 2)
    b = np.array([shown[u].offset_mm for u in both], dtype=np.float64).reshape(-1, 2)
    return Sway(len(both), agreement.bias(a[:, 0], b[:, 0]), agreement.bias(a[:, 1], b[:, 1]))


def answers(database: Database, person: str, *, blind: bool | None = None) -> dict[str, Answer]:
    """Return the last answer of ``person`` for each episode: set, accepted, or an opinion.

    ``blind``: only those known to be made without (True) or with (False) a suggestion in sight.
    """
    sql = """
    SELECT episode, geometry, x_um, y_um, theta_mdeg, sigma_um, verdict,
        json_extract(body, '$.seen_ms'), json_extract(body, '$.blind')
    FROM (
        SELECT r.episode, r.geometry, r.x_um, r.y_um, r.theta_mdeg, r.sigma_um, r.verdict, o.body,
            o.lamport, o.seq FROM op o JOIN label_rev r USING (op_uuid)
        WHERE o.actor = ? AND o.verb IN ('label.set', 'label.accept_next')
        UNION ALL
        SELECT p.episode, h.geometry, p.x_um, p.y_um, p.theta_mdeg, p.sigma_um, p.verdict, o.body,
            o.lamport, o.seq FROM op o JOIN opinion p USING (op_uuid)
        JOIN label_head l ON l.episode = p.episode JOIN label_rev h ON h.rev_uuid = l.rev_uuid
        WHERE o.actor = ?
    ) ORDER BY lamport, seq
    """
    found: dict[str, Answer] = {}
    for row in database.rows(sql, (person, person)):
        episode, geometry, *label, verdict, seen_ms, hidden = row
        if blind is not None and (hidden is None or bool(hidden) is not blind):
            continue
        # The last one counts, and stands where it was given.
        found.pop(episode, None)
        found[episode] = Answer(episode, geometry, Label(*label), verdict, seen_ms, bool(hidden))
    return found


def compare(database: Database, geometry: GeometryStore, first: str, second: str) -> Comparison:
    """Return the figures of agreement of two persons."""
    return _compared(geometry, answers(database, first), answers(database, second))


def against_gold(database: Database, geometry: GeometryStore, person: str) -> Comparison:
    """Return how the opinions of ``person`` compare with the approved labels of these episodes.

    Of the times only the person's are known. An opinion without displacement counts among the
    episodes and in no other figure.
    """
    sql = """
    SELECT p.episode, r.geometry, p.x_um, p.y_um, p.theta_mdeg, p.sigma_um, p.verdict,
        json_extract(o.body, '$.seen_ms'), r.x_um, r.y_um, r.theta_mdeg, r.sigma_um, r.verdict
    FROM opinion p JOIN op o USING (op_uuid) JOIN label_head h ON h.episode = p.episode
    JOIN label_rev r ON r.rev_uuid = h.counting
    WHERE o.actor = ? AND instr(h.authors, ?) = 0 ORDER BY o.lamport, o.seq
    """
    said, gold = dict[str, Answer](), dict[str, Answer]()
    for row in database.rows(sql, (person, f"\n{person}\n")):
        episode, record, *label, verdict, seen_ms, x, y, theta, sigma, approved = row
        # The last one counts, and stands where it was given.
        said.pop(episode, None)
        said[episode] = Answer(episode, record, Label(*label), verdict, seen_ms, blind=True)
        gold[episode] = Answer(episode, record, Label(x, y, theta, sigma), approved, None, False)
    return _compared(geometry, said, gold)


def _compared(
    geometry: GeometryStore, one: dict[str, Answer], two: dict[str, Answer]
) -> Comparison:
    """Return the figures of the answers ``one`` minus ``two``."""
    both = [uuid for uuid in one if uuid in two]
    pairs = [(one[u], two[u]) for u in both if one[u].label.is_set and two[u].label.is_set]
    a = np.array([x.label.offset_mm for x, _ in pairs], dtype=np.float64).reshape(-1, 2)
    b = np.array([y.label.offset_mm for _, y in pairs], dtype=np.float64).reshape(-1, 2)
    said = [(one[u].verdict, two[u].verdict) for u in both]
    named = [(x, y) for x, y in said if x is not None and y is not None]
    overlaps = [_overlap(geometry, x, y) for x, y in pairs]
    return Comparison(
        episodes=len(both),
        bias_x_mm=agreement.bias(a[:, 0], b[:, 0]),
        bias_y_mm=agreement.bias(a[:, 1], b[:, 1]),
        rms_mm=agreement.rms_mm(a, b),
        icc_x=agreement.icc(np.stack([a[:, 0], b[:, 0]], axis=1)),
        icc_y=agreement.icc(np.stack([a[:, 1], b[:, 1]], axis=1)),
        patch_iou=fmean(overlaps) if overlaps else math.nan,
        kappa=agreement.kappa([x for x, _ in named], [y for _, y in named]),
        alpha=agreement.alpha(named),
        drift_mm=_drift(a - b),
        seconds=(_seconds(one), _seconds(two)),
    )


def _overlap(geometry: GeometryStore, one: Answer, two: Answer) -> float:
    first = geometry.patch(two.geometry, one.label).touching
    return agreement.patch_iou(first, geometry.patch(two.geometry, two.label).touching)


def _drift(difference: agreement.Floats) -> tuple[float, float]:
    half = len(difference) // 2
    if not half:
        return math.nan, math.nan
    x, y = difference[half:].mean(axis=0) - difference[:half].mean(axis=0)
    return float(x), float(y)


def _seconds(given: dict[str, Answer]) -> float:
    times = [min(a.seen_ms, PAUSE_MS) / 1e3 for a in given.values() if a.seen_ms is not None]
    return median(times) if times else math.nan
