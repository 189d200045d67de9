"""Interfaces that simulated, emulated and real devices satisfy.

Protocols, not base classes: one contract test suite holds all implementations. Plans and windows
never hold an unguarded arm or gripper: see ``interlock``. ``CommandedMotion`` is the future that
every driver returns for an order.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping
from dataclasses import dataclass, fields
from enum import Enum
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
Joints = tuple[float, ...]  # angles of the joints, rad, from the base on
TURN_RAD_S = math.radians(5.0)  # the hand turns so fast where nobody says otherwise


class DeviceState(Enum):
    """The life of a connection (robot mode and safety mode are separate words)."""

    CLOSED = "closed"
    CONNECTING = "connecting"
    READY = "ready"
    FAULT = "fault"


class RobotMode(Enum):
    """What the arm is doing."""

    DISCONNECTED = "Disconnected"
    CONNECTING = "Connecting"
    SERVO_OFF = "Servo off"
    READY = "Ready"
    MOVING = "Moving"
    PROGRAM = "Program"


class SafetyMode(Enum):
    """Whether and how the arm may move."""

    NORMAL = "Normal"
    REDUCED = "Reduced"
    PROTECTIVE_STOP = "Protective stop"
    FAULT = "Fault"
    RECOVERY = "Recovery"
    HW_STOP = "HW stop"
    UNKNOWN = "Unknown"


@dataclass(frozen=True, slots=True)
class Identity:
    """Who a device says it is."""

    maker: str
    model: str
    serial: str
    firmware: str


@dataclass(frozen=True, slots=True)
class Health:
    """Measured rate (distinct samples), age of the newest sample, and counts since connection."""

    rate_hz: float
    age_s: float
    received: int
    lost: int


class Device(Protocol):
    """One connection with one owner."""

    @property
    def name(self) -> str:
        """Short name such as "arm" or "tactile_left"."""

    @property
    def state(self) -> DeviceState:
        """Where the connection is in its life."""

    @property
    def identity(self) -> Identity | None:
        """Known once connected."""

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
        """Whether it ended, well or not."""

    @property
    def sent(self) -> Mapping[str, float]:
        """What really went out, after limits."""

    def result(self) -> None:
        """Return if it ended well; raises the cause if it failed; ValueError while not done."""


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
        """Which finger."""

    @property
    def frames(self) -> Stream[TactileFrame]:
        """Frames as they arrive."""


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
    """Both status words, the override and the controller's error number (0: none)."""

    robot_mode: RobotMode
    safety_mode: SafetyMode
    override: float
    error: int


SENSIBLE = 1e6  # no number of an order is larger, in its unit


@dataclass(frozen=True, slots=True)
class PressCommand:
    """Descend until contact, then press.

    The commanded position goes down at ``approach_mm_s`` until contact is declared, then follows
    the ramp ``depth_mm * min(1, t / ramp_s)`` counted from the back-dated onset (never moving up),
    and holds until ``hold_s`` after the onset. ``stiffness_n_mm``: gains (x, y, z).
    ``max_travel_mm``: without contact on this way the press fails with a ``FaultError``.

    Raises ``ValueError`` for a number that makes no sense: a press without an end has no limits.
    """

    depth_mm: float
    ramp_s: float
    hold_s: float
    approach_mm_s: float
    threshold_n: float
    max_travel_mm: float
    stiffness_n_mm: tuple[float, float, float]

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            numbers = value if isinstance(value, tuple) else (value,)
            if not all(0.0 <= number <= SENSIBLE for number in numbers):
                raise ValueError(
                    f"{field.name} of a press must be finite and not negative: {value}"
                )


class Arm(Device, Protocol):
    """The robot arm; poses are those of the grasp pivot ``G``."""

    @property
    def poses(self) -> SampleStream:
        """Measured position of ``G``, three channels, mm."""

    def status(self) -> ArmStatus:
        """Return the status words."""

    def servo(self, on: bool) -> None:
        """Switch the motors; off ends the motion under way. On may take seconds.

        Raises ``FaultError``. Whatever moves the arm while they are off fails.
        """

    def pose(self, max_age_s: float) -> Pose:
        """Return the measured pose; raises ``StaleSampleError`` if older."""

    def move_to(self, target: Pose, speed_mm_s: float, turn_rad_s: float = TURN_RAD_S) -> Motion:
        """Move straight to ``target``, turning evenly on the way; neither speed is exceeded.

        Raises ``ValueError`` for a turn where the arm does not rotate.
        """

    @property
    def rotates(self) -> bool:
        """Whether the hand can turn and single joints can be driven."""

    def jog(self, velocity_mm_s: Vector, for_s: float, turn_rad_s: Vector = STILL) -> Motion:
        """Move ``G`` and turn about it, axes of the bench, for at most ``for_s``, then stand still.

        A further call in time goes on with its own velocity; the motion is the same one. So the
        arm stops even if whoever commands it has died.
        """

    # The four below only where ``rotates``; elsewhere ``ValueError``.

    def joints_rad(self, max_age_s: float) -> Joints:
        """Return the measured joints; raises ``StaleSampleError`` if older."""

    @property
    def joint_limits_rad(self) -> tuple[tuple[float, float], ...]:
        """Lowest and highest angle of each joint."""

    def place_of(self, joints_rad: Joints) -> Pose:
        """Return the pose that these joints give the hand. Moves nothing."""

    def jog_joints(self, speeds_rad_s: Joints, for_s: float) -> Motion:
        """Turn the joints for at most ``for_s``, then stand still; renewed as ``jog`` is."""

    def move_joints(self, target_rad: Joints, speed_rad_s: float) -> Motion:
        """Turn all joints to ``target_rad``; none goes faster than ``speed_rad_s``."""

    def press(self, command: PressCommand) -> PressMotion:
        """Press compliantly from here straight down."""

    def unload(self, force_n: float, speed_mm_s: float) -> Motion:
        """Rise while in contact until the press force is ``force_n``, then stand still."""

    def halt(self) -> None:
        """End the motion under way and stand still, ready for the next; returns immediately."""

    def stop(self) -> None:
        """Stop at once, in every state; returns immediately. What the wires need is done anew."""


@dataclass(frozen=True, slots=True)
class GripStatus:
    """Width between the pads (mm), force per finger (N), and whether a piece is held."""

    width_mm: float
    force_n: float
    holding: bool


class Gripper(Device, Protocol):
    """Parallel gripper; ``force_n`` is per finger everywhere."""

    def status(self) -> GripStatus:
        """Return the present state."""

    def grip(self, force_n: float) -> Motion:
        """Close until a piece is held with ``force_n`` per finger."""

    def open_to(self, width_mm: float, speed_mm_s: float) -> Motion:
        """Open (or close) to ``width_mm``."""

    def stop(self) -> None:
        """Stop where it is; keeps the grip."""


ConnectionStep = Literal["reach", "identify", "configure", "first sample"]
# The wire is open; the device is the one that was meant; it is set up; it delivers.
CONNECTION_STEPS: tuple[ConnectionStep, ...] = ("reach", "identify", "configure", "first sample")


class ConnectionSteps:
    """Written by whoever connects, read by anyone."""

    def __init__(self) -> None:
        self.done = 0  # so many of ``STEPS`` are done

    def begin(self) -> None:
        """Start anew."""
        self.done = 0

    def reached(self, step: ConnectionStep) -> None:
        """Count ``step`` as done, and all before it."""
        self.done = max(self.done, CONNECTION_STEPS.index(step) + 1)


@runtime_checkable
class ReportsConnectionSteps(Protocol):
    """A device that says how far its connection has come."""

    @property
    def steps(self) -> ConnectionSteps:
        """The steps of the present connection."""


@runtime_checkable
class HomingGripper(Gripper, Protocol):
    """A gripper that finds its origin on the operator's word.

    ``lost_holding``: a piece was held when the connection was lost, so that a fast stop waits for
    the operator, also in the next connection.
    """

    lost_holding: bool

    @property
    def homed(self) -> bool:
        """Whether it knows where its jaws are."""

    @property
    def fault(self) -> Fault | None:
        """What has to be acknowledged, or why the connection was lost."""

    def home(self) -> Motion:
        """Find the origin, with empty jaws only."""

    def acknowledge(self) -> None:
        """Take a fast stop or fault as seen."""


# Names of the values that ``trace`` returns; ``phase`` is the place in the life of the stream.
TRACE_NAMES = (
    *(f"command_{axis}_mm" for axis in "xyz"),
    *(f"measured_{axis}_mm" for axis in "xyz"),
    *(f"sent_j{n}_rad" for n in range(1, 7)),
    *(f"measured_j{n}_rad" for n in range(1, 7)),
    *("phase", "missed", "holds", "moving", "press_n"),
)


@runtime_checkable
class TracedArm(Protocol):
    """An arm whose stream can be looked into while it runs."""

    @property
    def press_n(self) -> float:
        """Felt press force by the zero of the contact law; NaN without contact."""

    def trace(self) -> tuple[float, ...]:
        """Return the values of ``TRACE`` as they are now."""


RETREAT_MM, RETREAT_MM_S = 2.0, 10.0
# Codes of faults at which an arm that can draws back from the contact; at all others it stops.
RETREAT_FAULTS = frozenset({"FT-TRIP", "FT-OVERLOAD", "CONTACT-STIFF", "CONTACT-SWINGS"})


@runtime_checkable
class RetreatingArm(Protocol):
    """An arm that does so by itself, once it is told."""

    def retreat(self) -> None:
        """Rise by ``RETREAT_MM`` from where the arm is, then stand; the motion under way ends.

        From any thread, waits for nothing; where nothing can be driven it is a stop. A press that
        draws back already goes on with that.
        """


# Code of a press during which the arm stood still for a moment: what was felt does not count.
VOID_PRESS = "PRESS-VOID"


class CommandedMotion:
    """Ends once, well or with a fault; ``sent`` is what really went out."""

    def __init__(self, sent: Mapping[str, float]) -> None:
        self._sent = dict(sent)
        self._done = False
        self._fault: Fault | None = None

    @property
    def done(self) -> bool:
        """Whether it ended."""
        return self._done

    @property
    def sent(self) -> Mapping[str, float]:
        """What was sent, after limits."""
        return self._sent

    def result(self) -> None:
        """Return if it ended well; raise the fault if not; ValueError while under way."""
        if not self._done:
            raise ValueError("the motion is still under way")
        if self._fault is not None:
            raise FaultError(self._fault)

    def end(self, fault: Fault | None = None) -> None:
        """End; only the first ending counts."""
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
    """Return the fault of a motion that another command took the place of."""
    return Fault(
        "REPLACED",
        "Another command took the place of this motion.",
        "The device follows the newer command.",
        "Wait for a motion to end before the next command.",
        device,
    )


def servo_off_fault(device: str) -> Fault:
    """Return the fault of an order to an arm whose motors are off."""
    return Fault(
        "SERVO-OFF",
        "The servo of the arm is off.",
        "Nothing was moved.",
        "Hold Servo in the top bar for 1 s.",
        device,
    )


ARM = "arm"
HELD = "The arm stands still; the gripper was not opened."
NOTHING_MOVED = "Nothing was moved."


class ArmPress(CommandedMotion):
    """A press with its contact times on the bench clock."""

    detected_s: float | None = None
    onset_s: float | None = None


STOPPED = Fault(
    "STOPPED", "The motion was stopped.", HELD, "Look at the bench, then press Reset.", ARM
)
REPLACED = Fault(
    "REPLACED",
    "Another command took the place of this motion.",
    "The arm follows the newer command.",
    "Wait for a motion to end before the next command.",
    ARM,
)
NOT_CONNECTED = Fault(
    "NOT-CONNECTED",
    "The device 'arm' is not connected.",
    NOTHING_MOVED,
    "Connect the device first.",
    ARM,
)
NO_WRENCH = Fault(
    "FT-STALE",
    "No force was measured within the last second.",
    NOTHING_MOVED,
    "Check the force/torque sensor, then press again.",
    ARM,
)


def refused_fault(error: RefusedError) -> Fault:
    """Return the fault of a motion whose next command may not go out."""
    return Fault(error.reason, error.detail, HELD, "Choose another way or place.", ARM)
