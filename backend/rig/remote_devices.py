"""Backend side of the devices of a lab file.

Arm, gripper and wrist sensor are proxies of those in the real-time process, which starts with the
first connection. Cameras have no deadlines and run in this process. Measured positions and wrenches
are in the session's streams; the rest is read from the state that the rig publishes every 20 ms.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict, astuple
from typing import Any

import numpy as np

from touchdown.backend.config import HardwareSettings
from touchdown.backend.core import FINGERS, Fault, FloatArray, Pose, RawStreams, SampleStream
from touchdown.backend.devices import (
    STILL,
    TURN_RAD_S,
    ArmStatus,
    ConnectionSteps,
    Device,
    DeviceState,
    GripStatus,
    Health,
    Identity,
    Interlock,
    Joints,
    PressCommand,
    ReleaseAuthorisation,
    ReleaseEvidence,
    RobotMode,
    SafetyMode,
    Vector,
    make_tactile,
)
from touchdown.backend.devices.melfa import PLACE_LATE_S
from touchdown.backend.rig.link import RigLink, RigMotion
from touchdown.backend.rig.messages import read_fault
from touchdown.backend.rig.process import make_devices


class _Remote:
    """Connection, identity and health of one device of the rig. ``open_ones`` are the open devices
    of this link: the first starts the process, the last ends it.
    """

    def __init__(
        self, name: str, link: RigLink, now_s: Callable[[], float], open_ones: set[str]
    ) -> None:
        self.name, self._link, self._now_s, self._open = name, link, now_s, open_ones

    @property
    def _row(self) -> Mapping[str, Any]:
        return self._link.row(self.name) if self.name in self._open else {}

    @property
    def state(self) -> DeviceState:
        """State of the connection; FAULT when the rig is lost."""
        if self.name in self._open and self._link.lost is not None:
            return DeviceState.FAULT
        return DeviceState(self._row.get("state", "closed"))

    @property
    def fault(self) -> Fault | None:
        """Fault of the device, None without one."""
        if self.name in self._open and self._link.lost is not None:
            return self._link.lost
        return read_fault(self._row.get("fault"))

    @property
    def steps(self) -> ConnectionSteps:
        steps = ConnectionSteps()
        steps.done = self._row.get("steps", 0)
        return steps

    @property
    def identity(self) -> Identity | None:
        """Identity, None before the first connection."""
        row = self._row.get("identity")
        return None if row is None else Identity(**row)

    @property
    def health(self) -> Health:
        """Rate, age and counts; empty before the connection."""
        rate_hz, newest_s, received, lost = self._row.get("health", (0.0, -math.inf, 0, 0))
        return Health(rate_hz, self._now_s() - newest_s, received, lost)

    def describe(self) -> Mapping[str, str | float]:
        """Raw fields of the device, and of the process that drives it."""
        hello = self._link.hello
        return {
            **self._row.get("fields", {}),
            "rig": "running" if self._link.running else "not running",
            "rig_realtime": "yes" if hello.get("realtime") else "no",
        }

    def connect(self, timeout_s: float, cancel: threading.Event) -> None:
        """Connect in the rig; raises ``FaultError``. ``cancel`` is forwarded meanwhile."""
        if self.state is DeviceState.READY:
            return
        self._link.start()
        self._open.add(self.name)
        done = threading.Event()
        watch = threading.Thread(target=self._forward_cancel, args=(cancel, done), daemon=True)
        watch.start()
        try:
            self._link.order(f"{self.name}.connect", timeout_s=timeout_s, **self._previous_state())
        except BaseException:
            self._leave()
            raise
        finally:
            done.set()
            watch.join()

    def close(self) -> None:
        """Close in the rig; the process ends with the last device. The gripper keeps its grip."""
        if self.name not in self._open:
            return
        if self._link.running:
            self._link.order(f"{self.name}.close")
        self._leave()

    def _previous_state(self) -> Mapping[str, Any]:
        return {}

    def _leave(self) -> None:
        self._open.discard(self.name)
        if not self._open:
            self._link.close()

    def _forward_cancel(self, cancel: threading.Event, done: threading.Event) -> None:
        while not done.wait(0.02):
            if cancel.is_set():
                self._link.say("cancel")
                return


class RigForceTorque(_Remote):
    """The wrist sensor of the rig."""

    @property
    def samples(self) -> SampleStream:
        """Fx Fy Fz Tx Ty Tz in N and N·m, tool axes; NaN where there is no measurement."""
        return self._link.samples

    @property
    def rated(self) -> FloatArray:
        """(6,) rated range, N and N·m; NaN before the first connection."""
        return np.array(self._row.get("rated", [math.nan] * 6))

    @property
    def slow_since_s(self) -> float | None:
        """Start of a rate below half of the usual one, s; None at the usual rate."""
        slow_s: float | None = self._row.get("slow_since_s")
        return slow_s


class RigArm(_Remote):
    """The arm of the rig."""

    place_late_s = 0.0  # additional delay of positions compared with a stream

    @property
    def poses(self) -> SampleStream:
        """Measured position of ``G``, mm in the bench, once per cycle."""
        return self._link.poses

    def connect(self, timeout_s: float, cancel: threading.Event) -> None:
        """Connect in the rig; discard positions measured before."""
        known = self.state is DeviceState.READY
        super().connect(timeout_s, cancel)
        if not known:
            self._link.settle()

    def status(self) -> ArmStatus:
        """Return the status."""
        lost = self._link.lost is not None and self.name in self._open
        row = self._row.get("status")
        if lost or row is None:
            safety_mode = SafetyMode.FAULT if lost else SafetyMode.UNKNOWN
            return ArmStatus(RobotMode.DISCONNECTED, safety_mode, 0.0, 0)
        mode, safety, override, error = row
        return ArmStatus(RobotMode(mode), SafetyMode(safety), override, error)

    def servo(self, on: bool) -> None:
        """Switch the servo motors on or off; may take seconds."""
        self._link.order("arm.servo", on=on)

    def pose(self, max_age_s: float) -> Pose:
        """Return the measured pose; raises ``StaleSampleError`` if it is older."""
        _, values = self.poses.latest(self._now_s(), max_age_s + self.place_late_s)
        x, y, z = values.tolist()
        return Pose(x, y, z, *(self._row.get("turn") or STILL))

    # -- motion -----------------------------------------------------------------------------------

    def move_to(self, target: Pose, speed_mm_s: float, turn_rad_s: float = TURN_RAD_S) -> RigMotion:
        """Move on a straight line to ``target`` and turn on the way."""
        return self._link.move(
            "arm.move_to", target=astuple(target), speed_mm_s=speed_mm_s, turn_rad_s=turn_rad_s
        )

    def jog(self, velocity_mm_s: Vector, for_s: float, turn_rad_s: Vector = STILL) -> RigMotion:
        """Move at a velocity and turn rate for ``for_s``; a renewal continues smoothly."""
        return self._link.move(
            "arm.jog", velocity_mm_s=velocity_mm_s, for_s=for_s, turn_rad_s=turn_rad_s
        )

    def press(self, command: PressCommand) -> RigMotion:
        """Press compliantly, straight down."""
        return self._link.move("arm.press", **asdict(command))

    def unload(self, force_n: float, speed_mm_s: float) -> RigMotion:
        """Lift until the press force is ``force_n``."""
        return self._link.move("arm.unload", force_n=force_n, speed_mm_s=speed_mm_s)

    def halt(self) -> None:
        """Brake to standstill; the stream continues."""
        if self._link.running:
            self._link.order("arm.halt")

    def retreat(self) -> None:
        """Retreat from the contact, then stand; does not wait."""
        self._link.say("retreat")

    def stop(self) -> None:
        """End the stream and stop the controller; does not wait."""
        self._link.stop()

    # -- joints -----------------------------------------------------------------------------------

    @property
    def rotates(self) -> bool:
        """True if the hand can turn and joints can be driven one by one."""
        return bool(self._link.hello.get("joint_ranges"))

    def joints_rad(self, max_age_s: float) -> Joints:
        """Return the measured joints; raises ``StaleSampleError`` if they are older."""
        self.poses.latest(self._now_s(), max_age_s)
        return tuple(self._row.get("joints") or ())

    @property
    def joint_limits_rad(self) -> tuple[tuple[float, float], ...]:
        """Lowest and highest angle of each joint, rad."""
        return tuple((low, high) for low, high in self._link.hello.get("joint_ranges", ()))

    def place_of(self, joints_rad: Joints) -> Pose:
        """Return the pose of the hand at these joints."""
        return Pose(*self._link.order("arm.place_of", joints_rad=joints_rad)["value"])

    def jog_joints(self, speeds_rad_s: Joints, for_s: float) -> RigMotion:
        """Turn the joints for ``for_s``; a renewal continues smoothly."""
        return self._link.move("arm.jog_joints", speeds_rad_s=speeds_rad_s, for_s=for_s)

    def move_joints(self, target_rad: Joints, speed_rad_s: float) -> RigMotion:
        """Turn all joints to ``target_rad``; none goes faster than ``speed_rad_s``."""
        return self._link.move("arm.move_joints", target_rad=target_rad, speed_rad_s=speed_rad_s)


class RigGripper(_Remote):
    """The gripper of the rig."""

    lost_holding = False

    def _previous_state(self) -> Mapping[str, Any]:
        return {"lost_holding": self.lost_holding}

    def _leave(self) -> None:
        row = self._row
        if row:
            died_holding = self._link.lost is not None and row["grip"][2]
            self.lost_holding = bool(row["lost_holding"] or died_holding)
        super()._leave()

    def status(self) -> GripStatus:
        """Return the last status of the gripper."""
        grip = self._row.get("grip")
        return GripStatus(math.nan, math.nan, holding=False) if grip is None else GripStatus(*grip)

    @property
    def homed(self) -> bool:
        """True if the gripper is homed or does not need homing."""
        return bool(self._row.get("homed", False))

    def home(self) -> RigMotion:
        """Find the origin, with empty jaws only; raises ``RefusedError`` without homing."""
        return self._link.move("gripper.home")

    def acknowledge(self) -> None:
        """Acknowledge a fast stop or fault, on the operator's command."""
        self._link.order("gripper.acknowledge")

    def grip(self, force_n: float) -> RigMotion:
        """Close until a piece is held with ``force_n`` per finger."""
        return self._link.move("gripper.grip", force_n=force_n)

    def open_to(self, width_mm: float, speed_mm_s: float) -> RigMotion:
        """Open (or close) to ``width_mm``; refused while a piece is held."""
        return self._link.move("gripper.open_to", width_mm=width_mm, speed_mm_s=speed_mm_s)

    def open_held(
        self, right: ReleaseAuthorisation, width_mm: float, speed_mm_s: float
    ) -> RigMotion:
        """Open on a held piece if ``right`` and the measurements of the rig permit it."""
        return self._link.move(
            "gripper.open_held",
            right=type(right).__name__,
            evidence=asdict(right),
            width_mm=width_mm,
            speed_mm_s=speed_mm_s,
        )

    def open_step(
        self, right: ReleaseEvidence | None, width_mm: float, speed_mm_s: float, force_n: float
    ) -> RigMotion:
        """Open by one step of an opening in stages; the rig checks its ``right`` and the limits."""
        return self._link.move(
            "gripper.open_step",
            evidence=None if right is None else asdict(right),
            width_mm=width_mm,
            speed_mm_s=speed_mm_s,
            force_n=force_n,
        )

    def stop(self) -> None:
        """Stop and keep the grip, or close loosened jaws; does not wait."""
        self._link.say("stop gripper")


CONNECT_S = 10.0
WAIT_S = 0.01


class BenchDevices:
    """The five devices of a lab file.

    Parameters
    ----------
    settings
        Tables of the lab file.
    now_s
        Bench clock, s; it must follow the computer's monotonic clock.
    raw
        Streams to fill: pictures, untared wrist samples in tool axes, positions of ``G``, bench mm.
    interlock
        Permits motion: the rig gets its lease, latch and limits.

    Raises
    ------
    InputError
        If a driver is unknown or a setting is missing.

    """

    def __init__(
        self,
        settings: HardwareSettings,
        now_s: Callable[[], float],
        raw: RawStreams,
        interlock: Interlock,
    ) -> None:
        make_devices(settings, now_s)  # reports missing settings now, not in the rig
        self.link = RigLink(settings, now_s, raw.samples, raw.poses, interlock)
        open_ones: set[str] = set()
        self.force_torque = RigForceTorque("force_torque", self.link, now_s, open_ones)
        self.gripper = RigGripper("gripper", self.link, now_s, open_ones)
        self.tactile = {
            finger: make_tactile(finger, settings, now_s, raw.frames[finger]) for finger in FINGERS
        }
        self.arm = RigArm("arm", self.link, now_s, open_ones)
        if settings.melfa.stiffness_mode == "controller":
            self.arm.place_late_s = PLACE_LATE_S

    @property
    def devices(self) -> Mapping[str, Device]:
        """All five by name, in the order of connection: sensors first, the arm last."""
        cameras = {camera.name: camera for camera in self.tactile.values()}
        ordered: dict[str, Device] = {"force_torque": self.force_torque, **cameras}
        return {**ordered, "gripper": self.gripper, "arm": self.arm}

    def connect(self, cancel: threading.Event, limit_s: float = CONNECT_S) -> None:
        """Connect all, each within ``limit_s``. Raises the first ``FaultError``; connected devices
        stay connected. The arm depends on the wrist sensor, so it comes last.
        """
        for device in self.devices.values():
            device.connect(limit_s, cancel)

    def home(self, cancel: threading.Event) -> None:
        """Home the gripper if it needs it; raises ``FaultError``. Only on the operator's command:
        with a piece between the jaws the origin would be wrong. ``cancel`` stops it.
        """
        if self.gripper.homed:
            return
        motion = self.gripper.home()
        while not motion.done:
            if cancel.wait(WAIT_S):
                self.gripper.stop()
                return
        motion.result()

    def close(self) -> None:
        """Close all, the arm first, then the rig process."""
        for device in reversed(tuple(self.devices.values())):
            device.close()
        self.link.close()
