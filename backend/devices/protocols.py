"""What the bench needs from hardware. Simulated, replayed and real devices satisfy these.

Protocols, not base classes: the implementations share no code by inheritance, and one contract
suite holds them all. Plans and windows never hold an unguarded arm or gripper: see ``interlock``.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping
from dataclasses import dataclass, fields
from enum import Enum
from typing import Protocol

from backend.core.flow import Finger, FloatArray, Pose, TactileFrame
from backend.core.stream import SampleStream, Stream

Vector = tuple[float, float, float]
STILL: Vector = (0.0, 0.0, 0.0)
Joints = tuple[float, ...]
"""Angles of the joints, rad, from the base on."""
TURN_RAD_S = math.radians(5.0)
"""The hand turns so fast where nobody says otherwise."""


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


SENSIBLE = 1e6
"""No number of an order is larger, in its unit."""


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
