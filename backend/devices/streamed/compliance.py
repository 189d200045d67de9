"""The compliant arm in contact: reference, law, air zero, force limits and the swing detector."""

from __future__ import annotations

import math

import numpy as np

from backend.core.flow import FloatArray
from backend.devices.streamed.admittance import AT_REST, Law, Loop, cut_back, give_way
from backend.devices.streamed.swing import SwingDetector

SOFT_N, PRESS_N = 15.0, 25.0
"""Over the first the reference slows down to half, over the second it stands."""
TRIP_N, TRIP_AT_ONCE_N = 40.0, 60.0
OLD_S = 0.1
"""A wrench older than this is no observation: the arm stands still."""


class Compliance:
    """Turns a reference and the felt force into a command; forces in N with ``air_n`` as zero.

    ``moved_n`` (3,): how far that zero has moved until the contact. The arm does not give way to
    it; what is told of the force counts from ``air_n``, as the tare of the run does.
    """

    def __init__(
        self,
        law: Law,
        loop: Loop,
        reference_mm: FloatArray,
        air_n: FloatArray,
        moved_n: FloatArray | None = None,
    ) -> None:
        self._loop = loop
        self.law = law
        """May be exchanged in contact: what has been given way stays."""
        self._give = AT_REST
        self._swing = SwingDetector(loop.delay_s)
        self._air_n = air_n.copy()
        self._moved_n = np.zeros(3) if moved_n is None else moved_n.copy()
        self._felt_n, self._felt_s = np.full(3, math.nan), -math.inf
        self._over_before = False
        self._calmed_s = math.inf
        self.reference_mm = reference_mm.copy()
        self.tripped = False

    @property
    def press_n(self) -> float:
        """Felt press force, filtered as the law has it."""
        return float(self._give.g_n[2])

    @property
    def felt_n(self) -> FloatArray:
        """(3,) newest force on the tool; NaN when too old."""
        return self._felt_n

    def silent_s(self, now_s: float) -> float:
        """Return the age of the newest finite sample."""
        return now_s - self._felt_s

    @property
    def speed_share(self) -> float:
        """Which share of its speed the reference may have at this force."""
        force_n = float(np.linalg.norm(self._give.g_n))
        if not force_n <= PRESS_N:
            return 0.0
        return 1.0 if force_n <= SOFT_N else 0.5

    @property
    def swinging(self) -> bool:
        """Whether the contact has been found unstable: the law is calmed since."""
        return math.isfinite(self._calmed_s)

    def feel(self, now_s: float, t_s: FloatArray, force_n: FloatArray) -> None:
        """Take samples (n,), (n, 3); the mean of the finite ones is the force of this cycle."""
        finite = np.isfinite(force_n).all(axis=1)
        if finite.any():
            values = force_n[finite] - self._air_n
            self._felt_n, self._felt_s = values.mean(axis=0), float(t_s[finite][-1])
            self._look_for_trip(values)
        elif not now_s - self._felt_s <= OLD_S:
            self._felt_n = np.full(3, math.nan)

    def command_mm(self, now_s: float) -> FloatArray:
        """Return the next command (3,)."""
        self._give = give_way(self.law, self._give, self._felt_n - self._moved_n)
        if np.isfinite(self._felt_n).all():
            self._watch_swing(now_s)
        return np.asarray(self.reference_mm + self._give.d_mm)

    def cut(self, command_mm: FloatArray) -> None:
        """Take note that the command was cut by the lead limit."""
        self._give = cut_back(self._give, self.reference_mm, command_mm)

    def rebase(self, command_mm: FloatArray) -> None:
        """Go on from a command that others have moved since."""
        self.reference_mm = command_mm - self._give.d_mm

    def still_swinging(self, now_s: float) -> bool:
        """Whether it still swings ten delays after it was calmed."""
        waited_s = now_s - self._calmed_s
        return waited_s >= 10.0 * self._loop.delay_s and self._swing.feed(now_s, self.press_n)

    def _watch_swing(self, now_s: float) -> None:
        if self._swing.feed(now_s, float(self._felt_n[2])) and not self.swinging:
            self.law = self.law.doubled()
            self._calmed_s = now_s
            self._swing.forget()

    def _look_for_trip(self, values_n: FloatArray) -> None:
        size = np.linalg.norm(values_n, axis=1)
        over = np.concatenate([[self._over_before], size > TRIP_N])
        self._over_before = bool(over[-1])
        twice = bool((over[:-1] & over[1:]).any())
        self.tripped = self.tripped or twice or bool((size > TRIP_AT_ONCE_N).any())
