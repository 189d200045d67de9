"""Real-time stream of a MELFA arm as a state machine: ``step(now, inbox) -> outbox``.

Called once per cycle; it reads no clock and no socket. Start: packets without a command until the
first reply, then the replied position for ten cycles, then motion. Every command is checked before
it is sent, and leads the last echoed one by at most three cycles of travel. Replies are accepted if
they are complete, finite, plausible and newer than the last. Missing replies are counted in cycles
and in time, so that a stall of this program is detected like one of the link.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from enum import Enum, IntEnum

import numpy as np

from touchdown.backend.config import MelfaSettings
from touchdown.backend.core import (
    IDENTITY_ROTATION,
    LEVEL_TOLERANCE_RAD,
    Fault,
    FloatArray,
    RefusedError,
    rotation_vector,
    tilt_rad,
)
from touchdown.backend.devices.framing import ProtocolError
from touchdown.backend.devices.melfa import kinematics
from touchdown.backend.devices.melfa.faults import START, VOID, Refusal, lost_fault, oversize_fault
from touchdown.backend.devices.melfa.realtime_protocol import (
    CYCLE_S,
    AxisValues,
    BlockKind,
    MxtCommand,
    MxtRequest,
    decode_mxt_reply,
    encode_mxt_request,
)
from touchdown.backend.devices.protocols import REPLACED, STOPPED, CommandedMotion, refused_fault
from touchdown.backend.devices.streamed import (
    CycleInput,
    JogProgram,
    JointJogProgram,
    JointProgram,
    JointTravelProgram,
    MotionProgram,
    tilted_fault,
)

log = logging.getLogger("touchdown.app.melfa")

FIRST_BYTES = 16  # logged of a refused datagram
COMMAND_JOINTS, FEEDBACK_JOINTS = 2, 8
# Monitor types of every reply: joints commanded, measured, filtered, and currents.
MONITORS = (COMMAND_JOINTS, FEEDBACK_JOINTS, 5, 11)
TURN_RAD = 10.0  # limit of a plausible joint angle
_HALF = 1 << 31
_WRAP = 1 << 32


@dataclass(slots=True)
class DatagramCounts:
    """Counts of datagrams since the start of the stream."""

    accepted: int = 0
    refused: int = 0  # wrong size, type, numbers
    repeated: int = 0  # same counter as the last accepted one
    old: int = 0  # overtaken by a newer one
    skipped: int = 0  # counters that never came


@dataclass(frozen=True, slots=True)
class AcceptedReply:
    """One accepted reply: (6,) joints as commanded and as measured, and the missed cycles."""

    command_rad: FloatArray
    feedback_rad: FloatArray
    timeouts: int


class ReplyFilter:
    """Accepts the newest valid datagram and counts the others."""

    def __init__(self) -> None:
        self.counts = DatagramCounts()
        # Reason and first bytes of the last refused datagram since the last accepted one.
        self.refusal: Refusal | None = None
        self.refused = b""
        self._counter: int | None = None

    def take(self, datagrams: Iterable[bytes]) -> AcceptedReply | None:
        """Return the newest acceptable echo so far, None without one."""
        newest: AcceptedReply | None = None
        for data in datagrams:
            told = _acceptable(data)
            if isinstance(told, Refusal):
                self.counts.refused += 1
                self.refusal, self.refused = told, data[:FIRST_BYTES]
            elif self._is_newer(told[0]):
                newest, self.refusal = told[1], None
                self.counts.accepted += 1
        return newest

    def _is_newer(self, counter: int) -> bool:
        if self._counter is not None:
            ahead = (counter - self._counter) % _WRAP
            if ahead == 0:
                self.counts.repeated += 1
                return False
            if ahead >= _HALF:
                self.counts.old += 1
                return False
            self.counts.skipped += ahead - 1
        self._counter = counter
        return True


def _acceptable(data: bytes) -> tuple[int, AcceptedReply] | Refusal:
    """Return counter and echo of one datagram, or the reason why it is not used."""
    try:
        reply = decode_mxt_reply(data)
    except ProtocolError:
        return Refusal.UNREADABLE
    if reply.monitors != MONITORS:
        return Refusal.OTHER_DATA
    command, feedback = reply.blocks[0], reply.blocks[1]
    assert isinstance(command, AxisValues)
    assert isinstance(feedback, AxisValues)
    wanted, found = command.axes[:6], feedback.axes[:6]
    if not all(-TURN_RAD <= angle <= TURN_RAD for angle in (*wanted, *found)):
        return Refusal.OUT_OF_RANGE
    return reply.counter, AcceptedReply(np.array(wanted), np.array(found), reply.timeouts)


class SilenceLevel(IntEnum):
    """Level of a silence, increasing."""

    GO = 0
    STAND = 1  # the command is kept, not extrapolated
    HOLD = 2  # stand still; continues by itself with the replies. A press is void.
    FAULT = 3  # latched: end the stream, stop by the command channel


STAND_CYCLES = 2
HOLD_CYCLES = 10
FAULT_CYCLES = 29


def silence_level(missed: int, silent_s: float, cycle_s: float) -> SilenceLevel:
    """Return the level for ``missed`` replies in a row and ``silent_s`` since the last accepted."""
    # The tolerance counts a cycle that ends exactly now.
    cycles = max(missed, int(silent_s / cycle_s + 1e-6))
    if cycles >= FAULT_CYCLES:
        return SilenceLevel.FAULT
    if cycles >= HOLD_CYCLES:
        return SilenceLevel.HOLD
    return SilenceLevel.STAND if cycles >= STAND_CYCLES else SilenceLevel.GO


HELD_CYCLES = 10
END_PACKETS = 3
LEAD_CYCLES = 3
LEAST_LEAD_MM_S = 20.0
# A hand that leans more at the start is not moved: this program never leaves it so.
TILT_RAD = math.radians(20.0)
# A step above this multiple of the speed limit is reduced; more in a row than this are a fault.
OVERSIZE, STORM_CYCLES = 2.0, 10
LEAST_LEAD_RAD_S = math.radians(5.0)
END = encode_mxt_request(MxtRequest(MxtCommand.END))
NO_TIME, NO_FORCE = np.empty(0), np.empty((0, 3))


class Phase(Enum):
    """Phase of the stream."""

    IDLE = "idle"
    OPENING = "opening"
    HOLDING = "holding"
    OPEN = "open"
    ENDING = "ending"


@dataclass(frozen=True, slots=True)
class StreamInput:
    """Input since the last step: datagrams, and wrench samples (n,), (n, 3) of force."""

    datagrams: tuple[bytes, ...] = ()
    t_s: FloatArray = field(default_factory=lambda: NO_TIME)
    force_n: FloatArray = field(default_factory=lambda: NO_FORCE)


@dataclass(frozen=True, slots=True)
class StreamOutput:
    """Output of a step: one packet or none, measured position of ``G`` (3,), latched fault."""

    packet: bytes | None = None
    pose_mm: FloatArray | None = None
    fault: Fault | None = None


class StreamCore:
    """State machine of the stream; not thread-safe."""

    def __init__(self, settings: MelfaSettings, placing: kinematics.MelfaPlacement) -> None:
        self._settings, self._placing = settings, placing
        self.phase = Phase.IDLE
        self.replies = ReplyFilter()
        self.holds = 0  # number of holds since the start of the stream
        self.sent_rad = np.zeros(6)  # (6,) joints of the last command
        self.program: MotionProgram | JointProgram | None = None
        self._restart(0.0)

    def _restart(self, now_s: float) -> None:
        self.replies, self.holds = ReplyFilter(), 0
        self.timeouts = 0  # cycles without a packet, as the controller counts them
        self._counter = self._left = 0
        self.missed = 0  # cycles in a row without an accepted reply
        self._begun_s = self._heard_s = now_s
        self._echo_mm = np.zeros(3)
        self.measured_mm = np.zeros(3)  # (3,) last measured position of ``G``
        self.command_mm = np.zeros(3)  # (3,) commanded position of ``G`` in the bench frame
        self.turn: FloatArray = IDENTITY_ROTATION  # (3, 3) commanded turn of the hand
        self.measured_rad = np.zeros(6)  # (6,) last measured joints
        self._echo_rad = np.zeros(6)
        self._rest()
        self._holding = False
        self._oversize = 0

    def _rest(self) -> None:
        self.velocity_mm_s, self._turning_rad_s = np.zeros(3), np.zeros(3)
        self._joints_rad_s = np.zeros(6)

    # -- commands ---------------------------------------------------------------------------------

    def begin(self, now_s: float) -> None:
        """Start the stream; the controller program must be running."""
        self._restart(now_s)
        self.phase = Phase.OPENING

    def run(self, program: MotionProgram | JointProgram) -> None:
        """Replace the active program from the next cycle on. After a STOP the program ends at once:
        it must not wait for the next stream.
        """
        if self.phase in (Phase.IDLE, Phase.ENDING):
            program.motion.end(STOPPED)
            return
        if self.program is not None and self.program is not program:
            self.program.motion.end(REPLACED)
        self.program = program

    def halt(self) -> None:
        """Brake to standstill; the stream continues."""
        if self.program is not None:
            self.program.motion.end(STOPPED)
            self.program = self._braking(CommandedMotion({}))

    def _braking(self, motion: CommandedMotion) -> MotionProgram | JointProgram:
        if isinstance(self.program, JointTravelProgram | JointJogProgram):
            return JointJogProgram(motion, self._joints_rad_s)
        level = self.turn is IDENTITY_ROTATION
        return JogProgram(motion, self.velocity_mm_s, None if level else self._turning_rad_s)

    def stop(self, fault: Fault = STOPPED) -> None:
        """End the stream at once: only end packets follow."""
        if self.program is not None:
            self.program.motion.end(fault)
            self.program = None
        if self.phase is not Phase.IDLE:
            self.phase, self._left = Phase.ENDING, END_PACKETS

    # -- cycle ------------------------------------------------------------------------------------

    def step(self, now_s: float, inbox: StreamInput) -> StreamOutput:
        """Process the input and return the output; never raises."""
        if self.phase in (Phase.IDLE, Phase.ENDING):
            return self._quiet()
        echo = self.replies.take(inbox.datagrams)
        if self.phase is Phase.OPENING:
            return self._open(now_s, echo)
        silent_s = now_s - self._heard_s
        if echo is None:
            self.missed += 1
        else:
            # A reply one cycle after the last one is not a silence.
            silent_s -= CYCLE_S
            self.missed = 0
            self._hear(now_s, echo)
        level = silence_level(self.missed, silent_s, CYCLE_S)
        if echo is not None and level < SilenceLevel.HOLD:
            level = SilenceLevel.GO
        if level is SilenceLevel.FAULT:
            cycles = max(self.missed, int(silent_s / CYCLE_S))
            return self._fail(self._lost(lost_fault(cycles)))
        self._descend_ladder(level)
        if level is SilenceLevel.GO and self.phase is Phase.OPEN:
            refused = self._move(now_s, inbox)
            if refused is not None:
                return self._fail(refused)
        elif level is not SilenceLevel.GO:
            self._rest()
        if self.phase is Phase.HOLDING:
            self._left -= 1
            if self._left <= 0:
                self.phase = Phase.OPEN
        return StreamOutput(self._packet(), None if echo is None else self.measured_mm)

    def _quiet(self) -> StreamOutput:
        if self.phase is Phase.ENDING and self._left:
            self._left -= 1
            return StreamOutput(END)
        self.phase = Phase.IDLE
        return StreamOutput()

    def _open(self, now_s: float, echo: AcceptedReply | None) -> StreamOutput:
        if echo is None:
            if now_s - self._begun_s > self._settings.mxt.start_timeout_s:
                return self._fail(self._lost(START))
            self._counter += 1
            null = MxtRequest(MxtCommand.NONE, monitors=MONITORS, counter=self._counter)
            return StreamOutput(encode_mxt_request(null))
        turn = self._placing.turn(echo.command_rad)
        if not tilt_rad(turn) <= TILT_RAD:
            return self._fail(tilted_fault(tilt_rad(turn), "teaching box"))
        # The first command is the position replied by the controller.
        self.sent_rad = echo.command_rad
        self.turn = (
            IDENTITY_ROTATION
            if np.linalg.norm(rotation_vector(turn)) <= LEVEL_TOLERANCE_RAD
            else turn
        )
        self.command_mm = self._placing.pivot_mm(self.sent_rad)
        self._hear(now_s, echo)
        self.phase, self._left = Phase.HOLDING, HELD_CYCLES
        return StreamOutput(self._packet(), self.measured_mm)

    def _lost(self, silent: Fault) -> Fault:
        """Return ``silent``, or the fault of replies that came and cannot be used."""
        why = self.replies.refusal
        if why is None:
            return silent
        log.info("refused on the real-time port: %s", self.replies.refused.hex(" "))
        what, step = why.value
        step = f"{step} Then press Reset and connect the arm again."
        return replace(silent, what=what, next_step=step)

    def _hear(self, now_s: float, echo: AcceptedReply) -> None:
        self._heard_s, self.timeouts = now_s, echo.timeouts
        self._echo_rad, self.measured_rad = echo.command_rad, echo.feedback_rad
        self._echo_mm = self._placing.pivot_mm(echo.command_rad)
        self.measured_mm = self._placing.pivot_mm(echo.feedback_rad)

    def _descend_ladder(self, level: SilenceLevel) -> None:
        if level is not SilenceLevel.HOLD:
            self._holding = False
            return
        self.holds += not self._holding
        self._holding = True
        if self.program is not None:
            if self.program.fragile:
                self.program.motion.end(VOID)
            self.program.still()

    def _move(self, now_s: float, inbox: StreamInput) -> Fault | None:
        """Advance the program by one cycle; return a fault that ends the stream."""
        program = self.program
        if program is None:
            self._rest()
            return None
        felt = CycleInput(
            now_s, CYCLE_S, self.command_mm, self.measured_mm, inbox.t_s, inbox.force_n,
            self.turn, self.sent_rad, self.measured_rad,
        )  # fmt: skip
        try:
            if isinstance(program, JointTravelProgram | JointJogProgram):
                command_mm, turn, joints = self._next_joints(program, felt)
            else:
                command_mm, turn, joints = self._next_place(program, felt)
            kinematics.check_joints(joints)
            kinematics.check_step(self.sent_rad, joints, self._settings.mxt.step_fraction)
        except RefusedError as error:
            program.motion.end(refused_fault(error))
            self.program = None
            self._rest()
            return None
        if self._oversize > STORM_CYCLES:
            return oversize_fault(self._oversize)
        if turn is not self.turn:
            self._turning_rad_s = rotation_vector(turn @ self.turn.T) / CYCLE_S
        self.velocity_mm_s = (command_mm - felt.command_mm) / CYCLE_S
        self._joints_rad_s = (joints - self.sent_rad) / CYCLE_S
        self.command_mm, self.turn, self.sent_rad = command_mm, turn, joints
        return None

    def _next_place(
        self, program: MotionProgram, felt: CycleInput
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return position, turn and joints of the next command of a hand program."""
        wanted_mm = program.next_mm(felt)
        most_mm = OVERSIZE * CYCLE_S * max(program.speed_mm_s, LEAST_LEAD_MM_S)
        well = bool(np.linalg.norm(wanted_mm - self.command_mm) <= most_mm)
        self._oversize = 0 if well else self._oversize + 1
        command_mm = self._within_lead(wanted_mm, program.speed_mm_s)
        turn = self.turn if program.turn is None else program.turn
        if command_mm is not wanted_mm:
            program.cut(command_mm)
            turn = self.turn
        joints = self._placing.joints(command_mm, self.sent_rad, turn)
        if turn is not self.turn and self._ahead_rad(joints) > self._lead_rad(program):
            # Stand, including the turn, until the replies have caught up.
            program.still()
            return self.command_mm, self.turn, self.sent_rad
        return command_mm, turn, joints

    def _next_joints(
        self, program: JointProgram, felt: CycleInput
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return position, turn and joints of the next command of a joint program."""
        joints = program.next_rad(felt)
        if self._ahead_rad(joints) > self._lead_rad(program):
            program.still()
            joints = self.sent_rad
        return self._placing.pivot_mm(joints), self._placing.turn(joints), joints

    def _ahead_rad(self, joints_rad: FloatArray) -> float:
        return float(np.abs(joints_rad - self._echo_rad).max())

    def _lead_rad(self, program: MotionProgram | JointProgram) -> float:
        """Return the permitted lead of a joint: three cycles; turns move joints faster."""
        if isinstance(program, JointTravelProgram | JointJogProgram):
            return LEAD_CYCLES * CYCLE_S * max(program.speed_rad_s, LEAST_LEAD_RAD_S)
        return LEAD_CYCLES * float((kinematics.STEPS_RAD * self._settings.mxt.step_fraction).max())

    def _within_lead(self, wanted_mm: FloatArray, speed_mm_s: float) -> FloatArray:
        lead_mm = LEAD_CYCLES * CYCLE_S * max(speed_mm_s, LEAST_LEAD_MM_S)
        ahead = wanted_mm - self._echo_mm
        far_mm = math.hypot(*ahead.tolist())
        if far_mm <= lead_mm:
            return wanted_mm
        # Standing is always permitted: pulling back would be a motion.
        cut = self._echo_mm + ahead * (lead_mm / far_mm)
        here_mm = float(np.linalg.norm(self.command_mm - self._echo_mm))
        return self.command_mm if here_mm > lead_mm else np.asarray(cut)

    def _packet(self) -> bytes:
        self._counter += 1
        target = AxisValues(BlockKind.JOINT, (*self.sent_rad.tolist(), 0.0, 0.0))
        return encode_mxt_request(MxtRequest(MxtCommand.MOVE, target, MONITORS, self._counter))

    def _fail(self, fault: Fault) -> StreamOutput:
        self.stop(fault)
        self._left -= 1
        return StreamOutput(END, fault=fault)
