"""The jaws of the simulated gripper: width, force, and whether the piece is between them."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass

CLOSING_S = 0.5
"""Time to reach the piece from the open position."""
SQUEEZE_S = 0.1
"""Time from touching the piece to full force."""
LET_GO_MM = 0.1
"""The pads have lost the piece when the jaws are wider than it by this much."""


@dataclass(frozen=True, slots=True)
class Change:
    """What happened to the piece during a cycle."""

    taken: bool = False
    let_go: bool = False


class Jaws:
    """Moves in cycles; ``halt`` may come from any thread. Widths in mm, force per finger in N."""

    def __init__(self, open_mm: float, piece_mm: float) -> None:
        self.width_mm, self.force_n, self.holding = open_mm, 0.0, False
        self.piece_present = True
        self._piece_mm = piece_mm
        self.asked_n = 0.0
        self._target_mm: float | None = None
        self._speed_mm_s = 0.0
        self._slips_out = False
        self._lock = threading.Lock()

    @property
    def moving(self) -> bool:
        """Whether a command is under way."""
        return self._target_mm is not None

    def close(self, force_n: float) -> None:
        """Begin to close until the piece is held with ``force_n`` per finger, or to nothing."""
        with self._lock:
            self._target_mm = self._piece_mm if self.piece_present else 0.0
            way = max(self.width_mm - self._target_mm, 0.0)
            self._speed_mm_s = -max(way / CLOSING_S, 1.0)
            self.asked_n = force_n

    def open_to(self, width_mm: float, speed_mm_s: float) -> None:
        """Begin to open (or close, at most to the piece) to ``width_mm``."""
        with self._lock:
            least = self._piece_mm if self.piece_present else 0.0
            self._target_mm = max(width_mm, least)
            self._speed_mm_s = math.copysign(speed_mm_s, self._target_mm - self.width_mm)
            self.asked_n = 0.0

    def lose(self) -> None:
        """Let the piece slip out, for good; with the next step nothing is held."""
        with self._lock:
            self.piece_present, self._slips_out = False, self.holding

    def halt(self) -> None:
        """Stop where they are; the grip is kept."""
        with self._lock:
            self._target_mm = None

    def step(self, dt_s: float) -> Change:
        """Move for ``dt_s``."""
        with self._lock:
            if self._slips_out:
                self._slips_out = self.holding = False
                self._target_mm, self.force_n = None, 0.0
                return Change(let_go=True)
            target = self._target_mm
            if target is None:
                return Change()
            step = self._speed_mm_s * dt_s
            arrived = abs(target - self.width_mm) <= abs(step)
            self.width_mm = target if arrived else self.width_mm + step
            if self.asked_n > 0.0:
                return self._squeeze(dt_s) if arrived else Change()
            if arrived:
                self._target_mm = None
            return self._loosen()

    def _squeeze(self, dt_s: float) -> Change:
        if not self.piece_present:
            self._target_mm = None
            return Change()
        self.force_n = min(self.force_n + self.asked_n * dt_s / SQUEEZE_S, self.asked_n)
        if self.force_n < self.asked_n:
            return Change()
        self._target_mm = None
        taken, self.holding = not self.holding, True
        return Change(taken=taken)

    def _loosen(self) -> Change:
        if self.width_mm <= self._piece_mm + LET_GO_MM:
            return Change()
        let_go, self.holding, self.force_n = self.holding, False, 0.0
        return Change(let_go=let_go)
