"""One motion with one fault at a random instant, and what must hold whatever the fault was."""

import random
import threading
from collections.abc import Callable

import numpy as np

from tests.backend.devices.melfa.emulated_arm import Rig
from tests.backend.devices.trials import Ended
from touchdown.backend.core.values import Pose
from touchdown.backend.devices.melfa.realtime_protocol import (
    CYCLE_S,
    MxtCommand,
    decode_mxt_request,
)
from touchdown.backend.devices.protocols import DeviceState, PressCommand

SPEED_MM_S = 20.0
LEAD_MM = 3 * CYCLE_S * SPEED_MM_S
PRESS = PressCommand(1.5, 1.5, 2.0, 2.0, 1.0, 6.0, (30.0, 30.0, 15.0))
TOUCH_MM = 59.6
ALARMS = (50, 61, 70, 2000, 2601, 4140, 4242, 6020)
READY, FAULT = DeviceState.READY, DeviceState.FAULT


class Trial:
    """Draws everything from ``seed``."""

    def __init__(self, seed: int) -> None:
        self.seed, self.rng = seed, random.Random(seed)
        self.rig = Rig()
        self.rig.noise_n = 0.05
        self.rig.contact = _spring
        self.allowed = {READY}
        self.codes: set[str] = set()

    def run(self) -> Ended:
        rig = self.rig
        rig.arm.connect(1.0, threading.Event())
        rig.rest(0.6)
        motion = self.rng.choice(("travel", "jog", "press"))
        self._begin(motion)
        rig.rest(self.rng.uniform(0.0, 1.0))
        fault = self.rng.choice(tuple(self._faults()))
        sent = len(rig.wires.packets)
        self._faults()[fault]()
        rig.rest(0.8)
        return Ended(self.seed, motion, fault, tuple(self._broken(sent, fault)))

    def _begin(self, motion: str) -> None:
        arm = self.rig.arm
        if motion == "travel":
            arm.move_to(Pose(self.rng.uniform(-20, 20), 0.0, 80.0), SPEED_MM_S)
        elif motion == "jog":
            arm.jog((self.rng.uniform(-SPEED_MM_S, SPEED_MM_S), 0.0, 1.0), 2.0)
        else:
            arm.press(PRESS)

    def _faults(self) -> dict[str, Callable[[], None]]:
        return {
            "link cut": self._cut,
            "driver stalled": self._stall,
            "loss": self._loss,
            "late and doubled": self._late,
            "garbage": self._garbage,
            "error": self._error,
            "servo off": self._servo_off,
            "program ends": self._program_ends,
            "right taken": self._right_taken,
            "no number": self._no_number,
            "blow": self._blow,
            "stop": self._stop,
            "halt": self.rig.arm.halt,
        }

    def _cut(self) -> None:
        cycles = self.rng.randint(1, 40)
        self.rig.wires.link.cut = True
        self.rig.wires.advance(3500 * cycles)
        self.rig.wires.link.cut = False
        self._silence(cycles)

    def _stall(self) -> None:
        cycles = self.rng.randint(1, 40)
        self.rig.wires.stalled = True
        self.rig.wires.advance(3500 * cycles)
        self.rig.wires.stalled = False
        self._silence(cycles)

    def _silence(self, cycles: int) -> None:
        """A fault from 29 cycles on, and none below; on the edge the phase decides."""
        if cycles >= 28:
            self.allowed, self.codes = {FAULT}, {"MXT-LOST"}
        if cycles in (28, 29):
            self.allowed = {READY, FAULT}

    def _loss(self) -> None:
        self.rig.wires.link.loss = 0.2

    def _late(self) -> None:
        link = self.rig.wires.link
        link.duplicate, link.late = 0.2, lambda: self.rng.choice((0, 0, 0, 1, 4))

    def _garbage(self) -> None:
        self.rig.wires.link.garbage = 0.3

    def _error(self) -> None:
        self.rig.device.controller.raise_error(self.rng.choice(ALARMS))
        self._controller_fault()

    def _servo_off(self) -> None:
        self.rig.device.controller.switch_servo(False)
        self._controller_fault()

    def _program_ends(self) -> None:
        self.rig.device.controller.finish_program()
        self._controller_fault()

    def _controller_fault(self) -> None:
        self.allowed = {FAULT}
        self.codes = {
            *("MXT-ENDED", "MXT-LOST", "HW-STOP", "OUT-OF-RANGE", "NOT-READY"),
            *("REJECTED", "CONTROLLER"),
        }

    def _right_taken(self) -> None:
        """The stream needs no right: it goes on."""
        self.rig.device.controller.right = object()

    def _no_number(self) -> None:
        self.rig.contact = lambda _: np.full(3, np.nan)

    def _blow(self) -> None:
        self.rig.contact = lambda _: np.array([0.0, 0.0, 50.0])

    def _stop(self) -> None:
        self.rig.arm.stop()

    def _broken(self, sent: int, fault: str) -> list[str]:
        rig, arm = self.rig, self.rig.arm
        packets = [decode_mxt_request(data) for _, data in rig.wires.packets]
        told = [p for p in packets if p.command is MxtCommand.MOVE]
        joints = np.array([p.target.axes[:6] for p in told])
        places = np.array([rig.placing.pivot_mm(row) for row in joints])
        step_mm = np.linalg.norm(np.diff(places, axis=0), axis=1).max()
        after_end = [p.command for p in packets[sent:]]
        ended = after_end.index(MxtCommand.END) if MxtCommand.END in after_end else len(after_end)
        rows = {
            f"state {arm.state}": arm.state in self.allowed,
            f"fault {arm.fault}": arm.fault is None or arm.fault.code in self.codes,
            f"a step of {step_mm:.3f} mm": step_mm <= 1.05 * LEAD_MM,
            "a command after the end": MxtCommand.MOVE not in after_end[ended:],
            "the controller found it too fast": rig.device.stream.largest_share <= 0.5,
            f"error {rig.device.controller.error}": self._error_is_theirs(fault),
            "the arm still moves in a fault": arm.state is READY or not self._moves(),
        }
        return [name for name, holds in rows.items() if not holds]

    def _error_is_theirs(self, fault: str) -> bool:
        error = self.rig.device.controller.error
        return error in (0, *ALARMS) if fault in ("error", "servo off") else error == 0

    def _moves(self) -> bool:
        before = self.rig.true_mm
        self.rig.rest(0.05)
        return float(np.abs(self.rig.true_mm - before).max()) > 0.01


def _spring(pivot_mm):
    return np.array([0.0, 0.0, 8.0 * max(TOUCH_MM - pivot_mm[2], 0.0)])


def trial(seed: int) -> Ended:
    """Run one."""
    return Trial(seed).run()
