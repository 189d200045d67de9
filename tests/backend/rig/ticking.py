"""A rig in this process around one real driver, in real time; the other two devices stay away."""

import math
import threading

import numpy as np

from tests.backend.rig.hosted import Wrist
from tests.backend.rig.inline import InlineLink
from tests.backend.rig.scripted import ScriptedDevice
from touchdown.backend.core.streams import SampleStream
from touchdown.backend.devices import ArmStatus, GripStatus, Interlock, RobotMode, SafetyMode
from touchdown.backend.rig.host import Devices
from touchdown.backend.rig.remote_devices import RigForceTorque, RigGripper

ROUND_S = 0.004


class AwayArm(ScriptedDevice):
    """Is never connected; the arm stands."""

    def status(self):
        return ArmStatus(RobotMode.DISCONNECTED, SafetyMode.UNKNOWN, 0.0, 0)


class AwayGripper(ScriptedDevice):
    """Is never connected."""

    def status(self):
        return GripStatus(math.nan, math.nan, holding=False)


class TickingRig:
    """``gripper`` or ``force_torque``: the driver inside; as attributes, both over the link."""

    def __init__(self, now_s, *, gripper=None, force_torque=None):
        wrist = force_torque or Wrist("force_torque", [])
        samples = getattr(wrist, "samples", None) or SampleStream("force_torque", 6, 64)
        self._poses = poses = SampleStream("arm", 3, 64)
        jaws = gripper or AwayGripper("gripper", [])
        self._interlock, self._now_s = Interlock(), now_s
        self._interlock.renew_lease(now_s())
        devices = Devices(AwayArm("arm", []), jaws, wrist, samples, poses)
        self._link = link = InlineLink(self._interlock, devices, now_s)
        open_ones = set()
        self.gripper = RigGripper("gripper", link, now_s, open_ones)
        self.force_torque = RigForceTorque("force_torque", link, now_s, open_ones)
        self._over = threading.Event()
        self._ticking = threading.Thread(target=self._tick, name="ticking rig")
        self._ticking.start()

    def _tick(self):
        while not self._over.wait(ROUND_S):
            self._interlock.renew_lease(self._now_s())
            self._poses.put(np.array([self._now_s()]), np.zeros((1, 3)))
            self._link.round()

    def close(self):
        self._link.host.leave()
        self._over.set()
        self._ticking.join()


def rounds_pass():
    """Wait until the rig has told how things are by now."""
    threading.Event().wait(10 * ROUND_S)
