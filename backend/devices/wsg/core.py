"""State machine of the WSG driver."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from touchdown.backend.config import WsgSettings
from touchdown.backend.core import Fault, FaultError
from touchdown.backend.devices.protocols import CommandedMotion, GripStatus
from touchdown.backend.devices.wsg import protocol
from touchdown.backend.devices.wsg.protocol import (
    Command,
    GraspState,
    Reply,
    Request,
    Status,
    SystemFlag,
)

NAME = "gripper"
DEVICE_FAULTS = {
    SystemFlag.TEMP_FAULT: "it is too hot",
    SystemFlag.POWER_FAULT: "its supply voltage is out of range",
    SystemFlag.CURR_FAULT: "its motor takes too much current",
    SystemFlag.FINGER_FAULT: "a finger reports a failure",
}
_STANDS = "The gripper stands still; it was not opened."
_REASONS = {
    Status.NOT_INITIALIZED: ("WSG-NOT-HOMED", "The gripper does not know where its jaws are"),
    Status.ALREADY_RUNNING: ("WSG-BUSY", "The gripper is still moving"),
    Status.RANGE_ERROR: ("WSG-RANGE", "The gripper cannot go there"),
    Status.INVALID_PARAMETER: ("WSG-RANGE", "The gripper cannot do that"),
    Status.INDEX_OUT_OF_BOUNDS: ("WSG-RANGE", "The gripper cannot do that"),
    Status.AXIS_BLOCKED: ("WSG-BLOCKED", "Something blocks the jaws"),
    Status.CMD_ABORTED: ("WSG-ABORTED", "The gripper broke the motion off"),
    Status.CMD_FAILED: ("WSG-NO-PART", "The jaws met no piece"),
    Status.TIMEOUT: ("WSG-TIMEOUT", "The gripper did not end its motion in time"),
    Status.CHECKSUM_ERROR: ("WSG-FRAME", "The gripper read a damaged command twice"),
}
_STEPS = {
    "WSG-NOT-HOMED": "Take the piece out by hand, then home the gripper.",
    "WSG-NO-PART": "Put the piece between the jaws and grip again.",
    "WSG-BLOCKED": "Look between the jaws, then try again.",
}


def refusal(command: int, status: int, flags: SystemFlag) -> Fault:
    """Return the fault of a command that was answered with ``status``."""
    if status == Status.ACCESS_DENIED and SystemFlag.FAST_STOP in flags:
        return fast_stop_fault()
    name = Command(command).name.lower().replace("_", " ")
    unknown = ("WSG-REFUSED", f"The gripper refuses '{name}' (code {status})")
    code, what = _REASONS.get(Status(status), unknown) if status in _KNOWN else unknown
    return Fault(code, f"{what}.", _STANDS, _STEPS.get(code, "Look at the gripper."), NAME)


_KNOWN = frozenset(int(status) for status in Status)


def fast_stop_fault() -> Fault:
    """Return the fault of a latched fast stop."""
    return Fault(
        "WSG-FAST-STOP",
        "The gripper is in fast stop.",
        "It takes no motion; the grip is as it was.",
        "Look at the piece, then acknowledge the fast stop.",
        NAME,
    )


def device_fault(flags: SystemFlag) -> Fault | None:
    """Return the fault that the system flags tell, None if all is well."""
    for flag, why in DEVICE_FAULTS.items():
        if flag in flags:
            return Fault(
                "WSG-DEVICE",
                f"The gripper reports a fault: {why}.",
                _STANDS,
                "Remove the cause, then acknowledge it.",
                NAME,
            )
    return fast_stop_fault() if SystemFlag.FAST_STOP in flags else None


def link_fault(what: str) -> Fault:
    """Return the fault of a connection that is not, or no longer, there."""
    return Fault(
        "WSG-LINK",
        what,
        "Whether the piece is still held is not known.",
        "Look at the piece; check cable and power of the gripper, then connect it again.",
        NAME,
    )


def stopped_fault() -> Fault:
    """Return the fault of a motion that was stopped."""
    return Fault("STOPPED", "The motion was stopped.", _STANDS, "Look at the bench.", NAME)


def replaced_fault() -> Fault:
    """Return the fault of a motion that another command took the place of."""
    return Fault(
        "REPLACED",
        "Another command took the place of this motion.",
        "The gripper follows the newer command.",
        "Wait for a motion to end before the next command.",
        NAME,
    )


def not_connected_fault() -> Fault:
    """Return the fault of a command to a gripper that is not there."""
    return Fault(
        "NOT-CONNECTED",
        "The gripper is not connected.",
        "Nothing was moved.",
        "Connect it first.",
        NAME,
    )


class WsgMotion(CommandedMotion):
    """The step under way is the first of ``steps``; ``pending`` once the gripper accepted it."""

    def __init__(
        self, steps: Sequence[Request], sent: Mapping[str, float], deadline_s: float
    ) -> None:
        super().__init__(sent)
        self.steps, self.deadline_s = list(steps), deadline_s
        self.pending = self.resent = False


SILENCE_S = 3.0
STATE_MS = 20
STOP = Request(Command.STOP)
_MOVES = (Command.HOME, Command.PREPOSITION, Command.GRASP, Command.RELEASE)


@dataclass(frozen=True, slots=True)
class Limits:
    """What the gripper can do: mm, mm/s, mm/s², N as the sum over both fingers."""

    stroke_mm: float
    speed_mm_s: tuple[float, float]
    acceleration_mm_s2: float
    force_sum_n: tuple[float, float]

    @classmethod
    def of_settings(cls, settings: WsgSettings) -> Limits:
        """Return those of a gripper that does not tell its own."""
        speeds = (settings.speed_min, settings.speed_max)
        forces = (settings.force_min_n, settings.force_max_n)
        return cls(settings.stroke_mm, speeds, settings.acceleration_mm_s2, forces)

    def speed(self, wanted_mm_s: float) -> float:
        """Return the nearest speed that the gripper can do."""
        return min(max(wanted_mm_s, self.speed_mm_s[0]), self.speed_mm_s[1])

    def travel_s(self, travel_mm: float, speed_mm_s: float) -> float:
        """Return how long a way takes at most, with its ramps."""
        return travel_mm / speed_mm_s + 2 * speed_mm_s / self.acceleration_mm_s2


class WsgCore:
    """One gripper. The owner sends what is returned, in this order, and hands in every reply."""

    def __init__(self, settings: WsgSettings) -> None:
        self._settings = settings
        self._fingers = 2.0 if settings.force_convention == "device" else 1.0
        self.limits = Limits.of_settings(settings)
        self.flags = SystemFlag(0)
        self.grasp_state = GraspState.IDLE
        self.width_mm = self.force_sum_n = 0.0
        self.lost_parts = 0
        self.motion: WsgMotion | None = None
        self.fault: Fault | None = None
        self._heard_s = 0.0

    @property
    def status(self) -> GripStatus:
        """Width, force per finger, whether a piece is held: as last heard."""
        holding = self.grasp_state is GraspState.HOLDING
        return GripStatus(self.width_mm, self.force_sum_n / self._fingers, holding)

    def subscribe(self, now_s: float) -> list[Request]:
        """Return the requests for all readings; they keep the connection alive as well."""
        self._heard_s = now_s
        return [
            protocol.update(Command.SYSTEM_STATE, STATE_MS, on_change=True),
            *self._readings(),
        ]

    def home(self, now_s: float) -> list[Request]:
        """Find the origin. On the operator's word only: with a piece in the jaws it is wrong."""
        slowest = self.limits.speed_mm_s[0]
        return self._begin(now_s, protocol.home(), {}, self.limits.stroke_mm / slowest)

    def grip(self, now_s: float, force_n: float) -> list[Request]:
        """Close until a piece is held with ``force_n`` per finger."""
        low, high = self.limits.force_sum_n
        force_sum_n = min(max(self._fingers * force_n, low), high)
        speed = self.limits.speed(self._settings.grasp_speed_mm_s)
        requests = (
            protocol.set_force_limit(force_sum_n),
            protocol.grasp(self._settings.grasp_width_mm, speed),
        )
        sent = {"force_n": force_sum_n / self._fingers}
        within_s = self.limits.travel_s(self.limits.stroke_mm, speed)
        return self._begin(now_s, requests, sent, within_s)

    def open_to(self, now_s: float, width_mm: float, speed_mm_s: float) -> list[Request]:
        """Go to a width; a held piece is let go."""
        width = min(width_mm, self.limits.stroke_mm)
        speed = self.limits.speed(speed_mm_s)
        if self.grasp_state is GraspState.HOLDING:
            request = protocol.release(width, speed)
        else:
            request = protocol.preposition(width, speed, stop_on_block=True)
        within_s = self.limits.travel_s(abs(width - self.width_mm), speed)
        return self._begin(now_s, request, {"width_mm": width, "speed_mm_s": speed}, within_s)

    def stop(self) -> list[Request]:
        """Stop a motion; a grip that stands is kept."""
        moving = self.motion is not None or SystemFlag.MOVING in self.flags
        self._end(stopped_fault())
        return [STOP] if moving else []

    def acknowledge(self) -> list[Request]:
        """Take a fast stop or a fault as seen; it ends with the answer of the gripper."""
        return [
            protocol.acknowledge(),
            protocol.update(Command.SYSTEM_STATE, STATE_MS, on_change=True),
        ]

    def feed(self, now_s: float, reply: Reply) -> list[Request]:
        """Take one reply."""
        self._heard_s = now_s
        if reply.command == Command.ACKNOWLEDGE and reply.status == Status.SUCCESS:
            self.fault = None  # states told before this answer are those of before
        if reply.status == Status.SUCCESS and reply.values:
            self._read(reply)
        motion = self.motion
        if motion is None or not motion.steps or reply.command != motion.steps[0].command:
            return []
        return self._advance(motion, reply)

    def tick(self, now_s: float) -> list[Request]:
        """Look at the clock: a motion that takes too long is stopped, silence is a fault."""
        if now_s - self._heard_s > SILENCE_S:
            self._latch(link_fault(f"The gripper is silent for {now_s - self._heard_s:.1f} s."))
        elif self.motion is not None and now_s > self.motion.deadline_s:
            command = self.motion.steps[0].command if self.motion.steps else Command.STOP
            self._end(refusal(command, Status.TIMEOUT, self.flags))
            return [STOP]
        return []

    def lose(self, fault: Fault) -> None:
        """Take note that the wire is gone."""
        self._latch(fault)

    def _readings(self) -> list[Request]:
        period_ms = self._settings.update_ms
        return [
            protocol.update(Command.GRASP_STATE, STATE_MS, on_change=True),
            protocol.update(Command.WIDTH, period_ms),
            protocol.update(Command.FORCE, period_ms),
        ]

    def _begin(
        self,
        now_s: float,
        requests: Request | tuple[Request, ...],
        sent: Mapping[str, float],
        within_s: float,
    ) -> list[Request]:
        """Start a motion and, at its end, read anew what it changed."""
        if self.fault is not None:
            raise FaultError(self.fault)
        first = requests if isinstance(requests, tuple) else (requests,)
        before = [STOP] if self.motion is not None else []
        self._end(replaced_fault())
        steps = [*before, *first, *self._readings()]
        deadline_s = now_s + within_s + self._settings.margin_s
        self.motion = WsgMotion(steps, sent, deadline_s)
        return steps[:1]

    def _advance(self, motion: WsgMotion, reply: Reply) -> list[Request]:
        request = motion.steps[0]
        if reply.status == Status.CMD_PENDING:
            motion.pending = True
            return []
        if reply.status == Status.CMD_ABORTED and not motion.pending:
            return []  # the end of the motion before this one
        if reply.status == Status.CHECKSUM_ERROR and not motion.resent:
            motion.resent = True
            return [request]
        if reply.status != Status.SUCCESS:
            self._end(refusal(request.command, reply.status, self.flags))
            return []
        if request.command in _MOVES and not motion.pending:
            return []  # a result of before; ours begins with "pending"
        motion.steps.pop(0)
        motion.pending = False
        if not motion.steps:
            self._end(self._missing_grip(motion))
        return motion.steps[:1]

    def _missing_grip(self, motion: WsgMotion) -> Fault | None:
        if "force_n" in motion.sent and self.grasp_state is not GraspState.HOLDING:
            return refusal(Command.GRASP, Status.CMD_FAILED, self.flags)
        return None

    def _read(self, reply: Reply) -> None:
        value = float(reply.values[0])
        match reply.command:
            case Command.SYSTEM_STATE:
                self.flags = SystemFlag(int(value))
                fault = device_fault(self.flags)
                if fault is not None:
                    self._latch(fault)
            case Command.GRASP_STATE:
                self._see(GraspState(int(value)) if value in _STATES else GraspState.ERROR)
            case Command.WIDTH:
                self.width_mm = value
            case Command.FORCE:
                self.force_sum_n = value

    def _see(self, state: GraspState) -> None:
        lost = self.grasp_state is GraspState.HOLDING and state is GraspState.PART_LOST
        self.lost_parts += lost
        self.grasp_state = state

    def _latch(self, fault: Fault) -> None:
        self.fault = self.fault or fault
        self._end(fault)

    def _end(self, fault: Fault | None) -> None:
        if self.motion is not None:
            self.motion.end(fault)
            self.motion = None


_STATES = frozenset(int(state) for state in GraspState)
