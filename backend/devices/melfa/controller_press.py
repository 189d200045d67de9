"""A press that the controller makes by its own force program, as this computer sees it.

What is felt says when contact began and when the press is over; nothing is streamed meanwhile. No
thread, no wire, no clock: its owner steps it once per cycle and carries out what it asks.
"""

from __future__ import annotations

import math

import numpy as np

from backend.core.faults import Fault
from backend.core.flow import FloatArray
from backend.core.onset import OnsetDetector, OnsetRule
from backend.devices.motion import CommandedMotion
from backend.devices.protocols import PressCommand
from backend.devices.streamed.air_zero import AIR_S
from backend.devices.streamed.compliance import OLD_S, TRIP_AT_ONCE_N, TRIP_N
from backend.devices.streamed.motion import ARM, HELD, ArmPress
from backend.devices.streamed.pressing import TRIPPED, UNFELT, no_contact
from backend.devices.streamed.programs import UNLOAD_MM, not_unloaded

WAITS_S, SOON_S = 3.0, 0.3
"""The program waits so long for what is to follow; an order takes a moment to reach it."""


class ControllerPress:
    """``before``: wrench samples (n,), (n, 3) in air; ``margin_s``: how late it may be."""

    def __init__(
        self,
        motion: ArmPress,
        command: PressCommand,
        before: tuple[FloatArray, FloatArray],
        margin_s: float,
    ) -> None:
        self.motion, self._command, self._margin_s = motion, command, margin_s
        self._unloading: CommandedMotion | None = None
        self._unloaded_n = 0.0
        t_s, force_n = before
        self._air_n = force_n[t_s >= t_s[-1] - AIR_S].mean(axis=0)
        self._detector = OnsetDetector(OnsetRule(threshold_n=command.threshold_n))
        self._detector.feed(t_s, force_n[:, 2])
        self._felt_s, self._press_n = float(t_s[-1]), math.nan
        descent_s = command.max_travel_mm / command.approach_mm_s
        self._ends_s = self._felt_s + descent_s + command.hold_s + margin_s
        self._over = False

    @property
    def under_way(self) -> bool:
        """Whether the press, or its unloading, has not ended."""
        return not self.motion.done or (self._unloading is not None and not self._unloading.done)

    @property
    def touched(self) -> bool:
        """Whether contact was felt."""
        return self.motion.onset_s is not None

    def holds(self, now_s: float) -> bool:
        """Whether the program still presses: it lifts by itself unless it is told in time."""
        onset_s = self.motion.onset_s
        if onset_s is None:
            return False
        waits_until_s = onset_s + self._command.hold_s + WAITS_S
        return self._unloading is not None or now_s < waits_until_s - SOON_S

    @property
    def press_n(self) -> float:
        """Newest press force over that in air; NaN before contact."""
        return self._press_n if self.touched else math.nan

    def unload(self, motion: CommandedMotion, force_n: float, now_s: float, speed: float) -> None:
        """Take note that the program was told to unload to ``force_n`` at ``speed`` mm/s."""
        self._unloading, self._unloaded_n = motion, force_n
        self._ends_s = now_s + UNLOAD_MM / speed + self._margin_s

    def end(self, fault: Fault) -> None:
        """End what is under way: the program was stopped."""
        self.motion.end(fault)
        if self._unloading is not None:
            self._unloading.end(fault)

    def step(
        self, now_s: float, samples: tuple[FloatArray, FloatArray], *, running: bool
    ) -> Fault | None:
        """Take samples (n,), (n, 3) and whether the program runs; a fault: abort the program."""
        tripped = self._feel(*samples)
        if not self.under_way:
            return None
        fault = self._wrong(now_s, tripped, running=running)
        if fault is not None:
            self.end(fault)
            return fault if running else None
        onset_s = self.motion.onset_s
        if self._unloading is not None:
            if self._press_n <= self._unloaded_n:
                self._unloading.end()
        elif onset_s is not None and now_s >= onset_s + self._command.hold_s:
            self.motion.end()
        return None

    def _wrong(self, now_s: float, tripped: bool, *, running: bool) -> Fault | None:
        if tripped:
            return TRIPPED
        if not now_s - self._felt_s <= OLD_S:
            return UNFELT
        if not running:
            return ENDED if self.touched else no_contact(self._command.max_travel_mm)
        if now_s > self._ends_s:
            return LATE if self._unloading is None else not_unloaded(self._press_n)
        return None

    def _feel(self, t_s: FloatArray, force_n: FloatArray) -> bool:
        """Take samples; return whether they are over the trip limit."""
        finite = np.isfinite(force_n).all(axis=1)
        if not finite.any():
            return False
        values = force_n[finite] - self._air_n
        self._felt_s, self._press_n = float(t_s[finite][-1]), float(values[:, 2].mean())
        if not self.motion.done and not self.touched:
            self._detector.feed(t_s[finite], force_n[finite, 2])
            self.motion.detected_s = self._detector.detected_s
            self.motion.onset_s = self._detector.onset_s
        size = np.linalg.norm(values, axis=1)
        over = np.concatenate([[self._over], size > TRIP_N])
        self._over = bool(over[-1])
        return bool((over[:-1] & over[1:]).any() or (size > TRIP_AT_ONCE_N).any())


ENDED = Fault(
    "PROBE-ENDED",
    "The controller's force program has ended in the middle of a press.",
    HELD,
    "Look at the controller and its program TDPROBE, then press Reset.",
    ARM,
)
LATE = Fault(
    "PROBE-LATE",
    "The controller's force program has not come to its end in time.",
    "The program was told to lift by 2 mm; the gripper was not opened.",
    "Look at its speeds and at the override of the controller, then press Reset.",
    ARM,
)
