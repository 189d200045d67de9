"""Status of the controller, polled."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from touchdown.backend.config import MelfaSettings
from touchdown.backend.core import IDENTITY_ROTATION, Fault, FaultError, FloatArray
from touchdown.backend.devices.framing import WireError
from touchdown.backend.devices.melfa.console import Console
from touchdown.backend.devices.melfa.faults import controller_fault, link_fault
from touchdown.backend.devices.melfa.kinematics import Placing, hand_of
from touchdown.backend.devices.melfa.protocol_mxt import CYCLE_S
from touchdown.backend.devices.melfa.protocol_r3 import (
    Reading,
    Request,
    Run,
    State,
    read_axes,
    read_state,
)
from touchdown.backend.devices.melfa.r3_client import TIMEOUT_S, Ticket
from touchdown.backend.devices.melfa.sockets import Wires
from touchdown.backend.devices.melfa.stream import Phase, StreamCore
from touchdown.backend.devices.protocols import (
    ArmStatus,
    CommandedMotion,
    DeviceState,
    RobotMode,
    SafetyMode,
)
from touchdown.backend.devices.streamed import (
    JointFollow,
    JointTravel,
    Loop,
    StreamedOrders,
    Travel,
    TurningFollow,
    TurningTravel,
    jogging,
)

STATE_S = 0.1
PLACE_S = 0.04
"""Only while no program runs: the controller asks for 100 ms between exchanges then."""
PROBING_STATE_S = 0.35
STATE, PLACE = Request("STATE"), Request("PPOS", "F")

Ask = Callable[[Request, float], Ticket]


class Watch:
    """``step`` once per cycle; it never waits."""

    def __init__(self, ask: Ask, placing: Placing, euler: str) -> None:
        self._ask, self._placing, self._euler = ask, placing, euler
        self._ticket: Ticket | None = None
        self._next_s = -math.inf
        self._state_s = -math.inf
        self.state: State | None = None
        self.place_mm: FloatArray | None = None
        """(3,) where ``G`` is, of the last answer; taken by who reads it."""
        self.fault: Fault | None = None
        """An error of the controller, or a program that ended by itself."""

    @property
    def ended(self) -> bool:
        """Whether the controller has told that no program runs."""
        return self.state is not None and Run.RUNNING not in self.state.run

    def step(self, now_s: float, *, streaming: bool, probing: bool = False) -> None:
        """Read the answer that came, ask the next question when it is time.

        ``probing``: the force program runs, so that questions keep their distance; then most of
        them are for the place.
        """
        if self._ticket is not None:
            if not self._ticket.done:
                return
            self._read(self._ticket, streaming=streaming)
            self._ticket = None
        if now_s < self._next_s:
            return
        due = streaming or now_s - self._state_s >= (PROBING_STATE_S if probing else STATE_S)
        if due:
            self._state_s = now_s
        self._next_s = now_s + (STATE_S if streaming else PLACE_S)
        self._ticket = self._ask(STATE if due else PLACE, TIMEOUT_S)

    def _read(self, ticket: Ticket, *, streaming: bool) -> None:
        try:
            if ticket.request == PLACE:
                self.place_mm = self._of_reading(read_axes(ticket.answer))
                return
            self.state = state = read_state(ticket.answer)
        except FaultError as error:
            self.fault = error.fault
        except WireError as error:
            self.fault = link_fault(f"The controller does not answer as it should: {error}.")
        else:
            if state.error:
                self.fault = controller_fault(state.error)
            elif streaming and Run.RUNNING not in state.run:
                self.fault = ENDED

    def _of_reading(self, reading: Reading) -> FloatArray:
        axes = dict(zip(reading.names, reading.values, strict=True))
        x, y, z, a, b, c = (axes[name] for name in "XYZABC")
        return self._placing.from_flange(np.array([x, y, z]), hand_of(a, b, c, self._euler))


ENDED = Fault(
    "MXT-ENDED",
    "The controller's real-time program has ended by itself.",
    "The arm stands still; the gripper was not opened.",
    "Look at the controller, press Reset, then connect the arm again.",
    "arm",
)


class Orders:
    """Makes programs for one arm; ``level``: those that any streamed arm has."""

    def __init__(self, settings: MelfaSettings) -> None:
        self.placing = Placing(
            settings.origin_mm,
            math.radians(settings.yaw_deg),
            math.radians(settings.hand_deg),
            settings.tool_mm,
        )
        self.level = StreamedOrders(
            Loop(
                CYCLE_S,
                arm_lag_s=1e-3 * settings.arm_lag_ms,
                sensor_lag_s=1e-3 * settings.sensor_lag_ms,
            )
        )

    def under_way(self, core: StreamCore) -> bool:
        """Whether a motion has begun and not ended."""
        program = core.program
        return program is not None and not program.motion.done

    def travel(
        self,
        core: StreamCore,
        target: tuple[FloatArray, FloatArray],
        speeds: tuple[float, float],
    ) -> CommandedMotion:
        """Begin a straight move to (3,) mm and (3, 3) turn, with mm/s and rad/s."""
        target_mm, turn = target
        x, y, z = target_mm.tolist()
        motion = CommandedMotion({"x_mm": x, "y_mm": y, "z_mm": z, "speed_mm_s": speeds[0]})
        self.level.leave()
        if turn is IDENTITY_ROTATION and core.turn is IDENTITY_ROTATION:
            core.run(Travel(motion, target_mm, speeds[0]))
        else:
            core.run(TurningTravel(motion, target, speeds))
        return motion

    def jog(
        self, core: StreamCore, velocity_mm_s: FloatArray, turn_rad_s: FloatArray, until_s: float
    ) -> CommandedMotion:
        """Begin to follow a velocity and a turn, or go on with others."""
        if core.turn is IDENTITY_ROTATION and not turn_rad_s.any():
            return self.level.follow(core, velocity_mm_s, until_s)
        program = core.program
        self.level.leave()
        if not isinstance(program, TurningFollow) or program.motion.done:
            program = TurningFollow(jogging(velocity_mm_s, turn_rad_s))
            core.run(program)
        program.renew(velocity_mm_s, turn_rad_s, until_s)
        return program.motion

    def jog_joints(
        self, core: StreamCore, speeds_rad_s: FloatArray, until_s: float
    ) -> CommandedMotion:
        """Begin to turn joints, or go on with other speeds."""
        program = core.program
        self.level.leave()
        if not isinstance(program, JointFollow) or program.motion.done:
            speeds = {f"j{k}_rad_s": v for k, v in enumerate(speeds_rad_s.tolist(), 1)}
            program = JointFollow(CommandedMotion(speeds))
            core.run(program)
        program.renew(speeds_rad_s, until_s)
        return program.motion

    def travel_joints(
        self, core: StreamCore, target_rad: FloatArray, speed_rad_s: float
    ) -> CommandedMotion:
        """Begin to turn all joints to their ends."""
        ends = {f"j{k}_rad": v for k, v in enumerate(target_rad.tolist(), 1)}
        motion = CommandedMotion({**ends, "speed_rad_s": speed_rad_s})
        self.level.leave()
        core.run(JointTravel(motion, target_rad, speed_rad_s))
        return motion


PHASES = {phase: float(place) for place, phase in enumerate(Phase)}


def words_of(
    device: DeviceState, state: State | None, fault: Fault | None, *, moving: bool
) -> ArmStatus:
    """Return the status words; ``state`` is what the controller told last."""
    if device is DeviceState.CLOSED:
        return ArmStatus(RobotMode.DISCONNECTED, SafetyMode.UNKNOWN, 0.0, 0)
    override = 0.0 if state is None else state.override / 100.0
    error = 0 if state is None else state.error
    if device is DeviceState.CONNECTING:
        return ArmStatus(RobotMode.CONNECTING, SafetyMode.UNKNOWN, override, error)
    safety = SafetyMode.NORMAL
    if device is DeviceState.FAULT:
        stopped = fault is not None and fault.code == "HW-STOP"
        safety = SafetyMode.HW_STOP if stopped else SafetyMode.FAULT
    mode = RobotMode.READY
    if state is not None and Run.SERVO_ON not in state.run:
        mode = RobotMode.SERVO_OFF
    elif moving:
        mode = RobotMode.MOVING
    return ArmStatus(mode, safety, override, error)


def trace_of(core: StreamCore, orders: Orders) -> tuple[float, ...]:
    """Return the values of ``TRACE``; the caller holds the lock of the stream."""
    return (
        *core.command_mm.tolist(),
        *core.measured_mm.tolist(),
        *core.sent_rad.tolist(),
        *core.measured_rad.tolist(),
        *(
            PHASES[core.phase],
            core.missed,
            core.holds,
            orders.under_way(core),
            orders.level.press_n(),
        ),
    )


def raw_fields(
    core: StreamCore, wires: Wires, settings: MelfaSettings, console: Console
) -> Mapping[str, str | float]:
    """Return them by name; ``command_mm`` is of ``G`` in the bench."""
    counts, times = core.replies.counts, wires.times
    x, y, z = core.command_mm.tolist()
    return {
        "kind": "melfa",
        "host": settings.host,
        "stream": core.phase.value,
        "x_mm": x,
        "y_mm": y,
        "z_mm": z,
        "holds": core.holds,
        "refused": counts.refused,
        "repeated": counts.repeated,
        "old": counts.old,
        "skipped": counts.skipped,
        "controller_missed": core.timeouts,
        "bad_replies": wires.bad_replies,
        "late_cycles": times.late,
        "latest_ms": 1e3 * times.latest_s,
        "realtime": "yes" if times.realtime else "no",
        "time_limit": "none" if console.unlimited else "set",
        **({"notice": console.notice} if console.notice else {}),
    }
