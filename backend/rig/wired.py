"""All five devices of a bench file over their wires, connected in the order that is safe."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping

from backend.config.hardware import HardwareSettings
from backend.core.flow import FINGERS, Finger, TactileFrame
from backend.core.stream import SampleStream, Stream
from backend.devices.cameras.making import make_tactile
from backend.devices.force_torque.making import make_force_torque
from backend.devices.melfa.making import make_arm
from backend.devices.protocols import Device
from backend.devices.wsg.driver import WsgGripper
from backend.devices.wsg.making import make_gripper

CONNECT_S = 10.0
WAIT_S = 0.01


class WiredDevices:
    """Drivers by a bench file; they put what they sense into the given streams.

    ``now_s`` runs in step with the computer's own monotonic clock.
    """

    def __init__(
        self,
        settings: HardwareSettings,
        now_s: Callable[[], float],
        frames: Mapping[Finger, Stream[TactileFrame]],
        samples: SampleStream,
        poses: SampleStream,
    ) -> None:
        self.force_torque = make_force_torque(settings, now_s, samples)
        self.gripper = make_gripper(settings, now_s)
        self.tactile = {
            finger: make_tactile(finger, settings, now_s, frames[finger]) for finger in FINGERS
        }
        self.arm = make_arm(settings, now_s, samples, poses)

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
        gripper = self.gripper
        if not isinstance(gripper, WsgGripper) or gripper.homed:
            return
        motion, never = gripper.home(), threading.Event()
        while not motion.done:
            never.wait(WAIT_S)
        motion.result()

    def close(self) -> None:
        """Close all, the arm first."""
        for device in reversed(tuple(self.devices.values())):
            device.close()
