"""Emulated WSG gripper, binary protocol."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from touchdown.backend.devices.wsg import protocol
from touchdown.backend.devices.wsg.protocol import (
    ACKNOWLEDGE_KEY,
    Command,
    GraspState,
    Number,
    Refused,
    Reply,
    Request,
    Status,
    SystemFlag,
)
from touchdown.backend.emulation import Faults

CLAMPING_TRAVEL_MM = 3.0
"""How far grasp closes beyond the nominal width before it gives up."""


@dataclass(frozen=True, slots=True)
class Profile:
    """What a gripper can do: mm, mm/s, mm/s², N as the sum over both fingers."""

    kind: int = 0
    stroke_mm: float = 66.0
    speed_mm_s: tuple[float, float] = (5.0, 400.0)
    acceleration_mm_s2: tuple[float, float] = (100.0, 5000.0)
    force_sum_n: tuple[float, float] = (5.0, 50.0)


@dataclass(frozen=True, slots=True)
class Motion:
    """A motion under way, from ``start_mm`` at ``begun_s``; speed signed, closing below 0."""

    command: Command
    start_mm: float
    target_mm: float
    begun_s: float
    velocity_mm_s: float

    def width_mm(self, now_s: float) -> float:
        """Width at a time; the target once it is reached."""
        width = self.start_mm + self.velocity_mm_s * (now_s - self.begun_s)
        return max(width, self.target_mm) if self.velocity_mm_s < 0 else min(width, self.target_mm)


class Jaws:
    """``part_mm`` is the width of a part between the fingers; None if there is none."""

    def __init__(self, profile: Profile, part_mm: float | None = None) -> None:
        self.profile, self.part_mm = profile, part_mm
        self.width_mm = profile.stroke_mm
        self.force_limit_n = profile.force_sum_n[0]
        self.state = GraspState.IDLE
        self.flags = SystemFlag(0)
        self.motion: Motion | None = None
        self.statistics = (0, 0, 0)
        """Grasps in all, without a part, with a part that was lost."""

    def count(self, *, missed: int = 0, lost: int = 0) -> None:
        """Count a grasp that ended (``missed``: without a part), or a part that was ``lost``."""
        total, no_part, lost_parts = self.statistics
        self.statistics = (total + 1 - lost, no_part + missed, lost_parts + lost)

    @property
    def force_n(self) -> float:
        """Sum over both fingers."""
        return self.force_limit_n if self.state is GraspState.HOLDING else 0.0

    def begin(self, now_s: float, command: Command, target_mm: float, speed_mm_s: float) -> None:
        """Start a motion; width and speed are clamped to what the gripper can do."""
        slowest, fastest = self.profile.speed_mm_s
        speed = min(max(speed_mm_s, slowest), fastest)
        target = min(max(target_mm, 0.0), self.profile.stroke_mm)
        velocity = speed if target >= self.width_mm else -speed
        self.motion = Motion(command, self.width_mm, target, now_s, velocity)
        self.flags &= ~(
            SystemFlag.BLOCKED_MINUS | SystemFlag.AXIS_STOPPED | SystemFlag.TARGET_POS_REACHED
        )
        self.flags |= SystemFlag.MOVING
        self.state = {
            Command.GRASP: GraspState.GRASPING,
            Command.RELEASE: GraspState.RELEASING,
        }.get(command, GraspState.POSITIONING)

    def halt(self) -> Motion | None:
        """Stop where they are; return the motion that this ended."""
        motion, self.motion = self.motion, None
        self.flags = (self.flags & ~SystemFlag.MOVING) | SystemFlag.AXIS_STOPPED
        self.state = GraspState.IDLE
        return motion

    def let_go(self) -> None:
        """Hold nothing any more, without a motion: the fingers have no force."""
        self.state = GraspState.IDLE

    def advance(self, now_s: float) -> tuple[Command, Status] | None:
        """Move on to ``now_s``; return command and result of a motion that ended."""
        if self.state is GraspState.HOLDING and self.part_mm is None:
            self.state = GraspState.PART_LOST
            self.count(lost=1)
        motion = self.motion
        if motion is None:
            return None
        width, part = motion.width_mm(now_s), self.part_mm
        if part is not None and motion.velocity_mm_s < 0 and width <= part <= motion.start_mm:
            self.width_mm = part
            return self._end(motion, blocked=True)
        self.width_mm = width
        return self._end(motion, blocked=False) if width == motion.target_mm else None

    def _end(self, motion: Motion, *, blocked: bool) -> tuple[Command, Status]:
        self.motion = None
        self.flags &= ~SystemFlag.MOVING
        if motion.command is Command.GRASP:
            self.state = GraspState.HOLDING if blocked else GraspState.NO_PART_FOUND
            self.count(missed=not blocked)
            return motion.command, Status.SUCCESS if blocked else Status.CMD_FAILED
        self.state = GraspState.IDLE
        if blocked:
            self.flags |= SystemFlag.BLOCKED_MINUS
            return motion.command, Status.AXIS_BLOCKED
        self.flags |= SystemFlag.TARGET_POS_REACHED
        if motion.command is Command.HOME:
            self.flags |= SystemFlag.REFERENCED
        return motion.command, Status.SUCCESS


SERIAL = 12345
TEMPERATURE_C = 31.2
_HOME_SPEED_MM_S = 50.0
_BARRED = SystemFlag.FAST_STOP | SystemFlag.POWER_FAULT
_MOTIONS = (Command.HOME, Command.PREPOSITION, Command.GRASP, Command.RELEASE)


@dataclass(slots=True)
class Update:
    """A reading sent again and again."""

    period_s: float
    on_change: bool
    next_s: float
    last: tuple[Number, ...] | None = None


class EmulatedWsg:
    """``jaws.part_mm`` may be set at any time: a part comes, or is lost.

    ``faults``: those that the gripper itself can suffer from. ``keeps_grip``: whether the piece
    stays held when a connection ends as announced.
    """

    def __init__(
        self,
        profile: Profile | None = None,
        part_mm: float | None = None,
        faults: Faults | None = None,
        *,
        keeps_grip: bool = True,
    ) -> None:
        self._keeps_grip = keeps_grip
        self._faults = faults or Faults("gripper")
        self.jaws = Jaws(profile or Profile(), part_mm)
        self._requests = protocol.requests()
        self._updates: dict[Command, Update] = {}
        self._acceleration_mm_s2 = self.jaws.profile.acceleration_mm_s2[0]
        self._leaving = False
        self._lost_mm: float | None = None
        self.barred = 0
        """Motions that were asked of it while a fault was not acknowledged."""
        self._actions: dict[int, Callable[[Request], tuple[Status, tuple[Number, ...]]]] = {
            Command.LOOP: lambda request: (Status.SUCCESS, request.values),
            Command.ACKNOWLEDGE: self._acknowledge,
            Command.SET_ACCELERATION: self._set_acceleration,
            Command.SET_FORCE_LIMIT: self._set_force_limit,
            Command.STATISTICS: self._statistics,
        }

    def receive(self, now_s: float, data: bytes) -> bytes:
        """Take commands; return what is answered at once."""
        out = self.due(now_s)
        for request in self._requests.feed(data):
            replies = self._answer(now_s, request)
            out += b"".join(map(protocol.encode_reply, replies))
        return out

    def due(self, now_s: float) -> bytes:
        """Return the result of a motion that ended, and the updates that are due."""
        ended = self.jaws.advance(now_s)
        replies = [Reply(*ended)] if ended else []
        replies += self._suffer(now_s)
        replies += [reply for command in self._updates for reply in self._update(now_s, command)]
        return b"".join(map(protocol.encode_reply, replies))

    def closed(self, now_s: float) -> None:
        """Latch the fast stop unless the end was announced."""
        self._updates.clear()
        self._requests.reset()
        if not self._leaving:
            self._fast_stop()
        elif not self._keeps_grip:
            self.jaws.let_go()
        self._leaving = False

    def _suffer(self, now_s: float) -> list[Reply]:
        """Let the faults that are on have their effect; return the end of a motion they break."""
        if self._faults.active("part_lost", now_s):
            self._lost_mm = self.jaws.part_mm or self._lost_mm
            self.jaws.part_mm = None
        elif self._lost_mm is not None and self.jaws.width_mm >= self._lost_mm:
            # The fault is over: somebody holds the piece between the open jaws again.
            self.jaws.part_mm, self._lost_mm = self._lost_mm, None
        broken: Motion | None = None
        if self._faults.active("power", now_s) and SystemFlag.POWER_FAULT not in self.jaws.flags:
            broken = self.jaws.halt()
            self.jaws.flags |= SystemFlag.POWER_FAULT
        if self._faults.active("fast_stop", now_s) and SystemFlag.FAST_STOP not in self.jaws.flags:
            broken = self._fast_stop() or broken
        return [Reply(broken.command, Status.CMD_ABORTED)] if broken else []

    def _answer(self, now_s: float, request: Request | Refused) -> list[Reply]:
        if isinstance(request, Refused):
            return [Reply(request.command, request.status)]
        if self._leaving:
            return [Reply(request.command, Status.ACCESS_DENIED)]
        if request.command in _MOTIONS:
            return [self._move(now_s, Command(request.command), request.values)]
        if request.command in (Command.STOP, Command.FAST_STOP, Command.DISCONNECT):
            return self._halt(request.command)
        reading = self._reading(request.command)
        if reading is not None:
            self._subscribe(now_s, request)
            return [Reply(request.command, Status.SUCCESS, reading)]
        action = self._actions.get(request.command)
        if action is None:
            return [Reply(request.command, Status.CMD_UNKNOWN)]
        return [Reply(request.command, *action(request))]

    def _move(self, now_s: float, command: Command, values: tuple[Number, ...]) -> Reply:
        jaws, refusal = self.jaws, Status.CMD_PENDING
        if jaws.flags & _BARRED:
            refusal = Status.ACCESS_DENIED
            self.barred += 1
        elif jaws.motion is not None:
            refusal = Status.ALREADY_RUNNING
        elif command is not Command.HOME and SystemFlag.REFERENCED not in jaws.flags:
            refusal = Status.NOT_INITIALIZED
        if refusal is not Status.CMD_PENDING:
            return Reply(command, refusal)
        numbers = [float(value) for value in values]
        if command is Command.HOME:
            target = 0.0 if numbers[0] == 2 else jaws.profile.stroke_mm
            jaws.begin(now_s, command, target, _HOME_SPEED_MM_S)
        elif command is Command.PREPOSITION:
            relative = jaws.width_mm if int(numbers[0]) & 1 else 0.0
            jaws.begin(now_s, command, relative + numbers[1], numbers[2])
        else:
            travel = CLAMPING_TRAVEL_MM if command is Command.GRASP else 0.0
            jaws.begin(now_s, command, numbers[0] - travel, numbers[1])
        return Reply(command, Status.CMD_PENDING)

    def _halt(self, command: int) -> list[Reply]:
        self._leaving = command == Command.DISCONNECT
        if self._leaving and self.jaws.motion is None:
            return [Reply(command, Status.SUCCESS)]
        ended = self._fast_stop() if command == Command.FAST_STOP else self.jaws.halt()
        aborted = [Reply(ended.command, Status.CMD_ABORTED)] if ended else []
        return [*aborted, Reply(command, Status.SUCCESS)]

    def _fast_stop(self) -> Motion | None:
        ended = self.jaws.halt()
        self.jaws.flags |= SystemFlag.FAST_STOP
        return ended

    def _acknowledge(self, request: Request) -> tuple[Status, tuple[Number, ...]]:
        if request.values != (ACKNOWLEDGE_KEY,):
            return Status.CMD_FORMAT_ERROR, ()
        self.jaws.flags &= ~_BARRED
        return Status.SUCCESS, ()

    def _set_acceleration(self, request: Request) -> tuple[Status, tuple[Number, ...]]:
        low, high = self.jaws.profile.acceleration_mm_s2
        self._acceleration_mm_s2 = min(max(float(request.values[0]), low), high)
        return Status.SUCCESS, ()

    def _set_force_limit(self, request: Request) -> tuple[Status, tuple[Number, ...]]:
        low, high = self.jaws.profile.force_sum_n
        self.jaws.force_limit_n = min(max(float(request.values[0]), low), high)
        return Status.SUCCESS, ()

    def _statistics(self, request: Request) -> tuple[Status, tuple[Number, ...]]:
        told = self.jaws.statistics
        if int(request.values[0]) & 1:
            self.jaws.statistics = (0, 0, 0)
        return Status.SUCCESS, told

    def _subscribe(self, now_s: float, request: Request) -> None:
        if len(request.values) != 2:
            return
        flags, period_ms = (int(value) for value in request.values)
        command = Command(request.command)
        if flags & 1 and period_ms:
            period_s = period_ms / 1000
            update = Update(period_s, bool(flags & 2), now_s + period_s, self._reading(command))
            self._updates[command] = update
        else:
            self._updates.pop(command, None)

    def _update(self, now_s: float, command: Command) -> list[Reply]:
        update = self._updates[command]
        if now_s < update.next_s:
            return []
        reading = self._reading(command)
        if reading is None or (update.on_change and reading == update.last):
            return []
        late = math.floor((now_s - update.next_s) / update.period_s)
        update.next_s += (late + 1) * update.period_s
        update.last = reading
        return [Reply(command, Status.SUCCESS, reading)]

    def _reading(self, command: int) -> tuple[Number, ...] | None:
        """Return what a reading command answers; None for other commands."""
        jaws, profile = self.jaws, self.jaws.profile
        motion = jaws.motion
        readings: dict[int, tuple[Number, ...]] = {
            Command.SYSTEM_STATE: (int(jaws.flags),),
            Command.GRASP_STATE: (int(jaws.state),),
            Command.WIDTH: (jaws.width_mm,),
            Command.SPEED: (motion.velocity_mm_s if motion else 0.0,),
            Command.FORCE: (jaws.force_n,),
            Command.TEMPERATURE: (TEMPERATURE_C,),
            Command.GET_ACCELERATION: (self._acceleration_mm_s2,),
            Command.GET_FORCE_LIMIT: (jaws.force_limit_n,),
            Command.SYSTEM_INFO: (profile.kind, 2, 0x2200, SERIAL),
            Command.SYSTEM_LIMITS: (
                profile.stroke_mm,
                *profile.speed_mm_s,
                *profile.acceleration_mm_s2,
                *profile.force_sum_n,
                profile.force_sum_n[1],
            ),
        }
        return readings.get(command)
