"""Torsion slip: a held piece that turns between the pads (reliability G1).

It drags the markers of both gels round at once. A press turns them by some thousandths of a radian
in all, and slowly; a piece that turns by a degree does as much from one picture to the next.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import numpy as np

from backend.core.flow import FINGERS, Finger, MarkerField, MarkerState
from backend.core.stream import Stream
from backend.sensing.slip import fit_rigid

LEAST_RAD, WITHIN_S, TOGETHER_S = 0.005, 0.1, 0.15
"""So much the markers of both gels turn within so long, so soon one after the other, where a piece
turns.

In 1,900 presses of the simulated bench (pot and mushroom, presets mixed and hard) the gel that
turned less turned by 0.0026 rad within 0.1 s at most; a piece that turned by 1.5 degrees turned
both by 0.006 rad and more.
"""


class TorsionSlip:
    """Watches the marker fields of both fingers from its making on; made for one press."""

    def __init__(self, fields: Mapping[Finger, Stream[MarkerField]]) -> None:
        self._fields = fields
        self._cursors = {finger: fields[finger].count for finger in FINGERS}
        self._recent = {finger: deque[tuple[float, float]]() for finger in FINGERS}
        self._jumps = {finger: (float("-inf"), 0.0) for finger in FINGERS}
        self.turned_rad = 0.0
        """By how much the markers turned as the piece slipped; 0 while it sticks."""

    def seen(self) -> bool:
        """Take what arrived since the last call; return whether the piece has turned."""
        for finger in FINGERS:
            fields, self._cursors[finger], _ = self._fields[finger].since(self._cursors[finger])
            for field in fields:
                self._note(finger, field)
        return self.turned_rad > 0.0

    def _note(self, finger: Finger, field: MarkerField) -> None:
        visible = field.state == MarkerState.SEEN
        moved_px = field.displacement_px[visible]
        if not len(moved_px) or not np.isfinite(moved_px).all():
            return
        turn_rad = fit_rigid(field.position_px[visible] - moved_px, moved_px).turn_rad
        recent = self._recent[finger]
        recent.append((field.t_s, turn_rad))
        # Pictures further apart are compared all the same: what turned meanwhile has turned.
        while len(recent) > 2 and recent[0][0] < field.t_s - WITHIN_S:
            recent.popleft()
        jump_rad = max(abs(turn_rad - before_rad) for _, before_rad in recent)
        if jump_rad < LEAST_RAD:
            return
        self._jumps[finger] = field.t_s, jump_rad
        (one_s, one_rad), (other_s, other_rad) = self._jumps.values()
        if abs(one_s - other_s) <= TOGETHER_S:
            self.turned_rad = max(self.turned_rad, min(one_rad, other_rad))
