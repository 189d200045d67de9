"""Emulated arm, gripper and wrist sensor on loopback, and a link to a rig process that drives them.

As a program (settings as its argument) it is a backend that moves the arm until it is killed.
"""

import sys
import threading
import time

import numpy as np

from tests.backend.devices.melfa.emulated_arm import settings as melfa_settings
from tests.busy_computer import STARVED
from touchdown.backend.config.hardware import HardwareSettings
from touchdown.backend.core import FaultError, Pose, RefusedError, SampleStream
from touchdown.backend.devices.dynpick.emulator import EmulatedDynpick
from touchdown.backend.devices.interlock import Interlock
from touchdown.backend.devices.melfa import READY_RAD, EmulatedMelfa, MelfaServer
from touchdown.backend.devices.melfa.driver import MelfaPrograms
from touchdown.backend.devices.wsg.emulator import EmulatedWsg
from touchdown.backend.emulation import Faults, TcpServer, add_noise, hanging_gripper
from touchdown.backend.rig.link import RigLink
from touchdown.backend.rig.remote_devices import RigArm, RigForceTorque, RigGripper

TOP = Pose(0.0, 0.0, 160.0)


class Served:
    """The three emulated devices; ``settings`` lead a driver to them.

    ``serve`` makes the front of the arm, ``feel`` is what the wrist sensor feels at a time.
    """

    def __init__(self, serve=MelfaServer, feel=hanging_gripper, **more):
        # A machine that is busy with other tests may stall: the controller waits for it.
        wanted = melfa_settings(servo_delay_s=0.05, mxt={"mxttout": 2000}, **more)
        start = MelfaPrograms(wanted).placing.joints(np.array([0.0, 0.0, 60.0]), READY_RAD)
        self.arm = serve(EmulatedMelfa(wanted, start_rad=start))
        sensor = EmulatedDynpick(add_noise(feel))
        self.wrist = TcpServer(sensor, faults=Faults("force_torque"))
        self.gripper = TcpServer(EmulatedWsg())
        host, port = self.gripper.address
        self.settings = HardwareSettings.model_validate(
            {
                "melfa": self.arm.settings.model_dump(),
                "wsg": {"host": host, "port": port},
                "ft": {"driver": "dynpick", "address": self.wrist.url},
            }
        )
        for front in (self.arm, self.wrist, self.gripper):
            front.start()

    def close(self):
        for front in (self.arm, self.gripper, self.wrist):
            front.close()


class Backend:
    """Link and devices with an interlock whose lease is renewed on a thread."""

    def __init__(self, settings):
        self.interlock = Interlock()
        samples, poses = SampleStream("force_torque", 6, 8192), SampleStream("arm", 3, 8192)
        begun_s = time.monotonic()
        self.now_s = now_s = lambda: time.monotonic() - begun_s
        self.link = RigLink(settings, now_s, samples, poses, self.interlock)
        open_ones = set()
        self.wrist = RigForceTorque("force_torque", self.link, now_s, open_ones)
        self.gripper = RigGripper("gripper", self.link, now_s, open_ones)
        self.arm = RigArm("arm", self.link, now_s, open_ones)
        self._over = threading.Event()
        self._renewing = threading.Thread(target=self._renew, daemon=True)
        self._renewing.start()

    def _renew(self):
        while not self._over.wait(0.02):
            self.interlock.renew_lease(self.now_s())

    def connect(self):
        for device in (self.wrist, self.gripper, self.arm):
            device.connect(10.0, threading.Event())

    def moving(self):
        """Connect and rise; return the motion once the arm is on its way."""
        for _ in range(10):
            try:
                self.connect()
                self.interlock.renew_lease(self.now_s())
                motion = self.arm.move_to(TOP, 10.0)
                while not self.arm.pose(1.0).z_mm > 61.0:
                    if motion.done:
                        motion.result()
                    self._over.wait(0.01)
            except (FaultError, RefusedError) as error:
                code = error.fault.code if isinstance(error, FaultError) else error.reason
                if code not in STARVED:
                    raise
                self.disconnect()
                self.interlock.reset()
            else:
                return motion
        raise AssertionError("this machine stalls all the time")

    def disconnect(self):
        for device in (self.arm, self.gripper, self.wrist):
            device.close()

    def close(self):
        self.disconnect()
        self.link.close()
        self._over.set()
        self._renewing.join()


if __name__ == "__main__":
    backend = Backend(HardwareSettings.model_validate_json(sys.argv[1]))
    backend.moving()
    sys.stdout.write(f"{backend.link.hello['pid']}\n")
    sys.stdout.flush()
    threading.Event().wait()
