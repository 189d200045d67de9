"""State of an emulated CR800 controller: joints, servo, errors, programs, motion.

Time advances by ``advance`` only. Errors stop all motion at once. Poses are computed from the chain
of joint frames and solved numerically, independently of the driver's closed form. The force program
presses with a stiffness: on each axis the position is the taught one minus force by stiffness, with
a lag.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum

import numpy as np

from touchdown.backend.config import MelfaSettings
from touchdown.backend.core import FloatArray, rotation_from_vector, rotation_vector
from touchdown.backend.devices.melfa.kinematics import LIMITS_RAD
from touchdown.backend.devices.melfa.r3_protocol import EMERGENCY_ERRORS, RunFlags, StopFlags
from touchdown.backend.devices.melfa.realtime_protocol import CYCLE_S, FLANGE_MM, JOINTS

NOISE_RAD = 1e-7  # standard deviation of the encoder feedback
SPEEDS_RAD_S = np.array([joint.speed_rad_s for joint in JOINTS])
_SOLVE_STEPS = 60


def frame_of(joints_rad: FloatArray) -> FloatArray:
    """Return the (4, 4) frame of the flange in the base."""
    # Written out: small arrays take ten times as long.
    x, y, z = [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]
    at_mm = [0.0, 0.0, 0.0]
    for joint, angle in zip(JOINTS, joints_rad.tolist(), strict=True):
        c, s = math.cos(angle), math.sin(angle)
        at_mm = [p + joint.rise_mm * k for p, k in zip(at_mm, z, strict=True)]
        if joint.axis == "z":
            x, y = _turned(x, y, c, s)
        else:
            z, x = _turned(z, x, c, s)
    at_mm = [p + FLANGE_MM * k for p, k in zip(at_mm, z, strict=True)]
    return np.array([*zip(x, y, z, at_mm, strict=True), (0.0, 0.0, 0.0, 1.0)])


def _turned(a: list[float], b: list[float], c: float, s: float) -> tuple[list[float], list[float]]:
    """Return two axes after a turn from the first to the second, by its cosine and sine."""
    pairs = tuple(zip(a, b, strict=True))
    return [c * p + s * q for p, q in pairs], [c * q - s * p for p, q in pairs]


def solve(frame: FloatArray, near_rad: FloatArray) -> FloatArray | None:
    """Return joints (6,) for ``frame`` near ``near_rad``, None without a solution."""
    joints = near_rad.copy()
    for _ in range(_SOLVE_STEPS):
        error = _apart(frame_of(joints), frame)
        if np.linalg.norm(error[:3]) < 1e-6 and np.linalg.norm(error[3:]) < 1e-9:
            return joints if (np.abs(joints) <= LIMITS_RAD).all() else None
        joints = joints + np.clip(np.linalg.lstsq(_slopes(joints), error, rcond=1e-8)[0], -0.3, 0.3)
    return None


class LocalSolver:
    """Joints for frames near the first one, by its Jacobian."""

    def __init__(self, joints_rad: FloatArray) -> None:
        self._joints = joints_rad.copy()
        self._pull = np.linalg.pinv(_slopes(joints_rad))

    def solve(self, frame: FloatArray) -> FloatArray | None:
        """Return joints (6,) for ``frame`` near the last ones, None without a solution."""
        joints = self._joints
        for _ in range(_SOLVE_STEPS):
            error = _apart(frame_of(joints), frame)
            if np.abs(error).max() < 1e-6:
                self._joints = joints
                return joints if (np.abs(joints) <= LIMITS_RAD).all() else None
            joints = joints + self._pull @ error
        return None


def _slopes(joints_rad: FloatArray) -> FloatArray:
    here, step_rad = frame_of(joints_rad), 1e-6
    columns = [
        _apart(here, frame_of(joints_rad + step_rad * np.eye(6)[k])) / step_rad for k in range(6)
    ]
    return np.stack(columns, axis=1)


def _apart(here: FloatArray, there: FloatArray) -> FloatArray:
    """Return displacement, mm, and turn, rad, from one frame to another, (6,)."""
    turned = rotation_vector(there[:3, :3] @ here[:3, :3].T)
    return np.concatenate([there[:3, 3] - here[:3, 3], turned])


def angles_of(hand: FloatArray, euler: str) -> tuple[float, float, float]:
    """Return A, B, C (rad) of a rotation (3, 3); ``euler`` as in the settings."""
    if euler.startswith("Rz"):
        b = math.asin(min(max(-float(hand[2, 0]), -1.0), 1.0))
        return math.atan2(hand[2, 1], hand[2, 2]), b, math.atan2(hand[1, 0], hand[0, 0])
    b = math.asin(min(max(float(hand[0, 2]), -1.0), 1.0))
    return math.atan2(-hand[1, 2], hand[2, 2]), b, math.atan2(-hand[0, 1], hand[0, 0])


class EmulatedJoints:
    """Command, filtered command and encoder feedback of six joints, in cycles."""

    def __init__(self, start_rad: FloatArray, cycle_s: float, lag_s: float) -> None:
        self._cycle_s, self._lag_s = cycle_s, lag_s
        self._rng = np.random.default_rng(1)
        self.command_rad = start_rad.copy()
        self.filtered_rad = start_rad.copy()
        self.true_rad = start_rad.copy()
        self.feedback_rad = start_rad.copy()
        self.filter_s = 0.010
        # Faults: the encoders do not change, or the motors do not move.
        self.frozen = self.stalled = False

    def cycle(self) -> None:
        """Advance by one control cycle."""
        t = self._cycle_s
        # New arrays, so that other threads read values of one instant.
        command = self.command_rad
        filtered, true = self.filtered_rad, self.true_rad
        self.filtered_rad = filtered + (command - filtered) * _share(t, self.filter_s)
        if not self.stalled:
            self.true_rad = true + (command - true) * _share(t, self._lag_s)
        if not self.frozen:
            noise = self._rng.normal(0.0, NOISE_RAD, 6)
            self.feedback_rad = self.true_rad + noise

    def currents(self) -> FloatArray:
        """Return currents (6,) in %: lag of each joint relative to its lag at top speed."""
        behind = self.command_rad - self.true_rad
        return np.asarray(100.0 * behind / (SPEEDS_RAD_S * max(self._lag_s, self._cycle_s)))


def _share(cycle_s: float, lag_s: float) -> float:
    return 1.0 - math.exp(-cycle_s / lag_s) if lag_s > 0.0 else 1.0


LAG_S = 0.15
ASK_S, STAND_S = 3.0, 60.0
LIFT_MM, LIFT_MM_S, UNLOAD_MM = 2.0, 10.0, 10.0
IN_A_ROW = 3
# Variables that must be written before the program runs.
WRITTEN = (
    "MDSPD", "MDTRV", "MDTHR", "MDDEP", "MDRMP", "MDHLD", "MDKX", "MDKY", "MDKZ", "MDUNL", "MDUSP",
    "MDDMP", "MDFRM",
)  # fmt: skip
UNLOAD, ABORT = 2, 3  # values of MDO; 0 waits, 1 lifts


class ProbeProgramStep(Enum):
    """Step of the program."""

    DESCEND = "descend"
    PRESS = "press"
    ASKED = "asked"
    UNLOADING = "unloading"
    STANDING = "standing"
    LIFTING = "lifting"
    ENDED = "ended"


class EmulatedProbe:
    """One run of the program from joints (6,); ``force_n`` on the tool (3,) in base axes."""

    def __init__(
        self,
        joints_rad: FloatArray,
        variables: Mapping[str, float],
        force_n: Callable[[], FloatArray],
    ) -> None:
        self._variables, self._force_n = variables, force_n
        self._offset_n = force_n()
        self._arm = LocalSolver(joints_rad)
        self._frame = frame_of(joints_rad)
        self._taught_mm = self._frame[:3, 3].copy()
        self._start_mm = self._touch_mm = float(self._taught_mm[2])
        self._give_mm = np.zeros(3)
        self._lasted_s = 0.0
        self._over = 0
        self.step = ProbeProgramStep.DESCEND

    def cycle(self) -> FloatArray | None:
        """Advance by one cycle; return the joints (6,), None without a solution."""
        force_n = self._force_n() - self._offset_n
        self._lasted_s += CYCLE_S
        self._advance(float(force_n[2]))
        stiffness = np.array([self._variables[name] for name in ("MDKX", "MDKY", "MDKZ")])
        self._give_mm += (force_n / stiffness - self._give_mm) * (CYCLE_S / (LAG_S + CYCLE_S))
        frame = self._frame.copy()
        frame[:3, 3] = self._taught_mm + self._give_mm
        return self._arm.solve(frame)

    def _go(self, step: ProbeProgramStep) -> None:
        self.step, self._lasted_s = step, 0.0

    def _advance(self, press_n: float) -> None:
        order = round(self._variables["MDO"])
        resting = ProbeProgramStep.DESCEND, ProbeProgramStep.LIFTING, ProbeProgramStep.ENDED
        if order == ABORT and self.step not in resting:
            self._go(ProbeProgramStep.LIFTING)
        match self.step:
            case ProbeProgramStep.DESCEND:
                self._descend(press_n)
            case ProbeProgramStep.PRESS:
                self._press()
            case ProbeProgramStep.ASKED:
                self._ask(order)
            case ProbeProgramStep.UNLOADING:
                self._unload(press_n)
            case ProbeProgramStep.STANDING:
                if order != UNLOAD or self._lasted_s >= STAND_S:
                    self._go(ProbeProgramStep.LIFTING)
            case ProbeProgramStep.LIFTING:
                self._taught_mm[2] += LIFT_MM_S * CYCLE_S
                if self._taught_mm[2] >= self._touch_mm + LIFT_MM:
                    self.step = ProbeProgramStep.ENDED

    def _press(self) -> None:
        told = self._variables
        self._down(told["MDDEP"] / told["MDRMP"], self._touch_mm - told["MDDEP"])
        if self._lasted_s >= told["MDHLD"]:
            self._go(ProbeProgramStep.ASKED)

    def _ask(self, order: int) -> None:
        if order == UNLOAD:
            self._start_mm = float(self._taught_mm[2])
            self._go(ProbeProgramStep.UNLOADING)
        elif order or self._lasted_s >= ASK_S:
            self._go(ProbeProgramStep.LIFTING)

    def _unload(self, press_n: float) -> None:
        self._taught_mm[2] += self._variables["MDUSP"] * CYCLE_S
        rose_mm = float(self._taught_mm[2]) - self._start_mm
        if press_n <= self._variables["MDUNL"] or rose_mm >= UNLOAD_MM:
            self._go(ProbeProgramStep.STANDING)

    def _descend(self, press_n: float) -> None:
        told = self._variables
        self._over = self._over + 1 if press_n > told["MDTHR"] else 0
        if self._over >= IN_A_ROW:
            self._touch_mm = float(self._taught_mm[2])
            self._go(ProbeProgramStep.PRESS)
            return
        least_mm = self._start_mm - told["MDTRV"]
        self._down(told["MDSPD"], least_mm)
        if self._taught_mm[2] <= least_mm:
            self.step = ProbeProgramStep.ENDED

    def _down(self, speed_mm_s: float, least_mm: float) -> None:
        self._taught_mm[2] = max(float(self._taught_mm[2]) - speed_mm_s * CYCLE_S, least_mm)


JOG_S = 0.140  # a jog ends this long after the last command
JOG_SHARE = 0.10  # of the top speed of a joint, at full override
JOG_MM_S = 250.0  # along a straight axis, at full override
AXIS_TURN_RAD_S = 0.5
# Joints at power-on: the hand points down.
READY_RAD = np.radians([0.0, 20.0, 100.0, 0.0, 60.0, 0.0])
STREAM, PROBE, IDLE = "stream", "probe", ""
PLAIN = "MXT"  # name of the stream program for clients of other makers
JOINT, STRAIGHT, TOOL = 0, 1, 2
PAST = 300  # stored cycles: about a second


class RefusedCommandError(Exception):
    """Refusal of the controller with its error ``number``."""

    def __init__(self, number: int) -> None:
        super().__init__(str(number))
        self.number = number


@dataclass(slots=True)
class ActiveJog:
    """A jog in progress: speed, coordinates, and end."""

    mode: int
    signs: FloatArray
    until_s: float


@dataclass(slots=True)
class ActiveMove:
    """A move of EXEC: ``point(share)`` returns joints, or None without a solution."""

    point: Callable[[float], FloatArray | None]
    begun_s: float
    lasts_s: float


class EmulatedController:
    """Emulated controller with the settings of the driver; ``streaming``: the stream runs at
    once.
    """

    def __init__(
        self,
        settings: MelfaSettings,
        *,
        start_rad: FloatArray | None = None,
        streaming: bool = False,
    ) -> None:
        self.settings = settings
        start = READY_RAD if start_rad is None else start_rad
        self.joints = EmulatedJoints(start, CYCLE_S, 1e-3 * settings.arm_lag_ms)
        self._past: deque[tuple[float, FloatArray]] = deque(maxlen=PAST)
        self.now_s = 0.0
        self._begun_s: float | None = None
        self._cycles = 0
        self.override = 100
        self.right: object | None = None
        self._servo_on_s = math.inf
        self.error = 0
        # Last time at which an error or servo-off ended all motion, s.
        self.stopped_s = math.inf
        self.program, self.loaded = IDLE, settings.mxt.program
        self.missing_programs: set[str] = set()
        self.held = self.stop_on = self.emergency = False
        self._jog: ActiveJog | None = None
        self._moving: ActiveMove | None = None
        self._probe: EmulatedProbe | None = None
        self.variables: dict[str, float] = {}  # variables of the force program
        # Number of the tool; positions, base and tool as six numbers, mm and degrees.
        self.tool = 0
        self.positions: dict[str, tuple[float, ...]] = {}
        self.frames: dict[str, tuple[float, ...]] = {"BASE": (0.0,) * 6, "TOOL": (0.0,) * 6}
        # Wrench on the tool (6,), N and N·m in base axes, for the controller's own sensor.
        self.felt: Callable[[], FloatArray] = lambda: np.zeros(6)
        # Called once per cycle; the stream counts its silence there.
        self.on_cycle: Callable[[], None] = lambda: None
        if streaming:
            self._servo_on_s, self.program = -math.inf, STREAM

    # -- state ------------------------------------------------------------------------------------

    @property
    def servo(self) -> bool:
        """True while the servo is on."""
        return self.now_s >= self._servo_on_s

    @property
    def moving(self) -> bool:
        """True during a jog or a move."""
        return self._jog is not None or self._moving is not None

    def words(self) -> tuple[RunFlags, StopFlags]:
        """Return run and stop status."""
        run = RunFlags.REPEAT | RunFlags.OPERATION_ENABLED
        run |= RunFlags.SERVO_ON if self.servo else RunFlags(0)
        run |= RunFlags.RUNNING if self.program or self._moving else RunFlags(0)
        stop = StopFlags.EMERGENCY if self.emergency else StopFlags(0)
        stop |= StopFlags.STOP if self.stop_on else StopFlags(0)
        stop |= StopFlags.WAIT if self.held else StopFlags(0)
        return run, stop

    @property
    def next_cycle_s(self) -> float:
        """End of the present cycle, s; infinite before the start."""
        if self._begun_s is None:
            return math.inf
        return self._begun_s + (self._cycles + 1) * CYCLE_S

    def advance(self, now_s: float) -> None:
        """Run the cycles up to ``now_s``."""
        if self._begun_s is None:
            self._begun_s = now_s
        # Multiplied, not summed, to avoid rounding at the end of a cycle.
        while (next_s := self.next_cycle_s) <= now_s + 1e-7:
            self._cycles += 1
            self.now_s = next_s
            self._cycle()
        self.now_s = now_s

    def _cycle(self) -> None:
        self.on_cycle()
        if self._jog is not None:
            self._follow_jog(self._jog)
        if self._moving is not None:
            self._follow_move(self._moving)
        if self._probe is not None:
            self._follow_probe(self._probe)
        self.joints.cycle()
        self._past.append((self.now_s, self.joints.true_rad))

    @property
    def speed_mm_s(self) -> float:
        """Speed of the flange over the last cycle."""
        if len(self._past) < 2:
            return 0.0
        (start_s, start_rad), (end_s, end_rad) = self._past[-2], self._past[-1]
        way = frame_of(end_rad)[:3, 3] - frame_of(start_rad)[:3, 3]
        return float(np.linalg.norm(way)) / (end_s - start_s)

    def joints_at(self, t_s: float) -> FloatArray:
        """Return the joints (6,) at a past time, interpolated between cycles."""
        past = list(self._past)
        if not past or t_s >= past[-1][0]:
            return self.joints.true_rad
        after = bisect_left(past, t_s, key=lambda cycle: cycle[0])
        if after == 0:
            return past[0][1]
        (start_s, start_rad), (end_s, end_rad) = past[after - 1 : after + 1]
        share = (t_s - start_s) / (end_s - start_s)
        return np.asarray(start_rad + share * (end_rad - start_rad))

    # -- commands ---------------------------------------------------------------------------------

    def require(self, session: object | None, *, servo: bool = False, still: bool = False) -> None:
        """Raise the first refusal: no operation right, error, servo off, running."""
        if session is not None and self.right is not session:
            raise RefusedCommandError(6020)
        if self.error:
            raise RefusedCommandError(5600)
        if self.stop_on:
            raise RefusedCommandError(5610)
        if servo and not self.servo:
            raise RefusedCommandError(2000)
        if still and (self.program or self._moving):
            raise RefusedCommandError(5640)

    def switch_servo(self, on: bool) -> None:
        """Switch the servo on (after a delay) or off (at once)."""
        if not on:
            self._servo_on_s, self.stopped_s = math.inf, self.now_s
            self.halt(end_stream=self.settings.mxt.ends_on_servo_off)
        elif math.isinf(self._servo_on_s):
            self._servo_on_s = self.now_s + self.settings.servo_delay_s

    def run_program(self, name: str) -> None:
        """Run the program ``name``: the one that opens the stream, or the one that presses."""
        name = self.require_program(name or self.loaded)
        if self.held:
            raise RefusedCommandError(5120)
        self.loaded = name
        if name in (self.settings.mxt.program, PLAIN):
            self.program = STREAM
            return
        if not set(WRITTEN) <= self.variables.keys():
            raise RefusedCommandError(4340)
        self.variables["MDO"] = 0.0
        self._probe = EmulatedProbe(
            self.joints.command_rad, self.variables, lambda: self.felt()[:3]
        )
        self.program = PROBE

    def require_program(self, name: str) -> str:
        """Return ``name`` without its extension; raises the refusal of an unknown program."""
        name = name.partition(".")[0]
        here = (self.settings.mxt.program, PLAIN, self.settings.fsc.program)
        if name not in here or name in self.missing_programs:
            raise RefusedCommandError(4140)
        return name

    def halt(self, *, end_stream: bool = True) -> None:
        """Stop at the present joints."""
        self._jog = self._moving = self._probe = None
        if self.program and end_stream:
            self.program, self.held = IDLE, True
        self.joints.command_rad = self.joints.true_rad.copy()

    def finish_program(self) -> None:
        """Handle the end of the program."""
        self.program = IDLE

    def raise_error(self, number: int) -> None:
        """Stop with an error; an emergency stop and an error of the stream switch the servo off."""
        self.error = number
        self.emergency = number in EMERGENCY_ERRORS
        self.switch_servo(False)
        self.halt()

    def release_emergency_stop(self) -> None:
        """Release the emergency stop; the error stays until the reset."""
        self.emergency = False

    def reset_error(self) -> None:
        """Clear the error; refused while the emergency stop is pressed."""
        if self.emergency:
            raise RefusedCommandError(self.error)
        self.error = 0

    # -- moves ------------------------------------------------------------------------------------

    def jog(self, mode: int, minus: int, plus: int) -> None:
        """Jog until the command is not repeated in time; axis bits from 1."""
        if mode not in (JOINT, STRAIGHT, TOOL):
            raise RefusedCommandError(self.settings.r3.error_unknown)
        signs = [float((plus >> k & 1) - (minus >> k & 1)) for k in range(6)]
        self._jog = ActiveJog(mode, np.array(signs), self.now_s + JOG_S)

    def move(self, target_rad: FloatArray, share: float, straight_mm_s: float | None) -> None:
        """Start a move of EXEC to joints (6,), by a share of their top speeds; on a straight line
        with at most ``straight_mm_s``.
        """
        start = self.joints.command_rad.copy()
        way = target_rad - start
        share = max(share * self.override / 100.0, 1e-3)
        lasts_s = max(float((np.abs(way) / SPEEDS_RAD_S).max()) / share, CYCLE_S)
        first, last = frame_of(start), frame_of(target_rad)
        if straight_mm_s is not None:
            way_mm = float(np.linalg.norm(last[:3, 3] - first[:3, 3]))
            lasts_s = max(lasts_s, way_mm / straight_mm_s * 100.0 / self.override)

        def point(part: float) -> FloatArray | None:
            near = start + part * way
            if straight_mm_s is None:
                return np.asarray(near)
            frame = last.copy()
            frame[:3, 3] = first[:3, 3] + part * (last[:3, 3] - first[:3, 3])
            return solve(frame, near)

        self._moving = ActiveMove(point, self.now_s, lasts_s)

    def _follow_move(self, moving: ActiveMove) -> None:
        part = min((self.now_s - moving.begun_s) / moving.lasts_s, 1.0)
        joints = moving.point(part)
        if joints is None:
            self.raise_error(2602)
            return
        self.joints.command_rad = joints
        if part >= 1.0:
            self._moving = None

    def _follow_probe(self, probe: EmulatedProbe) -> None:
        joints = probe.cycle()
        if joints is None:
            self.raise_error(2602)
            return
        self.joints.command_rad = joints
        if probe.step is ProbeProgramStep.ENDED:
            self._probe, self.program = None, IDLE

    def _follow_jog(self, jog: ActiveJog) -> None:
        if self.now_s >= jog.until_s or not self.servo or self.error:
            self._jog = None
            return
        share = self.override / 100.0
        if jog.mode == JOINT:
            step_rad = jog.signs * SPEEDS_RAD_S * (JOG_SHARE * share * CYCLE_S)
            after = self.joints.command_rad + step_rad
        else:
            found = self._jogged(jog, share * CYCLE_S)
            if found is None:
                self.raise_error(2602)
                return
            after = found
        if (np.abs(after) > LIMITS_RAD).any():
            self._jog = None
            return
        self.joints.command_rad = np.asarray(after)

    def _jogged(self, jog: ActiveJog, time_s: float) -> FloatArray | None:
        frame = frame_of(self.joints.command_rad)
        axes = frame[:3, :3] if jog.mode == TOOL else np.eye(3)
        frame[:3, 3] += axes @ jog.signs[:3] * JOG_MM_S * time_s
        turn = axes @ jog.signs[3:] * AXIS_TURN_RAD_S * time_s
        frame[:3, :3] = rotation_from_vector(turn) @ frame[:3, :3]
        return solve(frame, self.joints.command_rad)
