"""Ablations: what a network does not read. Its file is like any other: nothing else is different.

An input that is divided by a huge scale says nothing; attention that adds zero sees no other probe.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from backend.learning.fused.summary import GROWN, MODES, PIECE_INPUTS, PROBE_INPUTS, TICKS

Part = Literal["wrench", "fields", "others", "mirrors"]
"""Wrench and where it acts; marker fields; the probes before; mirror images of the training data.
"""
PARTS: tuple[Part, ...] = get_args(Part)
UNREAD = 1e30
_WRENCH, _FIELDS, _ACTS = 6 * len(TICKS), 2 * MODES * len(TICKS), 2 * len(GROWN)


def unread(part: Part | None) -> NDArray[np.bool_]:
    """Return (inputs,): which inputs of a probe and its piece are not read without ``part``."""
    none = np.zeros(PROBE_INPUTS + PIECE_INPUTS, dtype=np.bool_)
    acts = _WRENCH + _FIELDS
    if part == "wrench":
        none[:_WRENCH] = none[acts : acts + _ACTS] = True
    if part == "fields":
        none[_WRENCH:acts] = True
    if part == "others":
        none[acts + _ACTS : PROBE_INPUTS] = True
    return none
