"""Commands of every streamed arm with a level hand: follow, press, unload.

A press moves down at constant speed until contact is declared, then follows a compliant ramp that
starts at the back-dated onset; the reference never rises. After the motion the arm stays compliant
until the next command. The wrist sensor is tared in air just before contact: 0.2 N of drift would
give 0.013 mm at 15 N/mm. Callers hold the lock of the stream.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import asdict
from typing import Protocol

import numpy as np

from touchdown.backend.core import (
    Fault,
    FaultError,
    FloatArray,
    OnsetDetector,
    OnsetRule,
    RefusedError,
    SampleStream,
)
from touchdown.backend.devices.protocols import (
    ARM,
    NO_WRENCH,
    NOTHING_MOVED,
    RETREAT_MM,
    RETREAT_MM_S,
    STOPPED,
    ArmPress,
    ArrivalCounter,
    CommandedMotion,
    Health,
    PressCommand,
    arm_fault,
)
from touchdown.backend.devices.streamed.compliance import (
    DESIGN_N_MM,
    OLD_S,
    SPEED_MM_S,
    STIFF_N_MM,
    TRIP_N,
    AdmittanceLaw,
    Compliance,
    LoopDelays,
    admittance_law,
    fastest_approach_mm_s,
)
from touchdown.backend.devices.streamed.motion_programs import (
    ACCELERATION_MM_S2,
    CycleInput,
    JogProgram,
    MotionProgram,
    TravelProgram,
    UnloadProgram,
)

AIR_WINDOW_S = 0.2  # length of the air that is averaged
ONSET_GAP_S = 0.05  # gap before the onset, which is known within 0.05 mm only
KEPT_S = 1.0  # length of the kept samples; longer than the delay of the onset detection
AIR_LEAST_SAMPLES = 10


class AirTare:
    """Tare in air. ``t_s`` (n,), ``force_n`` (n, 3): untared samples before a press."""

    def __init__(self, t_s: FloatArray, force_n: FloatArray) -> None:
        # (3,) mean at the start of the press.
        self.start_n = force_n[t_s >= t_s[-1] - AIR_WINDOW_S].mean(axis=0)
        self._blocks = deque([(t_s, force_n)])

    def feed(self, t_s: FloatArray, force_n: FloatArray) -> None:
        """Add finite samples (n,), (n, 3) during the descent."""
        if not len(t_s):
            return
        self._blocks.append((t_s, force_n))
        while self._blocks[0][0][-1] < t_s[-1] - KEPT_S:
            self._blocks.popleft()

    def moved_n(self, onset_s: float) -> FloatArray:
        """Return the drift (3,) in air between the start and ``onset_s``, N. Zero for too few
        samples.
        """
        t_s, force_n = (np.concatenate(part) for part in zip(*self._blocks, strict=True))
        air = (t_s >= onset_s - ONSET_GAP_S - AIR_WINDOW_S) & (t_s <= onset_s - ONSET_GAP_S)
        if np.count_nonzero(air) < AIR_LEAST_SAMPLES:
            return np.zeros(3)
        return np.asarray(force_n[air].mean(axis=0) - self.start_n)


LOW_N, HIGH_N = 1.0, 5.0
STIFFNESS_LEAST_SAMPLES = 4


class ContactStiffnessEstimate:
    """Estimate of the contact stiffness; the force follows the command after a loop delay."""

    def __init__(self, delay_s: float) -> None:
        self._delay_s = delay_s
        self._commands: deque[tuple[float, float]] = deque(maxlen=64)
        self._seen: list[tuple[float, float]] = []
        # Set once the force has risen from 1 to 5 N; unset for a softer contact.
        self.found_n_mm: float | None = None

    def feed(self, t_s: float, command_z_mm: float, force_n: float) -> None:
        """Add the commanded height and the measured press force at ``t_s``."""
        self._commands.append((t_s, command_z_mm))
        if self.found_n_mm is not None:
            return
        if not force_n >= LOW_N:
            # Only one monotonic rise counts: a bounce has no slope.
            self._seen.clear()
        elif force_n <= HIGH_N:
            times, heights = zip(*self._commands, strict=True)
            self._seen.append((float(np.interp(t_s - self._delay_s, times, heights)), force_n))
        elif len(self._seen) >= STIFFNESS_LEAST_SAMPLES:
            heights, forces = np.array(self._seen).T
            away = heights - heights.mean()
            self.found_n_mm = float(-(away @ forces) / max(float(away @ away), 1e-9))


SILENT_S = 0.3  # in contact the arm retreats after this time without a wrench


class PressProgram:
    """Program of one press. ``before``: wrench samples (n,), (n, 3) in air up to now, for the
    tare.
    """

    fragile = True
    speed_mm_s = SPEED_MM_S
    turn: FloatArray | None = None

    def __init__(
        self,
        motion: ArmPress,
        command: PressCommand,
        law: AdmittanceLaw,
        loop: LoopDelays,
        before: tuple[FloatArray, FloatArray],
    ) -> None:
        self.motion, self._command = motion, command
        self._law, self._loop = law, loop
        self._detector = OnsetDetector(OnsetRule(threshold_n=command.threshold_n))
        t_s, force_n = before
        self._air = AirTare(t_s, force_n)
        self._detector.feed(t_s, force_n[:, 2])
        self._felt_s = float(t_s[-1])
        self._speed_mm_s = 0.0
        self._start_z_mm: float | None = None
        self._way: list[tuple[float, float]] = []
        self._zero_mm = self._share = 0.0
        self._rise_to_mm: float | None = None
        self.stiffness = ContactStiffnessEstimate(loop.delay_s)
        self.compliance: Compliance | None = None

    def next_mm(self, felt: CycleInput) -> FloatArray:
        """Return the next command."""
        if self.compliance is None and not self._detect_contact(felt):
            self.stiffness.feed(felt.now_s, float(felt.command_mm[2]), 0.0)
            return self._descend(felt)
        comply = self.compliance
        assert comply is not None
        comply.feel(felt.now_s, felt.t_s, felt.force_n)
        self._check_stiffness(comply, felt)
        self._check_contact(comply, felt.now_s)
        if self._rise_to_mm is not None:
            z_mm = float(comply.reference_mm[2]) + RETREAT_MM_S * felt.cycle_s
            comply.reference_mm[2] = min(z_mm, self._rise_to_mm)
        elif not comply.swinging:
            self._ramp(comply, felt)
        return comply.command_mm(felt.now_s)

    def cut(self, command_mm: FloatArray) -> None:
        """Continue from the limited command."""
        if self.compliance is not None:
            self.compliance.cut(command_mm)

    def still(self) -> None:
        """Restart the descent from zero speed."""
        self._speed_mm_s = 0.0

    # -- before contact ---------------------------------------------------------------------------

    def _detect_contact(self, felt: CycleInput) -> bool:
        """Return True if contact is declared; the arm is compliant from then on."""
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
        # The arm was at the command of one loop delay earlier, less the sensor's delay.
        lag_s = self._loop.arm_lag_s + self._loop.cycle_s
        self._zero_mm = float(np.interp(onset_s - lag_s, t_s, z_mm))
        self.compliance = Compliance(
            self._law, self._loop, felt.command_mm, self._air.start_n, self._air.moved_n(onset_s)
        )
        return True

    def _descend(self, felt: CycleInput) -> FloatArray:
        after = felt.command_mm.copy()
        if not felt.now_s - self._felt_s <= OLD_S:
            # Never move towards the support without a measured force.
            self.motion.end(UNFELT)
        if self.motion.done:
            return after
        command = self._command
        most = self._speed_mm_s + ACCELERATION_MM_S2 * felt.cycle_s
        self._speed_mm_s = min(command.approach_mm_s, most)
        after[2] -= self._speed_mm_s * felt.cycle_s
        assert self._start_z_mm is not None
        if self._start_z_mm - after[2] > command.max_travel_mm:
            self.motion.end(no_contact_fault(command.max_travel_mm))
            return felt.command_mm
        return after

    # -- in contact -------------------------------------------------------------------------------

    def _ramp(self, comply: Compliance, felt: CycleInput) -> None:
        command, onset_s = self._command, self.motion.onset_s
        assert onset_s is not None
        elapsed_s = felt.now_s + felt.cycle_s - onset_s
        if not self.motion.done:
            left = min(1.0, elapsed_s / command.ramp_s) - self._share
            gained = comply.speed_share * max(left, 0.0)
            self._share += gained
            z_mm = self._zero_mm - self._share * command.depth_mm
            comply.reference_mm[2] = min(float(comply.reference_mm[2]), z_mm)
            comply.reference_mm[1] += gained * command.drag_mm
        if elapsed_s >= command.hold_s:
            self.motion.end()

    def _check_stiffness(self, comply: Compliance, felt: CycleInput) -> None:
        """Evaluate the contact stiffness once: adapt the damping, or retreat."""
        if self.stiffness.found_n_mm is not None:
            return
        self.stiffness.feed(felt.now_s, float(felt.command_mm[2]), comply.press_n)
        found_n_mm = self.stiffness.found_n_mm
        if found_n_mm is None or found_n_mm <= DESIGN_N_MM:
            return
        if found_n_mm > STIFF_N_MM:
            self._draw_back(comply, _too_stiff_fault(found_n_mm))
        elif not comply.swinging:
            comply.law = admittance_law(self._loop, self._command.stiffness_n_mm, STIFF_N_MM)

    def _check_contact(self, comply: Compliance, now_s: float) -> None:
        """End the motion, and retreat after too much force, no measured force, or an
        oscillation.
        """
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
        """Retreat if there is a contact, for an external reason; return True if there is one."""
        if self.compliance is None:
            return False
        if self._rise_to_mm is None:
            self._draw_back(self.compliance, STOPPED)
        return True

    def _draw_back(self, comply: Compliance, fault: Fault) -> None:
        self.motion.end(fault)
        self._rise_to_mm = float(comply.reference_mm[2]) + RETREAT_MM


def no_contact_fault(travel_mm: float) -> Fault:
    """Return the fault of a descent without contact."""
    return arm_fault(
        "NO-CONTACT",
        f"No contact on {travel_mm:.1f} mm of descent.",
        "Check the height of the support and the force/torque sensor.",
    )


def _too_stiff_fault(found_n_mm: float) -> Fault:
    return arm_fault(
        "CONTACT-STIFF",
        f"The contact has {found_n_mm:.0f} N/mm: there is no gel in the path.",
        "Does the gripper itself touch the board?",
        "The arm draws back by 2 mm; the gripper was not opened.",
    )


UNFELT = arm_fault(
    "FT-STALE",
    "The wrist sensor fell silent while the arm was pressing.",
    "Check the force/torque sensor and its cable, then press again.",
    "The press is void; in contact the arm draws back by 2 mm. The gripper was not opened.",
)
TRIPPED = arm_fault(
    "FT-TRIP",
    "The force went over the trip limit while pressing.",
    "Check the piece and the support, then press Reset.",
    "The arm draws back by 2 mm; the gripper was not opened.",
)
SWINGING = arm_fault(
    "CONTACT-SWINGS",
    "The contact is stiffer than the arm can hold: the force swings.",
    "Is there a gel between gripper and support? Press more slowly.",
    "The press is void; the arm is damped, and draws back if that does not calm it.",
)


RECENT_AIR_S = 1.0
VELOCITY_NAMES = ("x_mm_s", "y_mm_s", "z_mm_s", "rx_rad_s", "ry_rad_s", "rz_rad_s")


class ProgramRunner(Protocol):
    """Executes programs, one command per cycle."""

    @property
    def program(self) -> object | None:
        """Active or last program."""

    @property
    def command_mm(self) -> FloatArray:
        """Commanded position of ``G``, (3,) mm."""

    def run(self, program: MotionProgram) -> None:
        """Replace the active program by ``program``."""


class StreamedPrograms:
    """Creates programs; keeps the contact of the last press until the arm leaves it."""

    def __init__(self, loop: LoopDelays) -> None:
        self.loop = loop
        self._press: PressProgram | None = None

    def leave(self) -> None:
        """Drop the contact: the arm moves away."""
        self._press = None

    def press_n(self) -> float:
        """Return the press force relative to the tare of the contact law, N; NaN without
        contact.
        """
        contact = self._contact()
        return math.nan if contact is None else float(contact.felt_n[2])

    def follow(
        self, core: ProgramRunner, velocity_mm_s: FloatArray, until_s: float
    ) -> CommandedMotion:
        """Move at a velocity (3,) until the given time, or continue with a new one."""
        self.leave()
        program = core.program
        if not isinstance(program, JogProgram) or program.turns or program.motion.done:
            program = JogProgram(jog_motion(velocity_mm_s))
            core.run(program)
        program.renew(velocity_mm_s, until_s)
        return program.motion

    def press(
        self, core: ProgramRunner, command: PressCommand, before: tuple[FloatArray, FloatArray]
    ) -> ArmPress:
        """Start a press; ``before``: samples in air up to now. Raises ``RefusedError`` if the
        approach is too fast for the loop delay.
        """
        law = admittance_law(self.loop, command.stiffness_n_mm)
        fastest = fastest_approach_mm_s(law, self.loop, TRIP_N, command.depth_mm)
        if not 0.0 < command.approach_mm_s <= fastest:
            raise RefusedError(
                "APPROACH-SPEED",
                f"{command.approach_mm_s:.1f} mm/s: a contact could reach {TRIP_N:.0f} N over "
                f"{fastest:.1f} mm/s.",
            )
        motion = ArmPress({**press_fields(command), "damping_n_s_mm": law.damping})
        self._press = PressProgram(motion, command, law, self.loop, before)
        core.run(self._press)
        return motion

    def unload(self, core: ProgramRunner, force_n: float, speed_mm_s: float) -> CommandedMotion:
        """Start to lift; raises ``FaultError`` unless the last press had contact."""
        compliance = self._contact()
        if compliance is None:
            raise FaultError(NOT_PRESSING)
        motion = CommandedMotion({"force_n": force_n, "speed_mm_s": speed_mm_s})
        core.run(UnloadProgram(motion, compliance, force_n, speed_mm_s))
        return motion

    def retreat(self, core: ProgramRunner) -> None:
        """Retreat: a press by its own law, other motions straight up."""
        if self._press is not None and core.program is self._press and self._press.retreat():
            return
        self.leave()
        up_mm = core.command_mm + np.array([0.0, 0.0, RETREAT_MM])
        core.run(TravelProgram(CommandedMotion({"z_mm": float(up_mm[2])}), up_mm, RETREAT_MM_S))

    def _contact(self) -> Compliance | None:
        return None if self._press is None else self._press.compliance


def jog_motion(velocity_mm_s: FloatArray, turn_rad_s: FloatArray | None = None) -> CommandedMotion:
    """Return the motion of a jog with velocity (3,) and turn (3,)."""
    turn = np.zeros(3) if turn_rad_s is None else turn_rad_s
    values = [*velocity_mm_s.tolist(), *turn.tolist()]
    return CommandedMotion(dict(zip(VELOCITY_NAMES, values, strict=True)))


def air_before(wrench: SampleStream, now_s: float) -> tuple[FloatArray, FloatArray]:
    """Return times (n,) and forces (n, 3) of the finite samples of the last second. Raises
    ``FaultError`` if there are none.
    """
    air = wrench.window(now_s - RECENT_AIR_S, now_s)
    finite = np.isfinite(air.values).all(axis=1)
    if not finite.any():
        raise FaultError(NO_WRENCH)
    return air.t_s[finite], air.values[finite, :3]


def press_fields(command: PressCommand) -> dict[str, float]:
    """Return the values of a press command by name."""
    fields = asdict(command)
    *_, stiffness_z_n_mm = fields.pop("stiffness_n_mm")
    return {**fields, "stiffness_z_n_mm": stiffness_z_n_mm}


NOT_PRESSING = arm_fault(
    "NOT-PRESSING",
    "There is no press to unload: the last one felt no contact, or the arm has moved since.",
    "Press first.",
    NOTHING_MOVED,
)


KEPT = 32_768


class PositionRecord:
    """Measured positions of ``G``, mm in the bench frame; written by one thread."""

    def __init__(self, now_s: Callable[[], float], poses: SampleStream | None = None) -> None:
        self._now_s = now_s
        self.poses = poses or SampleStream(ARM, 3, KEPT)
        self._arrivals = ArrivalCounter()

    def begin(self) -> None:
        """Reset the counts for a new connection."""
        self._arrivals = ArrivalCounter()

    def put(self, now_s: float, place_mm: FloatArray) -> None:
        """Add the position of ``G`` (3,) measured at ``now_s``."""
        self.poses.put(np.array([now_s]), place_mm[None])
        self._arrivals.note(now_s)

    def latest_mm(self, max_age_s: float) -> tuple[float, float, float]:
        """Return the newest position; raises ``StaleSampleError`` if it is older."""
        _, (x_mm, y_mm, z_mm) = self.poses.latest(self._now_s(), max_age_s)
        return float(x_mm), float(y_mm), float(z_mm)

    def health(self, lost: int) -> Health:
        """Return rate over the last second, age of the newest sample, and counts including
        ``lost``.
        """
        return self._arrivals.health(self._now_s(), lost)
