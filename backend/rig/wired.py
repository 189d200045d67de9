"""All five devices of a bench file, connected in the order that is safe.

Arm, gripper and wrist sensor live in the rig process, which starts with the first connection;
the cameras, which have no deadlines, in this one.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping

from backend.config.hardware import HardwareSettings
from backend.core.flow import FINGERS, Finger, TactileFrame
from backend.core.stream import SampleStream, Stream
from backend.devices.cameras.making import make_tactile
from backend.devices.interlock import Interlock
from backend.devices.melfa.force_program import PLACE_LATE_S
from backend.devices.protocols import Device
from backend.rig.link import RigLink
from backend.rig.process import make_devices
from backend.rig.remote import RigArm, RigForceTorque, RigGripper

CONNECT_S = 10.0
WAIT_S = 0.01


class WiredDevices:
    """Drivers by a bench file; they put what they sense into the given streams.

    ``now_s`` runs in step with the computer's own monotonic clock. ``interlock`` permits motion:
    its lease, its latch and its limits reach the rig. Raises ``InputError`` for bad settings.
    """

    def __init__(
        self,
        settings: HardwareSettings,
        now_s: Callable[[], float],
        frames: Mapping[Finger, Stream[TactileFrame]],
        samples: SampleStream,
        poses: SampleStream,
        interlock: Interlock,
    ) -> None:
        make_devices(settings, now_s)  # what the settings lack is told now, not in the rig
        self.link = RigLink(settings, now_s, samples, poses, interlock)
        open_ones: set[str] = set()
        self.force_torque = RigForceTorque("force_torque", self.link, now_s, open_ones)
        self.gripper = RigGripper("gripper", self.link, now_s, open_ones)
        self.tactile = {
            finger: make_tactile(finger, settings, now_s, frames[finger]) for finger in FINGERS
        }
        self.arm = RigArm("arm", self.link, now_s, open_ones)
        if settings.melfa.stiffness_mode == "controller":
            self.arm.place_late_s = PLACE_LATE_S

    @property
    def devices(self) -> Mapping[str, Device]:
        """All five by name, sensors first and the arm last: as they are connected."""
        cameras = {camera.name: camera for camera in self.tactile.values()}
        ordered: dict[str, Device] = {"force_torque": self.force_torque, **cameras}
        return {**ordered, "gripper": self.gripper, "arm": self.arm}

    def connect(
        self,
        cancel: threading.Event,
        tell: Callable[[str], None] = lambda name: None,
        limit_s: float = CONNECT_S,
    ) -> None:
        """Connect all, each within ``limit_s``; ``tell`` hears the name of each before.

        Raises the first ``FaultError``.

        The arm moves on what the wrist feels, so it comes last; what is connected stays so.
        """
        for name, device in self.devices.items():
            tell(name)
            device.connect(limit_s, cancel)

    def home(self) -> None:
        """Home the gripper if it needs it; raises ``FaultError``.

        On the operator's word only: with a piece between the jaws the origin would be wrong.
        """
        if self.gripper.homed:
            return
        motion, never = self.gripper.home(), threading.Event()
        while not motion.done:
            never.wait(WAIT_S)
        motion.result()

    def close(self) -> None:
        """Close all, the arm first, then the rig process."""
        for device in reversed(tuple(self.devices.values())):
            device.close()
        self.link.close()
