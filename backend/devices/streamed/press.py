"""Press of a streamed arm."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

import numpy as np

from touchdown.backend.core import Fault, FloatArray, OnsetDetector, OnsetRule, SampleStream
from touchdown.backend.devices.interlock import RETREAT_MM, RETREAT_MM_S
from touchdown.backend.devices.protocols import Health, PressCommand
from touchdown.backend.devices.streamed.compliance import (
    DESIGN_N_MM,
    OLD_S,
    SPEED_MM_S,
    STIFF_N_MM,
    AirZero,
    Compliance,
    ContactStiffness,
    Law,
    Loop,
    law_for,
)
from touchdown.backend.devices.streamed.moves import (
    ACCELERATION_MM_S2,
    ARM,
    HELD,
    STOPPED,
    ArmPress,
    Felt,
)

SILENT_S = 0.3
"""In contact the arm draws back from what it has not felt for this long."""


class Press:
    """Holds one press. ``before``: wrench samples (n,), (n, 3) in air up to now, for the zero."""

    fragile = True
    speed_mm_s = SPEED_MM_S
    turn: FloatArray | None = None

    def __init__(
        self,
        motion: ArmPress,
        command: PressCommand,
        law: Law,
        loop: Loop,
        before: tuple[FloatArray, FloatArray],
    ) -> None:
        self.motion, self._command = motion, command
        self._law, self._loop = law, loop
        self._detector = OnsetDetector(OnsetRule(threshold_n=command.threshold_n))
        t_s, force_n = before
        self._air = AirZero(t_s, force_n)
        self._detector.feed(t_s, force_n[:, 2])
        self._felt_s = float(t_s[-1])
        self._speed_mm_s = 0.0
        self._start_z_mm: float | None = None
        self._way: list[tuple[float, float]] = []
        self._zero_mm = self._depth_mm = 0.0
        self._rise_to_mm: float | None = None
        self.stiffness = ContactStiffness(loop.delay_s)
        self.compliance: Compliance | None = None

    def next_mm(self, felt: Felt) -> FloatArray:
        """Return the next command."""
        if self.compliance is None and not self._touched(felt):
            self.stiffness.feed(felt.now_s, float(felt.command_mm[2]), 0.0)
            return self._descend(felt)
        comply = self.compliance
        assert comply is not None
        comply.feel(felt.now_s, felt.t_s, felt.force_n)
        self._weigh(comply, felt)
        self._judge(comply, felt.now_s)
        if self._rise_to_mm is not None:
            self._retract(comply, felt)
        elif not comply.swinging:
            self._ramp(comply, felt)
        return comply.command_mm(felt.now_s)

    def cut(self, command_mm: FloatArray) -> None:
        """Go on from where the command really is."""
        if self.compliance is not None:
            self.compliance.cut(command_mm)

    def still(self) -> None:
        """Begin the descent again from zero speed."""
        self._speed_mm_s = 0.0

    # -- before contact ---------------------------------------------------------------------------

    def _touched(self, felt: Felt) -> bool:
        """Whether contact is declared; then the arm is compliant from here on."""
        if self._start_z_mm is None:
            self._start_z_mm = float(felt.command_mm[2])
        self._way.append((felt.now_s, float(felt.command_mm[2])))
        finite = np.isfinite(felt.force_n).all(axis=1)
        if finite.any():
            self._air.feed(felt.t_s[finite], felt.force_n[finite])
            self._detector.feed(felt.t_s[finite], felt.force_n[finite, 2])
            self._felt_s = float(felt.t_s[finite][-1])
        onset_s = self._detector.onset_s
        if onset_s is None or self.motion.done:
            return False
        self.motion.detected_s, self.motion.onset_s = self._detector.detected_s, onset_s
        t_s, z_mm = zip(*self._way, strict=True)
        # The arm was where the command had been a loop delay before, less the sensor's own part.
        lag_s = self._loop.arm_lag_s + self._loop.cycle_s
        self._zero_mm = float(np.interp(onset_s - lag_s, t_s, z_mm))
        self.compliance = Compliance(
            self._law, self._loop, felt.command_mm, self._air.start_n, self._air.moved_n(onset_s)
        )
        return True

    def _descend(self, felt: Felt) -> FloatArray:
        after = felt.command_mm.copy()
        if not felt.now_s - self._felt_s <= OLD_S:
            # No way is gone towards the support without feeling it.
            self.motion.end(UNFELT)
        if self.motion.done:
            return after
        command = self._command
        most = self._speed_mm_s + ACCELERATION_MM_S2 * felt.cycle_s
        self._speed_mm_s = min(command.approach_mm_s, most)
        after[2] -= self._speed_mm_s * felt.cycle_s
        assert self._start_z_mm is not None
        if self._start_z_mm - after[2] > command.max_travel_mm:
            self.motion.end(no_contact(command.max_travel_mm))
            return felt.command_mm
        return after

    # -- in contact -------------------------------------------------------------------------------

    def _ramp(self, comply: Compliance, felt: Felt) -> None:
        command, onset_s = self._command, self.motion.onset_s
        assert onset_s is not None
        elapsed_s = felt.now_s + felt.cycle_s - onset_s
        if not self.motion.done:
            planned_mm = command.depth_mm * min(1.0, elapsed_s / command.ramp_s)
            gained_mm = planned_mm - self._depth_mm
            self._depth_mm += comply.speed_share * max(gained_mm, 0.0)
            z_mm = self._zero_mm - self._depth_mm
            comply.reference_mm[2] = min(float(comply.reference_mm[2]), z_mm)
        if elapsed_s >= command.hold_s:
            self.motion.end()

    def _weigh(self, comply: Compliance, felt: Felt) -> None:
        """See how stiff the contact is, once: damp it accordingly, or draw back from it."""
        if self.stiffness.found_n_mm is not None:
            return
        self.stiffness.feed(felt.now_s, float(felt.command_mm[2]), comply.press_n)
        found_n_mm = self.stiffness.found_n_mm
        if found_n_mm is None or found_n_mm <= DESIGN_N_MM:
            return
        if found_n_mm > STIFF_N_MM:
            self._draw_back(comply, _too_stiff(found_n_mm))
        elif not comply.swinging:
            comply.law = law_for(self._loop, self._command.stiffness_n_mm, STIFF_N_MM)

    def _judge(self, comply: Compliance, now_s: float) -> None:
        """End the motion, and draw back if need be: too much force, none felt, or a swing."""
        if comply.tripped and self._rise_to_mm is None:
            self._draw_back(comply, TRIPPED)
        elif not comply.silent_s(now_s) <= OLD_S:
            self.motion.end(UNFELT)
            if self._rise_to_mm is None and comply.silent_s(now_s) > SILENT_S:
                self._draw_back(comply, UNFELT)
        elif comply.swinging:
            self.motion.end(SWINGING)
            if self._rise_to_mm is None and comply.still_swinging(now_s):
                self._draw_back(comply, SWINGING)

    def retreat(self) -> bool:
        """Draw back if there is a contact, for a reason from outside; whether there is one."""
        if self.compliance is None:
            return False
        if self._rise_to_mm is None:
            self._draw_back(self.compliance, STOPPED)
        return True

    def _draw_back(self, comply: Compliance, fault: Fault) -> None:
        self.motion.end(fault)
        self._rise_to_mm = float(comply.reference_mm[2]) + RETREAT_MM

    def _retract(self, comply: Compliance, felt: Felt) -> None:
        assert self._rise_to_mm is not None
        z_mm = float(comply.reference_mm[2]) + RETREAT_MM_S * felt.cycle_s
        comply.reference_mm[2] = min(z_mm, self._rise_to_mm)


def no_contact(travel_mm: float) -> Fault:
    """Return the fault of a descent that met nothing on its way."""
    return Fault(
        "NO-CONTACT",
        f"No contact on {travel_mm:.1f} mm of descent.",
        HELD,
        "Check the height of the support and the force/torque sensor.",
        ARM,
    )


def _too_stiff(found_n_mm: float) -> Fault:
    return Fault(
        "CONTACT-STIFF",
        f"The contact has {found_n_mm:.0f} N/mm: there is no gel in the path.",
        "The arm draws back by 2 mm; the gripper was not opened.",
        "Does the gripper itself touch the board?",
        ARM,
    )


UNFELT = Fault(
    "FT-STALE",
    "The wrist sensor fell silent while the arm was pressing.",
    "The press is void; in contact the arm draws back by 2 mm. The gripper was not opened.",
    "Check the force/torque sensor and its cable, then press again.",
    ARM,
)
TRIPPED = Fault(
    "FT-TRIP",
    "The force went over the trip limit while pressing.",
    "The arm draws back by 2 mm; the gripper was not opened.",
    "Check the piece and the support, then press Reset.",
    ARM,
)
SWINGING = Fault(
    "CONTACT-SWINGS",
    "The contact is stiffer than the arm can hold: the force swings.",
    "The press is void; the arm is damped, and draws back if that does not calm it.",
    "Is there a gel between gripper and support? Press more slowly.",
    ARM,
)


RATE_WINDOW_S = 1.0
KEPT = 32_768


class MeasuredPlaces:
    """``poses``: position of ``G``, mm in the bench. One thread puts, any reads."""

    def __init__(self, now_s: Callable[[], float], poses: SampleStream | None = None) -> None:
        self._now_s = now_s
        self.poses = poses or SampleStream(ARM, 3, KEPT)
        self.begin()

    def begin(self) -> None:
        """Count anew: a connection begins."""
        self.received = 0
        self._arrivals: deque[float] = deque(maxlen=512)

    def put(self, now_s: float, place_mm: FloatArray) -> None:
        """Take where ``G`` (3,) was measured at ``now_s``."""
        self.poses.put(np.array([now_s]), place_mm[None])
        self.received += 1
        self._arrivals.append(now_s)

    def latest_mm(self, max_age_s: float) -> tuple[float, float, float]:
        """Return the newest place; raises ``StaleSampleError`` if it is older."""
        _, (x_mm, y_mm, z_mm) = self.poses.latest(self._now_s(), max_age_s)
        return float(x_mm), float(y_mm), float(z_mm)

    def health(self, lost: int) -> Health:
        """Return rate over the last second, age of the newest, and counts with ``lost``."""
        now_s, arrivals = self._now_s(), self._arrivals.copy()
        rate_hz = sum(t_s > now_s - RATE_WINDOW_S for t_s in arrivals) / RATE_WINDOW_S
        age_s = now_s - arrivals[-1] if arrivals else math.inf
        return Health(rate_hz, age_s, self.received, lost)
