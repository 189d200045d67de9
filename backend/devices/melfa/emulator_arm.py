"""Motion of the emulated MELFA arm."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from enum import Enum

import numpy as np

from touchdown.backend.core import FloatArray
from touchdown.backend.devices.melfa.protocol_mxt import CYCLE_S, FLANGE_MM, JOINTS

NOISE_RAD = 1e-7
"""Standard deviation of the encoder feedback."""
LIMITS_RAD = np.array([joint.limit_rad for joint in JOINTS])
SPEEDS_RAD_S = np.array([joint.speed_rad_s for joint in JOINTS])
_SOLVE_STEPS = 60


def frame_of(joints_rad: FloatArray) -> FloatArray:
    """Return the (4, 4) frame of the flange in the base."""
    # Written out: arrays so small take ten times as long.
    x, y, z = [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]
    at_mm = [0.0, 0.0, 0.0]
    for joint, angle in zip(JOINTS, joints_rad.tolist(), strict=True):
        c, s = math.cos(angle), math.sin(angle)
        at_mm = [p + joint.rise_mm * k for p, k in zip(at_mm, z, strict=True)]
        if joint.axis == "z":
            x, y = _turned(x, y, c, s)
        else:
            z, x = _turned(z, x, c, s)
    at_mm = [p + FLANGE_MM * k for p, k in zip(at_mm, z, strict=True)]
    return np.array([*zip(x, y, z, at_mm, strict=True), (0.0, 0.0, 0.0, 1.0)])


def _turned(a: list[float], b: list[float], c: float, s: float) -> tuple[list[float], list[float]]:
    """Return two axes after a turn from the first to the second, by its cosine and sine."""
    pairs = tuple(zip(a, b, strict=True))
    return [c * p + s * q for p, q in pairs], [c * q - s * p for p, q in pairs]


def solve(frame: FloatArray, near_rad: FloatArray) -> FloatArray | None:
    """Return joints (6,) that reach ``frame`` from ``near_rad``, None if none was found."""
    joints = near_rad.copy()
    for _ in range(_SOLVE_STEPS):
        error = _apart(frame_of(joints), frame)
        if np.linalg.norm(error[:3]) < 1e-6 and np.linalg.norm(error[3:]) < 1e-9:
            return joints if (np.abs(joints) <= LIMITS_RAD).all() else None
        joints = joints + np.clip(np.linalg.lstsq(_slopes(joints), error, rcond=1e-8)[0], -0.3, 0.3)
    return None


class Nearby:
    """Joints for places near the first one: its slopes serve for all of them."""

    def __init__(self, joints_rad: FloatArray) -> None:
        self._joints = joints_rad.copy()
        self._pull = np.linalg.pinv(_slopes(joints_rad))

    def solve(self, frame: FloatArray) -> FloatArray | None:
        """Return joints (6,) that reach ``frame`` from the last, None if none was found."""
        joints = self._joints
        for _ in range(_SOLVE_STEPS):
            error = _apart(frame_of(joints), frame)
            if np.abs(error).max() < 1e-6:
                self._joints = joints
                return joints if (np.abs(joints) <= LIMITS_RAD).all() else None
            joints = joints + self._pull @ error
        return None


def _slopes(joints_rad: FloatArray, step_rad: float = 1e-6) -> FloatArray:
    here = frame_of(joints_rad)
    columns = [
        _apart(here, frame_of(joints_rad + step_rad * np.eye(6)[k])) / step_rad for k in range(6)
    ]
    return np.stack(columns, axis=1)


def _apart(here: FloatArray, there: FloatArray) -> FloatArray:
    """Return (6,) the way in mm and the turn in rad from one frame to another."""
    turn = there[:3, :3] @ here[:3, :3].T
    axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    size = float(np.linalg.norm(axis))
    angle = math.atan2(size, float(np.trace(turn)) - 1.0)
    turned = axis * (angle / size) if size > 1e-12 else np.zeros(3)
    return np.concatenate([there[:3, 3] - here[:3, 3], turned])


def angles_of(hand: FloatArray, euler: str) -> tuple[float, float, float]:
    """Return A, B, C (rad) of a rotation (3, 3); ``euler`` as in the settings."""
    if euler.startswith("Rz"):
        b = math.asin(min(max(-float(hand[2, 0]), -1.0), 1.0))
        return math.atan2(hand[2, 1], hand[2, 2]), b, math.atan2(hand[1, 0], hand[0, 0])
    b = math.asin(min(max(float(hand[0, 2]), -1.0), 1.0))
    return math.atan2(-hand[1, 2], hand[2, 2]), b, math.atan2(-hand[0, 1], hand[0, 0])


def hand_of(a: float, b: float, c: float, euler: str) -> FloatArray:
    """Return the rotation (3, 3) of A, B, C."""
    ca, sa, cb, sb = math.cos(a), math.sin(a), math.cos(b), math.sin(b)
    cc, sc = math.cos(c), math.sin(c)
    about_x = np.array([[1, 0, 0], [0, ca, -sa], [0, sa, ca]])
    about_y = np.array([[cb, 0, sb], [0, 1, 0], [-sb, 0, cb]])
    about_z = np.array([[cc, -sc, 0], [sc, cc, 0], [0, 0, 1]])
    if euler.startswith("Rz"):
        return np.asarray(about_z @ about_y @ about_x)
    return np.asarray(about_x @ about_y @ about_z)


class Joints:
    """Command, filtered command and encoder feedback of six joints, in cycles."""

    def __init__(self, start_rad: FloatArray, cycle_s: float, lag_s: float, seed: int = 1) -> None:
        self._cycle_s, self._lag_s = cycle_s, lag_s
        self._rng = np.random.default_rng(seed)
        self.command_rad = start_rad.copy()
        self.filtered_rad = start_rad.copy()
        self.true_rad = start_rad.copy()
        self.feedback_rad = start_rad.copy()
        self.filter_s = 0.010
        self.frozen = False
        """Fault: the encoders tell the same for ever."""

    def cycle(self) -> None:
        """Advance by one control cycle."""
        t = self._cycle_s
        # New arrays, so that whoever reads from another thread has one of one instant.
        command = self.command_rad
        filtered, true = self.filtered_rad, self.true_rad
        self.filtered_rad = filtered + (command - filtered) * _share(t, self.filter_s)
        self.true_rad = true + (command - true) * _share(t, self._lag_s)
        if not self.frozen:
            noise = self._rng.normal(0.0, NOISE_RAD, 6)
            self.feedback_rad = self.true_rad + noise

    def currents(self) -> FloatArray:
        """Return (6,) in %: as the joint is behind, by what it is behind at its top speed."""
        behind = self.command_rad - self.true_rad
        return np.asarray(100.0 * behind / (SPEEDS_RAD_S * max(self._lag_s, self._cycle_s)))


def _share(cycle_s: float, lag_s: float) -> float:
    return 1.0 - math.exp(-cycle_s / lag_s) if lag_s > 0.0 else 1.0


LAG_S = 0.15
ASK_S, STAND_S = 3.0, 60.0
LIFT_MM, LIFT_MM_S, UNLOAD_MM = 2.0, 10.0, 10.0
IN_A_ROW = 3
WRITTEN = (
    "MDSPD", "MDTRV", "MDTHR", "MDDEP", "MDRMP", "MDHLD", "MDKX", "MDKY", "MDKZ", "MDUNL", "MDUSP",
    "MDDMP", "MDFRM",
)  # fmt: skip
"""What must have been written before it runs."""
UNLOAD, ABORT = 2, 3
"""Values of MDO; 0 waits, 1 lifts."""


class Step(Enum):
    """Where the program is."""

    DESCEND = "descend"
    PRESS = "press"
    ASKED = "asked"
    UNLOADING = "unloading"
    STANDING = "standing"
    LIFTING = "lifting"
    ENDED = "ended"


class EmulatedProbe:
    """One run of the program from joints (6,); ``force_n`` on the tool (3,) in axes of the base."""

    def __init__(
        self,
        joints_rad: FloatArray,
        variables: Mapping[str, float],
        force_n: Callable[[], FloatArray],
    ) -> None:
        self._variables, self._force_n = variables, force_n
        self._offset_n = force_n()
        self._arm = Nearby(joints_rad)
        self._frame = frame_of(joints_rad)
        self._taught_mm = self._frame[:3, 3].copy()
        self._start_mm = self._touch_mm = float(self._taught_mm[2])
        self._give_mm = np.zeros(3)
        self._lasted_s = 0.0
        self._over = 0
        self.step = Step.DESCEND

    def cycle(self) -> FloatArray | None:
        """Advance by one cycle; return the joints (6,), None where no place has any."""
        force_n = self._force_n() - self._offset_n
        self._lasted_s += CYCLE_S
        self._advance(float(force_n[2]))
        stiffness = np.array([self._variables[name] for name in ("MDKX", "MDKY", "MDKZ")])
        self._give_mm += (force_n / stiffness - self._give_mm) * (CYCLE_S / (LAG_S + CYCLE_S))
        frame = self._frame.copy()
        frame[:3, 3] = self._taught_mm + self._give_mm
        return self._arm.solve(frame)

    def _go(self, step: Step) -> None:
        self.step, self._lasted_s = step, 0.0

    def _advance(self, press_n: float) -> None:
        order = round(self._variables["MDO"])
        if order == ABORT and self.step not in (Step.DESCEND, Step.LIFTING, Step.ENDED):
            self._go(Step.LIFTING)
        steps: dict[Step, Callable[[float, int], None]] = {
            Step.DESCEND: self._descend,
            Step.PRESS: self._press,
            Step.ASKED: self._ask,
            Step.UNLOADING: self._unload,
            Step.STANDING: self._stand,
            Step.LIFTING: self._lift,
            Step.ENDED: lambda press_n, order: None,
        }
        steps[self.step](press_n, order)

    def _press(self, press_n: float, order: int) -> None:
        told = self._variables
        self._down(told["MDDEP"] / told["MDRMP"], self._touch_mm - told["MDDEP"])
        if self._lasted_s >= told["MDHLD"]:
            self._go(Step.ASKED)

    def _ask(self, press_n: float, order: int) -> None:
        if order == UNLOAD:
            self._start_mm = float(self._taught_mm[2])
            self._go(Step.UNLOADING)
        elif order or self._lasted_s >= ASK_S:
            self._go(Step.LIFTING)

    def _unload(self, press_n: float, order: int) -> None:
        self._taught_mm[2] += self._variables["MDUSP"] * CYCLE_S
        rose_mm = float(self._taught_mm[2]) - self._start_mm
        if press_n <= self._variables["MDUNL"] or rose_mm >= UNLOAD_MM:
            self._go(Step.STANDING)

    def _stand(self, press_n: float, order: int) -> None:
        if order != UNLOAD or self._lasted_s >= STAND_S:
            self._go(Step.LIFTING)

    def _lift(self, press_n: float, order: int) -> None:
        self._taught_mm[2] += LIFT_MM_S * CYCLE_S
        if self._taught_mm[2] >= self._touch_mm + LIFT_MM:
            self.step = Step.ENDED

    def _descend(self, press_n: float, order: int) -> None:
        told = self._variables
        self._over = self._over + 1 if press_n > told["MDTHR"] else 0
        if self._over >= IN_A_ROW:
            self._touch_mm = float(self._taught_mm[2])
            self._go(Step.PRESS)
            return
        least_mm = self._start_mm - told["MDTRV"]
        self._down(told["MDSPD"], least_mm)
        if self._taught_mm[2] <= least_mm:
            self.step = Step.ENDED

    def _down(self, speed_mm_s: float, least_mm: float) -> None:
        self._taught_mm[2] = max(float(self._taught_mm[2]) - speed_mm_s * CYCLE_S, least_mm)
