"""A rig in this process: the driver of an emulated arm, a scripted gripper, a hand-wound clock."""

import threading

import numpy as np
import pytest

from tests.backend.devices.melfa.emulated_arm import Rig
from tests.backend.rig.scripted import ScriptedDevice
from touchdown.backend.config import Limits
from touchdown.backend.core.faults import RefusedError
from touchdown.backend.devices import CommandedMotion, DeviceState, GripStatus
from touchdown.backend.rig.host import Devices, RigHost
from touchdown.backend.rig.memory import BACKEND_BEAT, STOPS, drop, make
from touchdown.backend.rig.messages import read_error, read_fault

ROUND_US = 4000


def reason(call, *given):
    """Return the reason with which ``call`` is refused."""
    with pytest.raises(RefusedError) as caught:
        call(*given)
    return caught.value.reason


class HeldPiece(ScriptedDevice):
    """A gripper that holds a piece of 30 mm."""

    def __init__(self, log):
        super().__init__("gripper", log)
        self.grip_status = GripStatus(30.0, 10.0, holding=True)

    def status(self):
        return self.grip_status

    def open_to(self, width_mm, speed_mm_s):
        self._log.append(f"open to {width_mm}")
        return CommandedMotion({"width_mm": width_mm})

    def grip(self, force_n):
        self._log.append(f"grip {force_n}")
        return CommandedMotion({"force_n": force_n})


class Wrist(ScriptedDevice):
    """Only its stream matters here."""

    rated = np.full(6, 100.0)


class Hosted:
    """``beats`` is whether the backend lives; its lease is renewed all the while."""

    def __init__(self, **limits):
        self.log, self.said = [], []
        self.arms = Rig()
        self.clock, self.arm = self.arms.wires.clock, self.arms.arm
        self.gripper, self.wrist = HeldPiece(self.log), Wrist("force_torque", self.log)
        self.memory, path = make()
        drop(path)
        devices = Devices(self.arm, self.gripper, self.wrist, self.arms.wrench, self.arm.poses)
        self.host = RigHost(devices, Limits(**limits), self.clock.now_s, self.memory, self._hear)
        self.beats, self._until_s = True, None
        self._heard, self._number = threading.Condition(), 0
        self.gripper.state = self.wrist.state = DeviceState.READY

    def close(self):
        self.host.leave()
        self.arm.close()

    def connected(self):
        self.arm.connect(1.0, threading.Event())
        self.rounds(0.1)
        return self

    def _hear(self, message):
        with self._heard:
            self.said.append(message)
            self._heard.notify_all()
        return True

    def told(self, kind):
        return [message for message in self.said if message["kind"] == kind]

    def fault_of(self, motion):
        """The fault with which motion number ``motion`` ended; None if it went well."""
        (ended,) = [m for m in self.told("ended") if m["motion"] == motion]
        return read_fault(ended["fault"])

    def rounds(self, seconds, *, until=None):
        """Let time pass in rounds; return whether the host wants to leave."""
        for _ in range(round(seconds * 1e6 / ROUND_US)):
            if until is not None and until():
                return False
            self.arms.wires.advance(ROUND_US)
            if self.beats:
                self.memory.beat(BACKEND_BEAT)
            self.memory.permit(self.lease_s())
            if self.host.round():
                return True
        return False

    def lease_s(self):
        return self.clock.now_s() + 0.25 if self._until_s is None else self._until_s

    def neglect(self, since_s):
        """Nobody has renewed the lease for so long, and nobody does."""
        self._until_s = self.clock.now_s() - since_s + 0.25

    def renew(self):
        """Somebody renews it again."""
        self._until_s = None

    def order(self, name, **arguments):
        """Give an order, wait for its answer, return the number of its motion or its value."""
        self._number += 1
        number = self._number
        order = {"kind": "order", "id": number, "order": name, "args": arguments}
        self.host.take({**order, "lease_until_s": self.lease_s()})

        def answers():
            return [m for m in self.told("reply") if m["id"] == number]

        with self._heard:
            assert self._heard.wait_for(answers, 30.0)
        (answer,) = answers()
        if "error" in answer:
            raise read_error(answer["error"])
        return answer["value"] if answer["motion"] is None else answer["motion"]

    def lift(self):
        target = (0.0, 0.0, 100.0, 0.0, 0.0, 0.0)
        return self.order("arm.move_to", target=target, speed_mm_s=20.0, turn_rad_s=0.1)

    def stop(self, number):
        self.memory.beat(STOPS)
        self.host.take({"kind": "stop", "stops": number})
