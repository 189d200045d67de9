"""The numbers of the paper's three tables, to stand beside the measured ones.

Ota et al., "Tactile Estimation of Extrinsic Contact Patch for Stable Placement", ICRA 2024,
arXiv 2309.14552. In % except Table III (successes of 10). Keys: piece, bottom.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product

CELLS = tuple(product(("mushroom", "barrel", "pot"), ("short", "long")))
"""Columns of all three tables, in their order."""
Row = Mapping[tuple[str, str], float]


def _row(*values: float) -> Row:
    return dict(zip(CELLS, values, strict=True))


IOU: Mapping[str, Row] = {
    "FT": _row(27.4, 37.7, 29.6, 44.5, 23.8, 53.2),
    "Tac": _row(33.6, 22.2, 31.5, 42.6, 16.5, 37.5),
    "FT+Tac": _row(38.4, 50.7, 31.9, 41.2, 24.8, 54.8),
}
POINTS: Mapping[str, Row] = {
    "FT": _row(67.4, 65.5, 75.3, 73.1, 68.0, 71.9),
    "Tac": _row(72.9, 60.4, 76.5, 77.5, 66.9, 71.7),
    "FT+Tac": _row(77.9, 73.8, 77.0, 75.4, 67.3, 74.9),
}
STABILITY: Mapping[str, Row] = {
    "Implicit": _row(73.7, 73.0, 63.9, 69.8, 64.2, 66.0),
    "1": _row(69.8, 81.0, 63.7, 71.4, 61.7, 69.4),
    "2": _row(88.4, 93.0, 92.7, 88.9, 83.2, 83.9),
    "3": _row(93.0, 93.2, 97.3, 92.1, 91.1, 85.7),
}
"""Implicit, and the method fusing n = 1, 2, 3 probes. Five were not measured."""
STACKING: Mapping[str, Row] = {
    "pick-and-place": _row(0, 0, 0, 0, 0, 0),
    "one": _row(8, 6, 8, 5, 7, 6),
    "two": _row(6, 5, 7, 5, 6, 5),
}
RUNS = 10
