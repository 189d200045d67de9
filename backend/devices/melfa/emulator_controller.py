"""State of the emulated controller."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from touchdown.backend.config import MelfaSettings
from touchdown.backend.core import FloatArray
from touchdown.backend.devices.framing import WireError
from touchdown.backend.devices.melfa import protocol_monitor
from touchdown.backend.devices.melfa.emulator_arm import (
    LIMITS_RAD,
    SPEEDS_RAD_S,
    WRITTEN,
    EmulatedProbe,
    Joints,
    Step,
    frame_of,
    solve,
)
from touchdown.backend.devices.melfa.protocol_monitor import START, Reply, Types
from touchdown.backend.devices.melfa.protocol_mxt import CYCLE_S, Block, Kind, Values
from touchdown.backend.devices.melfa.protocol_r3 import EMERGENCY_ERRORS, Run, Stop
from touchdown.backend.emulation import Pace

JOG_S = 0.140
"""A jog ends by itself this long after the last command."""
JOG_SHARE = 0.10
"""Of the top speed of a joint, at full override."""
JOG_MM_S = 250.0
"""Along a straight axis, at full override."""
AXIS_TURN_RAD_S = 0.5
READY_RAD = np.radians([0.0, 20.0, 100.0, 0.0, 60.0, 0.0])
"""Where it stands when it is switched on: the hand points down."""
STREAM, PROBE, IDLE = "stream", "probe", ""
PLAIN = "MXT"
"""The stream by the name that clients of other makers give its program."""
JOINT, STRAIGHT, TOOL = 0, 1, 2
PAST = 300
"""Cycles whose joints are remembered: somewhat more than a second."""


class RefusedCommandError(Exception):
    """The controller refuses; ``number`` is its error."""

    def __init__(self, number: int) -> None:
        super().__init__(str(number))
        self.number = number


@dataclass(slots=True)
class Jogging:
    """A jog in progress: how fast in which coordinates, and until when."""

    mode: int
    signs: FloatArray
    until_s: float


@dataclass(slots=True)
class Moving:
    """A move of EXEC: ``point(share)`` gives joints, or None where there are none."""

    point: Callable[[float], FloatArray | None]
    begun_s: float
    lasts_s: float


class EmulatedController:
    """``settings`` are those of the driver; ``streaming``: the stream runs from the start."""

    def __init__(
        self,
        settings: MelfaSettings,
        *,
        start_rad: FloatArray | None = None,
        streaming: bool = False,
    ) -> None:
        self.settings = settings
        start = READY_RAD if start_rad is None else start_rad
        self.joints = Joints(start, CYCLE_S, 1e-3 * settings.arm_lag_ms)
        self._past: deque[tuple[float, FloatArray]] = deque(maxlen=PAST)
        self.now_s = 0.0
        self._begun_s: float | None = None
        self._cycles = 0
        self.override = 100
        self.right: object | None = None
        self._servo_on_s = math.inf
        self.error = 0
        self.stopped_s = math.inf
        """When an error or a servo that was switched off last ended all motion."""
        self.program, self.loaded = IDLE, settings.mxt.program
        self.missing_programs: set[str] = set()
        self.held = self.stop_on = self.emergency = False
        self._jog: Jogging | None = None
        self._moving: Moving | None = None
        self._probe: EmulatedProbe | None = None
        self.variables: dict[str, float] = {}
        """Of the force program."""
        self.felt: Callable[[], FloatArray] = lambda: np.zeros(6)
        """Wrench on the tool (6,), N and N·m in axes of the base: the controller's own sensor."""
        self.on_cycle: Callable[[], None] = _nothing
        """Called once per cycle: the stream counts its silence there."""
        if streaming:
            self._servo_on_s, self.program = -math.inf, STREAM

    # -- state ------------------------------------------------------------------------------------

    @property
    def servo(self) -> bool:
        """Whether the servo is on."""
        return self.now_s >= self._servo_on_s

    @property
    def moving(self) -> bool:
        """Whether a jog or a move is under way."""
        return self._jog is not None or self._moving is not None

    def words(self) -> tuple[Run, Stop]:
        """Return run and stop status."""
        run = Run.REPEAT | Run.OPERATION_ENABLED
        run |= Run.SERVO_ON if self.servo else Run(0)
        run |= Run.RUNNING if self.program or self._moving else Run(0)
        stop = Stop.EMERGENCY if self.emergency else Stop(0)
        stop |= Stop.STOP if self.stop_on else Stop(0)
        stop |= Stop.WAIT if self.held else Stop(0)
        return run, stop

    @property
    def next_cycle_s(self) -> float:
        """When the present cycle ends; never before time has begun."""
        if self._begun_s is None:
            return math.inf
        return self._begun_s + (self._cycles + 1) * CYCLE_S

    def advance(self, now_s: float) -> None:
        """Run the cycles up to ``now_s``."""
        if self._begun_s is None:
            self._begun_s = now_s
        # Counted, not added up: so a cycle that ends exactly now is not left to rounding.
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

    def joints_at(self, t_s: float) -> FloatArray:
        """Return (6,) where the joints were then, between two cycles; at most where they are."""
        past = list(self._past)
        if not past or t_s >= past[-1][0]:
            return self.joints.true_rad
        after = bisect_left(past, t_s, key=lambda cycle: cycle[0])
        if after == 0:
            return past[0][1]
        (start_s, start_rad), (end_s, end_rad) = past[after - 1 : after + 1]
        share = (t_s - start_s) / (end_s - start_s)
        return np.asarray(start_rad + share * (end_rad - start_rad))

    # -- orders -----------------------------------------------------------------------------------

    def require(self, session: object | None, *, servo: bool = False, still: bool = False) -> None:
        """Raise the refusal that comes first: no right, error, servo off, running."""
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
        """Switch on (it takes its time) or off (at once)."""
        if not on:
            self._servo_on_s, self.stopped_s = math.inf, self.now_s
            self.halt(end_stream=self.settings.mxt.ends_on_servo_off)
        elif math.isinf(self._servo_on_s):
            self._servo_on_s = self.now_s + self.settings.servo_delay_s

    def run_program(self, name: str) -> None:
        """Run the program ``name``: the one that opens the stream, or the one that presses."""
        name = name or self.loaded
        self.require_program(name)
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

    def require_program(self, name: str) -> None:
        """Raise the refusal of a program that is not in the controller."""
        here = (self.settings.mxt.program, PLAIN, self.settings.fsc.program)
        if name not in here or name in self.missing_programs:
            raise RefusedCommandError(4140)

    def halt(self, *, end_stream: bool = True) -> None:
        """Stand still where the joints are."""
        self._jog = self._moving = self._probe = None
        if self.program and end_stream:
            self.program, self.held = IDLE, True
        self.joints.command_rad = self.joints.true_rad.copy()

    def finish_program(self) -> None:
        """Take note that the program has come to its end."""
        self.program = IDLE

    def raise_error(self, number: int) -> None:
        """Stop with an error; an emergency stop and an error of the stream switch the servo off."""
        self.error = number
        self.emergency = number in EMERGENCY_ERRORS
        self.switch_servo(False)
        self.halt()

    def press_emergency_stop(self, number: int = 50) -> None:
        """Someone pressed an emergency stop."""
        self.raise_error(number)

    def release_emergency_stop(self) -> None:
        """Someone turned it back; the error stays until it is reset."""
        self.emergency = False

    def reset_error(self) -> None:
        """Clear the error; refused while the emergency stop is pressed."""
        if self.emergency:
            raise RefusedCommandError(self.error)
        self.error = 0

    # -- moves ------------------------------------------------------------------------------------

    def jog(self, mode: int, minus: int, plus: int) -> None:
        """Move as long as this comes again in time; axis bits from 1."""
        if mode not in (JOINT, STRAIGHT, TOOL):
            raise RefusedCommandError(self.settings.r3.error_unknown)
        signs = [float(bool(plus >> k & 1)) - float(bool(minus >> k & 1)) for k in range(6)]
        self._jog = Jogging(mode, np.array(signs), self.now_s + JOG_S)

    def move(self, target_rad: FloatArray, *, straight: bool, speed_share: float) -> None:
        """Begin a move of EXEC to joints (6,)."""
        start = self.joints.command_rad.copy()
        way = target_rad - start
        share = max(speed_share * self.override / 100.0, 1e-3)
        lasts_s = max(float((np.abs(way) / SPEEDS_RAD_S).max()) / share, CYCLE_S)
        first, last = frame_of(start), frame_of(target_rad)

        def point(part: float) -> FloatArray | None:
            near = start + part * way
            if not straight:
                return np.asarray(near)
            frame = last.copy()
            frame[:3, 3] = first[:3, 3] + part * (last[:3, 3] - first[:3, 3])
            return solve(frame, near)

        self._moving = Moving(point, self.now_s, lasts_s)

    def _follow_move(self, moving: Moving) -> None:
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
        if probe.step is Step.ENDED:
            self._probe, self.program = None, IDLE

    def _follow_jog(self, jog: Jogging) -> None:
        if self.now_s >= jog.until_s or not self.servo or self.error:
            self._jog = None
            return
        share = self.override / 100.0
        if jog.mode == JOINT:
            after = self.joints.command_rad + jog.signs * SPEEDS_RAD_S * (
                JOG_SHARE * share * CYCLE_S
            )
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

    def _jogged(self, jog: Jogging, time_s: float) -> FloatArray | None:
        frame = frame_of(self.joints.command_rad)
        axes = frame[:3, :3] if jog.mode == TOOL else np.eye(3)
        frame[:3, 3] += axes @ jog.signs[:3] * JOG_MM_S * time_s
        turn = axes @ jog.signs[3:] * AXIS_TURN_RAD_S * time_s
        x, y, z = turn.tolist()
        small = np.array([[1.0, -z, y], [z, 1.0, -x], [-y, x, 1.0]])
        unitary, _, right = np.linalg.svd(small @ frame[:3, :3])
        frame[:3, :3] = unitary @ right
        return solve(frame, self.joints.command_rad)


def _nothing() -> None:
    """Nothing waits for the cycle."""


TYPE_FORCE = 901
COUNTER_TURN = 1 << 32


class EmulatedMonitor:
    """``wrench(now_s)`` gives six values, N and N·m; a type it does not know is a zero block."""

    def __init__(
        self, wrench: Callable[[float], Sequence[float]], *, type_force: int = TYPE_FORCE
    ) -> None:
        self._wrench, self._force = wrench, type_force
        self.pace = Pace()
        self._types: Types = (0, 0, 0, 0)
        self._counter = 0

    def receive(self, now_s: float, data: bytes) -> list[bytes]:
        """Take one request."""
        try:
            request = protocol_monitor.decode_request(data)
        except WireError:
            return []
        if request.command == START:
            self._types = request.types
            self.pace.begin(now_s, CYCLE_S)
        else:
            self.pace.end()
        return []

    def due(self, now_s: float) -> list[bytes]:
        """Return the packets up to now."""
        late, times = self.pace.due(now_s)
        self._counter = (self._counter + late) % COUNTER_TURN
        return [self._packet(t_s) for t_s in times]

    def _packet(self, now_s: float) -> bytes:
        self._counter = (self._counter + 1) % COUNTER_TURN
        first, second, third, fourth = (self._block(now_s, number) for number in self._types)
        kinds = {
            number: Kind.FORCE if number == self._force else Kind.NONE for number in self._types
        }
        reply = Reply(self._types, (first, second, third, fourth), self._counter)
        return protocol_monitor.encode_reply(reply, kinds)

    def _block(self, now_s: float, number: int) -> Block:
        if number != self._force:
            return None
        return Values(Kind.FORCE, tuple(self._wrench(now_s)))
