"""Changes of the IoU, group by group: the same seeds asked of two models, or on two benches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from backend.learning.metrics import Z_95

Part = Mapping[str, Any]
"""The answer of one job of presses."""
Json = dict[str, Any]


def iou_change(pairs: Sequence[tuple[Part, Part]], before: str, after: str) -> Json:
    """Return the mean change of IoU with its 95 % interval, over groups that both kept.

    From model ``before`` in the first part of each pair to model ``after`` in the second. A job in
    which a group was left out is not compared: its groups no longer match.
    """
    change = [
        new - old
        for then, now in pairs
        if then["left_out"] == now["left_out"] == 0
        for old, new in zip(_iou(then, before), _iou(now, after), strict=True)
    ]
    if len(change) < 2:
        return {"value": None, "low": None, "high": None, "n": len(change)}
    centre, half = float(np.mean(change)), Z_95 * float(np.std(change, ddof=1)) / len(change) ** 0.5
    return {"value": centre, "low": centre - half, "high": centre + half, "n": len(change)}


def signed(change: Json | None) -> str:
    """Write a change in points with half its interval; "" without one."""
    if not change or change["value"] is None:
        return ""
    half = 50.0 * (change["high"] - change["low"])
    return f"{100 * change['value']:+.1f} ± {half:.1f}"


def _iou(part: Part, model: str) -> list[float]:
    found: list[float] = part["models"][model]["iou"]
    return found
