"""Six scaled values, as every force/torque codec hands them on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from backend.wire.framing import WireError

Three = tuple[float, float, float]


class Wrench(NamedTuple):
    """Force (N) and torque (N·m) in the axes and with the sign of the sensor."""

    force_n: Three
    torque_nm: Three


NO_WRENCH = Wrench((math.nan, math.nan, math.nan), (math.nan, math.nan, math.nan))
"""What a sample holds that its sensor marks as invalid."""


def wrench_of(values: Sequence[float]) -> Wrench:
    """Return the wrench of six values, forces first; raises ``WireError`` for another number."""
    if len(values) != 6:
        raise WireError("length", "wrench", len(values))
    fx, fy, fz, mx, my, mz = values
    return Wrench((fx, fy, fz), (mx, my, mz))
