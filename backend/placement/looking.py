"""Looking before moving: the next press is where its outcome would decide most.

One press ahead (expected information gain as in Ota et al., Tactile-Filter, RSS 2023, arXiv
2303.06034, but about stability and not about shape): for each place within a step, what would be
felt there if each of many drawn outlines were the true one, and how sure of standing would one then
be? Worth is the chance to be sure enough for a release there, and what is learned about standing
in the place that one is after; the way that is left to that place, and the chance to touch nothing,
count against it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import atan2, cos, dist, pi, sin

import numpy as np
from numpy.typing import NDArray

from backend.config.method import LookingSettings, OutlineSettings
from backend.core.flow import FloatArray
from backend.objects.shapes import Outline
from backend.placement.below import Below
from backend.placement.outline_belief import LEAST_CELLS, OutlineBelief
from backend.placement.outline_family import inset_mm

XY = tuple[float, float]
DIRECTIONS, PARTS = 8, (0.5, 1.0)
"""Places that are compared: so many directions, at these parts of the longest step."""


@dataclass(frozen=True, slots=True)
class Question:
    """What is asked of the next press.

    ``points_mm`` (N, 2) of the face and its ``com_mm`` in ``F``; ``sure``: how far the network's
    log odds are from zero, on average; ``target_mm``: where the greedy step would go in the end.
    """

    points_mm: FloatArray
    com_mm: XY
    sure: float
    target_mm: XY
    below: Below | None = None


def places(here: XY, target: XY, longest_mm: float) -> list[XY]:
    """Return the places that one step reaches; the greedy one is the first."""
    away = dist(here, target)
    bearing = atan2(target[1] - here[1], target[0] - here[0])
    steps = [(min(longest_mm, away), bearing)]
    steps += [
        (part * longest_mm, bearing + 2.0 * pi * k / DIRECTIONS)
        for part in PARTS
        for k in range(DIRECTIONS)
    ]
    return [(here[0] + reach * cos(a), here[1] + reach * sin(a)) for reach, a in steps]


def worth(
    outlines: OutlineBelief,
    question: Question,
    at: list[XY],
    longest_mm: float,
    rules: OutlineSettings,
    settings: LookingSettings,
) -> FloatArray:
    """Return (k,): what a press at each of the places ``at`` is worth."""
    drawn = outlines.drawn(settings.draws)
    spots = np.array(at)
    faces = spots[:, None] + question.points_mm
    touch = np.stack([o.contains(faces - np.array(c)) for o, c in drawn], axis=1)
    places = np.array([*at, question.target_mm]) + np.asarray(question.com_mm)
    stands = (_insets(places, drawn, question.below) >= rules.inset_mm).astype(np.float64)
    values = []
    for k, spot in enumerate(at):
        alike = _alike(touch[k], faces[k], question.sure, rules)
        chance = float((alike @ stands[k] >= 1.0 - rules.risk).mean())
        learned = float(_bits(stands[-1].mean()) - _bits(alike @ stands[-1]).mean())
        nothing = float((touch[k].sum(axis=1) < LEAST_CELLS).mean())
        left = dist(spot, question.target_mm) / longest_mm
        values.append(chance + settings.gain * learned - settings.way * left - nothing)
    return np.array(values)


def _insets(
    places: FloatArray, drawn: Sequence[tuple[Outline, XY]], below: Below | None
) -> FloatArray:
    """Return (k, m): how far each of ``places`` (k, 2) lies within each drawn outline.

    With a tower below, one draw of it for each outline: the least of all interfaces.
    """
    insets = np.stack([inset_mm(o, places - np.array(c)) for o, c in drawn], axis=1)
    if below is not None:
        relative = places[:, None] - np.array([c for _, c in drawn])
        lower = below.insets_mm(relative)
        each = np.arange(len(drawn))
        insets = np.minimum(insets, lower[each % len(lower), :, each].T)
    return np.asarray(insets, dtype=np.float64)


def _alike(
    touch: NDArray[np.bool_], face_mm: FloatArray, sure: float, rules: OutlineSettings
) -> FloatArray:
    """Return (m, m): belief in each drawn outline after feeling what each would let one feel.

    ``touch`` (m, N): which points ``face_mm`` (N, 2) touch. Evidence counts as it does in the
    belief itself: a share of the map's log odds, and where the press acted, measured with an error;
    the middle of the overlap stands for the latter.
    """
    area = touch.sum(axis=1)
    weight = touch / np.maximum(area, 1)[:, None]
    acts = weight @ face_mm
    both = touch.astype(np.float64) @ touch.T.astype(np.float64)
    unlike = area[:, None] + area[None, :] - 2.0 * both
    apart = ((acts[:, None] - acts[None, :]) ** 2).sum(axis=-1)
    # Feeling has an error of its own: between what two would feel lies that error twice.
    log = -rules.weight * sure * unlike - apart / (4.0 * rules.pressure_sd_mm**2)
    like = np.exp(log)
    return np.asarray(like / like.sum(axis=1, keepdims=True), dtype=np.float64)


def _bits(p: FloatArray | float) -> FloatArray:
    """Return the entropy of yes with probability ``p``."""
    q = np.clip(p, 1e-12, 1.0 - 1e-12)
    return np.asarray(-q * np.log2(q) - (1.0 - q) * np.log2(1.0 - q), dtype=np.float64)
