"""Scores of one pair from its groups: Table 1, Table 2 and the reliability of the fused map."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from backend.config.method import BeliefSettings, StabilitySettings
from backend.core.flow import ContactPatch, FloatArray
from backend.experiments.calibration import reliability
from backend.experiments.closed_loop import Model
from backend.experiments.scenes import Case
from backend.experiments.statics import Groups
from backend.learning.metrics import LEVEL
from backend.placement.belief import Belief
from backend.placement.stability import judge

FUSED = (1, 2, 3, 5)
RELIABLE_AFTER = 3
DIGITS = 4


def patch_scores(probability: FloatArray, groups: Groups) -> dict[str, list[float]]:
    """Return for each group the mean IoU and point accuracy of its random probes.

    ``probability`` (g, p, N). The first probe is that of a balanced sample and does not count.
    ``..._true``: against the real patch in place of the label.
    """
    said = probability[:, 1:] > LEVEL
    scores = {}
    for name, patch in (("", groups.label[:, 1:]), ("_true", groups.truth[:, 1:])):
        both, either = (said & patch).sum(-1), (said | patch).sum(-1)
        iou = np.where(either == 0, 1.0, both / np.maximum(either, 1)).mean(axis=1)
        scores["iou" + name] = _plain(iou)
        scores["accuracy" + name] = _plain((said == patch).mean(axis=(1, 2)))
    return scores


def fused_verdicts(
    probability: FloatArray, groups: Groups, model: Model, case: Case
) -> dict[str, Any]:
    """Fuse the first n probes of each group and judge at the place of the first.

    Returns ``says`` per n, the reliability of all covered cells after three probes, and the IoU of
    that map against the true support.
    """
    says: dict[str, list[bool]] = {str(n): [] for n in FUSED if n <= probability.shape[1]}
    promised, real = [], []
    iou: list[float] = []
    for g in range(len(probability)):
        first = _pair(groups.offset_mm[g, 0])
        belief = Belief.unknown(BeliefSettings(), first, model.base_rate)
        for k, p in enumerate(probability[g]):
            patch = ContactPatch(model.points_mm.copy(), p.copy())
            belief = belief.updated(patch, _pair(groups.offset_mm[g, k]))
            if str(k + 1) in says:
                com, rules = case.piece.com_xy_mm, StabilitySettings()
                says[str(k + 1)].append(judge(belief, patch, com, first, rules).stable)
            if k + 1 == RELIABLE_AFTER:
                cells, support = _support(belief, groups, g, case)
                promised.append(cells)
                real.append(support)
                iou.append(_iou(cells > LEVEL, support))
    chart = reliability(np.concatenate(promised), np.concatenate(real))
    return {
        "says": says,
        "map_iou": iou,
        "reliability": {
            "promised": _plain(np.array(chart.promised)),
            "came": _plain(np.array(chart.came)),
            "count": list(chart.count),
            "ece": round(chart.ece, DIGITS),
        },
    }


def _support(
    belief: Belief, groups: Groups, g: int, case: Case
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return probability and truth of the covered cells, the map being in commanded places."""
    covered = belief.map.covered
    centres = belief.map.cell_centres_mm()[covered]
    shift = groups.true_mm[g, 0] - groups.offset_mm[g, 0]
    return belief.map.probability[covered], case.bottoms[0].face.contains(centres + shift)


def _iou(said: NDArray[np.bool_], real: NDArray[np.bool_]) -> float:
    either = int((said | real).sum())
    return round(float((said & real).sum() / either), DIGITS) if either else 1.0


def _plain(values: FloatArray) -> list[float]:
    return [round(float(v), DIGITS) for v in values]


def _pair(values: FloatArray) -> tuple[float, float]:
    return float(values[0]), float(values[1])
