"""Devices whose connection does what a test says."""

import threading

from touchdown.backend.core.faults import Fault, FaultError
from touchdown.backend.devices.protocols import ConnectionSteps, DeviceState, Health, Identity

LINES = ("force_torque", "tactile_left", "tactile_right", "gripper", "arm")


class ScriptedDevice:
    """Connects at once; ``fails_at`` names the step that fails; ``hold`` waits for the test."""

    def __init__(self, name, log):
        self.name, self._log = name, log
        self.state, self.identity = DeviceState.CLOSED, None
        self.steps, self.fault = ConnectionSteps(), None
        self.serial, self.fails_at, self.hold = f"{name}-1", "", None

    @property
    def health(self):
        return Health(0.0, 0.0, 0, 0)

    def describe(self):
        return {}

    def connect(self, timeout_s, cancel):
        self._log.append(f"connect {self.name}")
        self.state = DeviceState.CONNECTING
        self.steps.begin()
        for step in ("reach", "identify", "configure", "first sample"):
            while self.hold is not None and not self.hold.wait(0.005):
                if cancel.is_set():
                    self._fail("cancelled")
            if step == self.fails_at:
                self._fail(step)
            self.steps.reached(step)
        self.identity = Identity("Maker", "Model", self.serial, "1")
        self.state = DeviceState.READY

    def close(self):
        if self.state is not DeviceState.CLOSED:
            self._log.append(f"close {self.name}")
        self.state = DeviceState.CLOSED

    def lose(self):
        """Be pulled out."""
        self.state = DeviceState.FAULT
        self.fault = Fault(
            "LINK", f"The {self.name} is lost.", "It stands.", "Plug it in.", self.name
        )

    def stop(self):
        self._log.append(f"stop {self.name}")

    def _fail(self, why):
        self.state = DeviceState.CLOSED
        raise FaultError(
            Fault("LINK", f"{self.name}: {why}.", "Nothing moved.", "Look at it.", self.name)
        )


def scripted():
    """Return (devices, log)."""
    log = []
    return {name: ScriptedDevice(name, log) for name in LINES}, log


def held():
    return threading.Event()
