"""Names, types and shapes of what is handed on: the light part, which a reader's process needs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from backend.core.flow import TACTILE_CHANNELS, WRENCH_CHANNELS

FPS = 10
TICK_NS = 1_000_000_000 // FPS
WINDOW = 100
"""Wrench samples per tick: 1 kHz."""
MARKERS, FT, FT_WINDOW = "observation.markers", "observation.ft", "observation.ft_window"
STATE, ACTION = "observation.state", "action"
OFFSET, PATCH = "label.offset_mm", "label.patch"
PICTURES = {"left": "observation.images.tac_left", "right": "observation.images.tac_right"}
COMMANDED, MEASURED = "commanded", "measured"
"""What the action of an export is: the manifest says which."""
DEMOS = "demos.hdf5"
"""The file of a robomimic export."""
Values = NDArray[Any]


@dataclass(frozen=True, slots=True)
class Feature:
    """One named array: ``shape`` per tick, or once per episode where it is ``constant``."""

    key: str
    dtype: str
    shape: tuple[int, ...]
    constant: bool = False
    names: tuple[str, ...] = ()


POSE_NAMES = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
FT_NAMES = ("fx_n", "fy_n", "fz_n", "tx_nm", "ty_nm", "tz_nm")


def features(points: int, *, native: bool) -> tuple[Feature, ...]:
    """Return the features of episodes with ``points`` face points; ``native``: with recordings."""
    recorded = (
        Feature(FT_WINDOW, "float32", (WINDOW, WRENCH_CHANNELS)),
        Feature(STATE, "float32", (7,), names=POSE_NAMES),
        Feature(ACTION, "float32", (7,), names=POSE_NAMES),
    )
    return (
        Feature(MARKERS, "float32", (TACTILE_CHANNELS,)),
        Feature(FT, "float32", (WRENCH_CHANNELS,), names=FT_NAMES),
        *(recorded if native else ()),
        Feature(OFFSET, "float32", (2,), constant=True, names=("x", "y")),
        Feature(PATCH, "uint8", (points,), constant=True),
    )
