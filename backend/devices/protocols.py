"""Interfaces that simulated, emulated and real devices satisfy.

They are protocols, not base classes; one contract test suite checks all implementations. Plans and
windows only get guarded arms and grippers, see ``interlock``. Every driver returns a
``CommandedMotion`` for a command, a future.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from enum import Enum
from itertools import takewhile
from typing import Literal, Protocol, runtime_checkable

from touchdown.backend.core import (
    Fault,
    FaultError,
    Finger,
    FloatArray,
    Pose,
    RefusedError,
    SampleStream,
    Stream,
    TactileFrame,
)

Vector = tuple[float, float, float]
STILL: Vector = (0.0, 0.0, 0.0)
Joints = tuple[float, ...]  # joint angles from the base on, rad
TURN_RAD_S = math.radians(5.0)  # default turn rate of the hand


class DeviceState(Enum):
    """State of a connection; robot mode and safety mode are separate."""

    CLOSED = "closed"
    CONNECTING = "connecting"
    READY = "ready"
    FAULT = "fault"


class RobotMode(Enum):
    """Activity of the arm."""

    DISCONNECTED = "Disconnected"
    CONNECTING = "Connecting"
    SERVO_OFF = "Servo off"
    READY = "Ready"
    MOVING = "Moving"
    PROGRAM = "Program"


class SafetyMode(Enum):
    """Safety state of the arm."""

    NORMAL = "Normal"
    REDUCED = "Reduced"
    PROTECTIVE_STOP = "Protective stop"
    FAULT = "Fault"
    RECOVERY = "Recovery"
    HW_STOP = "HW stop"
    UNKNOWN = "Unknown"


@dataclass(frozen=True, slots=True)
class Identity:
    """Identity as reported by a device."""

    maker: str
    model: str
    serial: str
    firmware: str


@dataclass(frozen=True, slots=True)
class Health:
    """Rate of distinct samples, age of the newest sample, and counts since the connection."""

    rate_hz: float
    age_s: float
    received: int
    lost: int


HEALTH_WINDOW_S = 1.0


class ArrivalCounter:
    """Counter of what arrives on one connection; written by one thread, read by any."""

    def __init__(self) -> None:
        self._arrivals: deque[tuple[float, int]] = deque(maxlen=8192)
        self.received = 0
        self.last_s = -math.inf  # time of the newest arrival

    def note(self, now_s: float, count: int = 1) -> None:
        """Add ``count`` samples that arrived at ``now_s``."""
        self._arrivals.append((now_s, count))
        self.received += count
        self.last_s = now_s

    def health(self, now_s: float, lost: int) -> Health:
        """Return rate over the last second, age of the newest arrival, and the counts."""
        newest = reversed(self._arrivals.copy())
        recent = takewhile(lambda arrival: arrival[0] > now_s - HEALTH_WINDOW_S, newest)
        return Health(
            sum(n for _, n in recent) / HEALTH_WINDOW_S, now_s - self.last_s, self.received, lost
        )


class Device(Protocol):
    """One connection with one owner."""

    @property
    def name(self) -> str:
        """Short name such as "arm" or "tactile_left"."""

    @property
    def state(self) -> DeviceState:
        """State of the connection."""

    @property
    def identity(self) -> Identity | None:
        """Identity, None before the first connection."""

    @property
    def health(self) -> Health:
        """Rate, age and losses."""

    def connect(self, timeout_s: float, cancel: threading.Event) -> None:
        """Connect; raises ``FaultError`` on failure. Connecting twice is allowed."""

    def close(self) -> None:
        """Close; closing twice is allowed. Never opens the gripper."""

    def describe(self) -> Mapping[str, str | float]:
        """Raw fields for the inspector."""


class Motion(Protocol):
    """A command in progress."""

    @property
    def done(self) -> bool:
        """True when the motion has ended, with success or not."""

    @property
    def sent(self) -> Mapping[str, float]:
        """The command as sent, after limits."""

    def result(self) -> None:
        """Return after success; raise the fault after a failure, ``ValueError`` before the end."""


class PressMotion(Motion, Protocol):
    """A press in progress: approach, contact, ramp, hold. It stays pressed when done."""

    @property
    def detected_s(self) -> float | None:
        """Bench time at which contact was declared."""

    @property
    def onset_s(self) -> float | None:
        """Back-dated bench time of first contact; t = 0 of the episode."""


class TactileSensor(Device, Protocol):
    """One finger: images only; the reference belongs to sensing."""

    @property
    def finger(self) -> Finger:
        """Finger of the camera."""

    @property
    def frames(self) -> Stream[TactileFrame]:
        """Stream of pictures."""


class ForceTorqueSensor(Device, Protocol):
    """Wrist sensor: untared samples, environment on tool, in N and N·m."""

    @property
    def samples(self) -> SampleStream:
        """Six channels: Fx Fy Fz Tx Ty Tz."""

    @property
    def rated(self) -> FloatArray:
        """(6,) rated range, N and N·m."""


@dataclass(frozen=True, slots=True)
class ArmStatus:
    """Robot mode, safety mode, override and the controller's error number (0 for none)."""

    robot_mode: RobotMode
    safety_mode: SafetyMode
    override: float
    error: int


SENSIBLE = 1e6  # limit of any number of a command, in its unit
MOST_DRAG_MM = 3.0


@dataclass(frozen=True, slots=True)
class PressCommand:
    """Descend until contact, then press.

    The commanded position goes down at ``approach_mm_s`` until contact is declared, then follows
    the ramp ``depth_mm * min(1, t / ramp_s)`` counted from the back-dated onset (never moving up),
    and holds until ``hold_s`` after the onset. ``stiffness_n_mm``: gains (x, y, z).
    ``max_travel_mm``: the press fails with a ``FaultError`` without contact on this distance.
    ``drag_mm``: travel along y, in step with the ramp; 0 presses straight down.

    Raises ``ValueError`` for a number that is not finite or out of range.
    """

    depth_mm: float
    ramp_s: float
    hold_s: float
    approach_mm_s: float
    threshold_n: float
    max_travel_mm: float
    stiffness_n_mm: tuple[float, float, float]
    drag_mm: float = 0.0

    @property
    def nominal_n(self) -> float:
        """Force if nothing but the arm yields, N."""
        _, side_n_mm, down_n_mm = self.stiffness_n_mm
        return math.hypot(down_n_mm * self.depth_mm, side_n_mm * self.drag_mm)

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            numbers = value if isinstance(value, tuple) else (value,)
            low, high = {"drag_mm": (-MOST_DRAG_MM, MOST_DRAG_MM)}.get(field.name, (0.0, SENSIBLE))
            if not all(low <= number <= high for number in numbers):
                raise ValueError(f"{field.name} of a press is out of range: {value}")


class Arm(Device, Protocol):
    """The robot arm; poses are those of the grasp pivot ``G``."""

    @property
    def poses(self) -> SampleStream:
        """Measured position of ``G``, three channels, mm."""

    def status(self) -> ArmStatus:
        """Return the status words."""

    def servo(self, on: bool) -> None:
        """Switch the servo motors; off ends the motion. On may take seconds. Raises ``FaultError``.
        Motion commands fail while they are off.
        """

    def pose(self, max_age_s: float) -> Pose:
        """Return the measured pose; raises ``StaleSampleError`` if older."""

    def move_to(self, target: Pose, speed_mm_s: float, turn_rad_s: float = TURN_RAD_S) -> Motion:
        """Move on a straight line to ``target``, turning evenly; neither speed is exceeded.

        Raises ``ValueError`` for a turn where the arm does not rotate.
        """

    @property
    def rotates(self) -> bool:
        """True if the hand can turn and single joints can be driven."""

    def jog(self, velocity_mm_s: Vector, for_s: float, turn_rad_s: Vector = STILL) -> Motion:
        """Move ``G`` and turn about it, in bench axes, for at most ``for_s``, then stand still. A
        further call within this time continues the same motion with its own velocity. The arm stops
        even if the caller has died.
        """

    # The next four require ``rotates``; otherwise they raise ``ValueError``.

    def joints_rad(self, max_age_s: float) -> Joints:
        """Return the measured joints; raises ``StaleSampleError`` if older."""

    @property
    def joint_limits_rad(self) -> tuple[tuple[float, float], ...]:
        """Lowest and highest angle of each joint, rad."""

    def place_of(self, joints_rad: Joints) -> Pose:
        """Return the pose of the hand at these joints."""

    def jog_joints(self, speeds_rad_s: Joints, for_s: float) -> Motion:
        """Turn the joints for at most ``for_s``, then stand still; renewed like ``jog``."""

    def move_joints(self, target_rad: Joints, speed_rad_s: float) -> Motion:
        """Turn all joints to ``target_rad``; none goes faster than ``speed_rad_s``."""

    def press(self, command: PressCommand) -> PressMotion:
        """Press compliantly, straight down."""

    def unload(self, force_n: float, speed_mm_s: float) -> Motion:
        """Lift in contact until the press force is ``force_n``, then stand still."""

    def halt(self) -> None:
        """End the motion and stand still, ready for the next; returns immediately."""

    def stop(self) -> None:
        """Stop at once, in every state; returns immediately. The next motion sets up the wires
        again.
        """


@dataclass(frozen=True, slots=True)
class GripStatus:
    """Width between the pads (mm), force per finger (N), and whether a piece is held."""

    width_mm: float
    force_n: float
    holding: bool


class Gripper(Device, Protocol):
    """Parallel gripper; ``force_n`` is per finger everywhere."""

    def status(self) -> GripStatus:
        """Return the present status."""

    def grip(self, force_n: float) -> Motion:
        """Close until a piece is held with ``force_n`` per finger."""

    def open_to(self, width_mm: float, speed_mm_s: float) -> Motion:
        """Open (or close) to ``width_mm``."""

    def stop(self) -> None:
        """Stop and keep the grip."""


ConnectionStep = Literal["reach", "identify", "configure", "first sample"]
# Open the wire; check the identity; set up; receive the first data.
CONNECTION_STEPS: tuple[ConnectionStep, ...] = ("reach", "identify", "configure", "first sample")


class ConnectionSteps:
    """Progress of a connection; written by the driver, read by any thread."""

    def __init__(self) -> None:
        self.done = 0  # number of completed ``STEPS``

    def begin(self) -> None:
        """Reset the progress."""
        self.done = 0

    def reached(self, step: ConnectionStep) -> None:
        """Mark ``step`` and all before it as completed."""
        self.done = max(self.done, CONNECTION_STEPS.index(step) + 1)


@runtime_checkable
class ReportsConnectionSteps(Protocol):
    """A device that reports the progress of its connection."""

    @property
    def steps(self) -> ConnectionSteps:
        """The steps of the present connection."""


@runtime_checkable
class HomingGripper(Gripper, Protocol):
    """A gripper that is homed on the operator's command.

    ``lost_holding`` is True if a piece was held when the connection was lost: the fast stop must be
    acknowledged by the operator, also after the next connection.
    """

    lost_holding: bool

    @property
    def homed(self) -> bool:
        """True if the origin of the jaws is known."""

    @property
    def fault(self) -> Fault | None:
        """Fault to acknowledge, or cause of a lost connection."""

    def home(self) -> Motion:
        """Find the origin, with empty jaws only."""

    def acknowledge(self) -> None:
        """Acknowledge a fast stop or fault."""


# Names of the values of ``trace``; ``phase`` is the phase of the stream.
TRACE_NAMES = (
    *(f"command_{axis}_mm" for axis in "xyz"),
    *(f"measured_{axis}_mm" for axis in "xyz"),
    *(f"sent_j{n}_rad" for n in range(1, 7)),
    *(f"measured_j{n}_rad" for n in range(1, 7)),
    *("phase", "missed", "holds", "moving", "press_n"),
)


@runtime_checkable
class TracedArm(Protocol):
    """An arm that reports internal values of its stream."""

    @property
    def press_n(self) -> float:
        """Measured press force relative to the zero of the contact law, N; NaN without contact."""

    def trace(self) -> tuple[float, ...]:
        """Return the present values, in the order of ``TRACE_NAMES``."""


RETREAT_MM, RETREAT_MM_S = 2.0, 10.0
# Fault codes after which a ``RetreatingArm`` retreats from the contact; otherwise it stops.
RETREAT_FAULTS = frozenset({"FT-TRIP", "FT-OVERLOAD", "CONTACT-STIFF", "CONTACT-SWINGS"})


@runtime_checkable
class RetreatingArm(Protocol):
    """An arm that can retreat from a contact."""

    def retreat(self) -> None:
        """End the motion, lift by ``RETREAT_MM``, then stand. May be called from any thread and
        does not wait; it is a stop if the arm cannot be driven. A press that already retreats
        continues.
        """


# Fault code of a press that the arm interrupted: its data are invalid.
VOID_PRESS = "PRESS-VOID"


class CommandedMotion:
    """A motion that ends once, with success or a fault; ``sent`` is the command as sent."""

    def __init__(self, sent: Mapping[str, float]) -> None:
        self._sent = dict(sent)
        self._done = False
        self._fault: Fault | None = None

    @property
    def done(self) -> bool:
        """True when the motion has ended."""
        return self._done

    @property
    def sent(self) -> Mapping[str, float]:
        """The command as sent, after limits."""
        return self._sent

    def result(self) -> None:
        """Return after success; raise the fault after a failure, ``ValueError`` before the end."""
        if not self._done:
            raise ValueError("the motion is still under way")
        if self._fault is not None:
            raise FaultError(self._fault)

    def end(self, fault: Fault | None = None) -> None:
        """End the motion; only the first call has an effect."""
        if not self._done:
            self._fault = fault
            self._done = True


def stopped_fault(device: str) -> Fault:
    """Return the fault of a motion that was stopped."""
    return Fault(
        "STOPPED",
        "The motion was stopped.",
        "The device stands still; the gripper was not opened.",
        "Look at the bench, then press Reset.",
        device,
    )


def replaced_fault(device: str) -> Fault:
    """Return the fault of a motion that was replaced by another command."""
    return Fault(
        "REPLACED",
        "Another command took the place of this motion.",
        "The device follows the newer command.",
        "Wait for a motion to end before the next command.",
        device,
    )


def servo_off_fault(device: str) -> Fault:
    """Return the fault of a command while the servo motors are off."""
    return Fault(
        "SERVO-OFF",
        "The servo of the arm is off.",
        "Nothing was moved.",
        "Hold Servo in the top bar for 1 s.",
        device,
    )


def not_connected_fault(device: str) -> Fault:
    """Return the fault of a command without a connection."""
    return Fault(
        "NOT-CONNECTED",
        f"The device '{device}' is not connected.",
        "Nothing was moved.",
        "Connect the device first.",
        device,
    )


ARM = "arm"
HELD = "The arm stands still; the gripper was not opened."
NOTHING_MOVED = "Nothing was moved."


def arm_fault(code: str, what: str, next_step: str, consequence: str = HELD) -> Fault:
    """Return a fault of the arm."""
    return Fault(code, what, consequence, next_step, ARM)


class ArmPress(CommandedMotion):
    """A press with its contact times on the bench clock."""

    detected_s: float | None = None
    onset_s: float | None = None


STOPPED = replace(stopped_fault(ARM), consequence=HELD)
REPLACED = replace(replaced_fault(ARM), consequence="The arm follows the newer command.")
NOT_CONNECTED = not_connected_fault(ARM)
NO_WRENCH = arm_fault(
    "FT-STALE",
    "No force was measured within the last second.",
    "Check the force/torque sensor, then press again.",
    NOTHING_MOVED,
)


def refused_fault(error: RefusedError) -> Fault:
    """Return the fault of a motion whose next command is not permitted."""
    return arm_fault(error.reason, error.detail, "Choose another way or place.")
