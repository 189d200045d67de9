"""Safety rules of the real-time process: silent links, limits of orders, release.

Functions and state machines without clock, thread or wire::

    backend's heartbeat older than 250 ms    HOLD; a motion under way is a fault until reset
    motion lease not renewed for 2 s         HOLD; a new order is needed (jogs end before)
    either of these                          loosened jaws close
    STOP asked                               STOP, latched until reset; loosened jaws close
    backend gone (pipe closed, no parent)    STOP, then the process ends
    error of this program                    STOP and a fault

The backend's guards check commands as well; these rules hold even if the backend fails. Every
condition is a positive comparison, so that NaN and missing values are refused.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import astuple, dataclass
from typing import Any

from touchdown.backend.config import Limits
from touchdown.backend.core import Fault, Pose, RefusedError
from touchdown.backend.devices import (
    LEASE_S,
    MAX_WIDTH_CHANGE_MM,
    STATIONARY_MM,
    UNLOADED_N,
    Arm,
    ByHand,
    Gripper,
    HomingGripper,
    JigEvidence,
    Motion,
    PressCommand,
    ReleaseAuthorisation,
    ReleaseEvidence,
    StagedOpening,
    jig_refusal,
    refuse_outside,
    release_refusal,
    stop_jaws,
)

BACKEND_SILENT_S = 0.25  # the backend beats at least every 50 ms
# A run whose thread is later than this beyond its lease loses its motion; disks take time.
LAPSED_S = 2.0 - LEASE_S
WRENCH_SILENT_S = 0.3  # no new motion after a longer silence of the wrist sensor


def control_lost(what: str) -> Fault:
    """Return the fault of a rig process that is gone or does not answer."""
    return Fault(
        "CONTROL-LOST",
        what,
        "The controllers stop the devices by their own rules; the gripper was not opened.",
        "Look at the bench, press Reset, then connect arm, gripper and wrist sensor again.",
        "arm",
    )


ENDED = control_lost("The process that drives arm, gripper and wrist sensor was ordered to end.")


@dataclass(frozen=True, slots=True)
class FailsafeInput:
    """Inputs of a cycle: control words of the shared memory and state of the devices. ``moving`` is
    True during a motion of the arm, ``gone`` after the loss of the backend; ``wrench_s`` is the
    time of the newest finite wrench (-inf before the first).
    """

    beats: int
    stops: int
    lease_until_s: float
    moving: bool = False
    gone: bool = False
    wrench_s: float = -math.inf


@dataclass(frozen=True, slots=True)
class FailsafeOutput:
    """Actions of a cycle, the strongest first; ``fault`` is reported, ``leave`` ends the process.
    ``why`` is the fault of motions that end by this, None for an ordinary stop.
    """

    stop: bool = False
    hold: bool = False
    leave: bool = False
    fault: Fault | None = None
    why: Fault | None = None


class Failsafe:
    """Latches and watchdogs of one rig; not thread-safe."""

    def __init__(self, now_s: float, limits: Limits) -> None:
        self.limits = limits
        self._beats, self._beat_s = -1, now_s
        self._silent = False
        self._lease_until_s = -math.inf
        self._wrench_s = -math.inf
        self._stops = self._stops_reset = 0
        self._faults: list[Fault] = []
        self._faults_reset = 0

    @property
    def latched(self) -> bool:
        """True while a STOP or a fault waits for the operator's reset."""
        return self._stops > self._stops_reset or len(self._faults) > self._faults_reset

    @property
    def stops(self) -> int:
        """Number of STOPs."""
        return self._stops

    @property
    def faults(self) -> int:
        """Number of faults, and number of the newest fault."""
        return len(self._faults)

    # -- cycle ------------------------------------------------------------------------------------

    def step(self, now_s: float, inbox: FailsafeInput) -> FailsafeOutput:
        """Process the inputs of a cycle; return the actions."""
        if inbox.beats != self._beats:
            self._beats, self._beat_s, self._silent = inbox.beats, now_s, False
        self._lease_until_s = inbox.lease_until_s
        self._wrench_s = max(self._wrench_s, inbox.wrench_s)
        if inbox.gone:
            return FailsafeOutput(stop=True, leave=True, why=ENDED)
        if inbox.stops > self._stops:
            self._stops = inbox.stops
            return FailsafeOutput(stop=True)
        if not now_s - self._beat_s <= BACKEND_SILENT_S:
            return self._fall_silent(now_s - self._beat_s, moving=inbox.moving)
        if inbox.moving and not now_s <= inbox.lease_until_s + LAPSED_S:
            return FailsafeOutput(hold=True, why=LAPSED)
        return FailsafeOutput()

    def _fall_silent(self, silent_s: float, *, moving: bool) -> FailsafeOutput:
        known, self._silent = self._silent, True
        if known or not moving:
            return FailsafeOutput(hold=moving)
        fault = Fault(
            "BACKEND-SILENT",
            f"The program stood still for {1e3 * silent_s:.0f} ms during a motion.",
            "The arm was held; jaws that were opening in stages close.",
            "Look at the load of this computer, then press Reset.",
            "arm",
        )
        return FailsafeOutput(hold=True, fault=self.latch(fault), why=fault)

    # -- messages ---------------------------------------------------------------------------------

    def latch(self, fault: Fault) -> Fault:
        """Latch a fault until the reset."""
        self._faults.append(fault)
        return fault

    def stop(self, stops: int) -> bool:
        """Latch STOP number ``stops``; return True if it is new."""
        news = stops > self._stops
        self._stops = max(self._stops, stops)
        return news

    def reset(self, stops: int, faults: int) -> None:
        """Reset the STOPs and faults up to these numbers, which the operator has seen."""
        self._stops_reset = max(self._stops_reset, min(stops, self._stops))
        self._faults_reset = max(self._faults_reset, min(faults, len(self._faults)))

    def refuse(self, now_s: float, lease_until_s: float) -> None:
        """Raise ``RefusedError`` unless motion is permitted now; a command includes its lease."""
        if self._stops > self._stops_reset:
            raise RefusedError("STOPPED", "The rig process was stopped: press Reset first.")
        if len(self._faults) > self._faults_reset:
            raise RefusedError("FAULT", f"{self._faults[-1].what} Press Reset first.")
        if self._silent:
            raise RefusedError("BACKEND-SILENT", "The program that gave this order is silent.")
        if not now_s <= max(lease_until_s, self._lease_until_s):
            raise RefusedError("NO-LEASE", "There is no live motion lease.")

    def refuse_unfelt(self, now_s: float) -> None:
        """Raise ``RefusedError`` while the wrist sensor is silent."""
        age_s = now_s - self._wrench_s
        if not age_s <= WRENCH_SILENT_S:
            raise RefusedError("FT-STALE", "The wrist sensor is silent: nothing moves without it.")


LAPSED = Fault(
    "LEASE-LAPSED",
    "The permission to move was not renewed in time.",
    "The arm was held; the gripper was not opened.",
    "Give the order again.",
    "arm",
)


Arguments = Mapping[str, Any]
RIGHTS: dict[str, type[ReleaseEvidence] | type[JigEvidence] | type[ByHand]] = {
    right.__name__: right for right in (ReleaseEvidence, JigEvidence, ByHand)
}
# Arm motion requires a lease, no latch, and a working wrist sensor.
MOVES = frozenset(
    {"arm.move_to", "arm.jog", "arm.jog_joints", "arm.move_joints", "arm.press", "arm.unload"}
)
# Jaw motion in a run requires a lease and no latch.
JAWS = frozenset({"gripper.grip", "gripper.open_to", "gripper.open_held", "gripper.open_step"})


@dataclass(slots=True)
class DriverCommands:
    """Commands of arm and gripper; ``open_held`` checks the release conditions first.

    ``staged`` is the opening in stages in progress; meanwhile the arm stands still.
    """

    arm: Arm
    gripper: Gripper
    measured: Callable[[], RigMeasurement]
    now_s: Callable[[], float]
    staged: StagedOpening | None = None
    closing: Motion | None = None  # of loosened jaws

    def give(self, name: str, given: Arguments, limits: Limits) -> Motion | list[float] | None:
        """Execute command ``name``; return its motion, a value, or None."""
        if name.startswith("gripper."):
            return self._move_gripper(name, given)
        if name in MOVES and self.staged is not None:
            raise RefusedError(
                "JAWS-LOOSE", "The jaws opened in stages: grip or open before the arm moves."
            )
        match name:
            case "arm.servo":
                self.arm.servo(bool(given["on"]))
            case "arm.halt":
                self.arm.halt()
            case "arm.place_of":
                return list(astuple(self.arm.place_of(tuple(given["joints_rad"]))))
            case _:
                return self._move_arm(name, given, limits)
        return None

    def _move_arm(self, name: str, given: Arguments, limits: Limits) -> Motion:
        arm = self.arm
        match name:
            case "arm.move_to":
                target = Pose(*given["target"])
                refuse_outside(target, limits)
                _refuse_fast("SPEED", given["speed_mm_s"], limits.speed_mm_s)
                _refuse_fast("TURN-SPEED", given["turn_rad_s"], limits.turn_rad_s)
                return arm.move_to(target, given["speed_mm_s"], given["turn_rad_s"])
            case "arm.jog":
                velocity, turning = given["velocity_mm_s"], given["turn_rad_s"]
                _refuse_fast("SPEED", math.hypot(*velocity), limits.jog_mm_s)
                _refuse_fast("TURN-SPEED", math.hypot(*turning), limits.turn_rad_s)
                return arm.jog(tuple(velocity), given["for_s"], tuple(turning))
            case "arm.jog_joints":
                speeds = tuple(given["speeds_rad_s"])
                _refuse_fast("TURN-SPEED", max(map(abs, speeds)), limits.turn_rad_s)
                return arm.jog_joints(speeds, given["for_s"])
            case "arm.move_joints":
                _refuse_fast("TURN-SPEED", given["speed_rad_s"], limits.turn_rad_s)
                return arm.move_joints(tuple(given["target_rad"]), given["speed_rad_s"])
            case "arm.press":
                stiffness = tuple(given["stiffness_n_mm"])
                command = PressCommand(**{**given, "stiffness_n_mm": stiffness})
                if not command.nominal_n <= limits.probe_n:
                    what = f"Nominal {command.nominal_n:.1f} N is over the limit."
                    raise RefusedError("PRESS-FORCE", what)
                _refuse_fast("APPROACH-SPEED", command.approach_mm_s, limits.contact_speed_mm_s)
                return arm.press(command)
            case "arm.unload":
                _refuse_fast("SPEED", given["speed_mm_s"], limits.speed_mm_s)
                return arm.unload(given["force_n"], given["speed_mm_s"])
        raise ValueError(f"there is no order {name!r}")

    def _move_gripper(self, name: str, given: Arguments) -> Motion | None:
        gripper = self.gripper
        match name:
            case "gripper.grip":
                gripping = gripper.grip(given["force_n"])
                if self.staged is not None:
                    self.closing, self.staged = gripping, None
                return gripping
            case "gripper.open_to":
                if gripper.status().holding:
                    raise RefusedError(
                        "HOLDING",
                        "A piece is held: the gripper opens only for an authorised release.",
                    )
                return self._open(given)
            case "gripper.open_held":
                refuse_opening(RIGHTS[given["right"]](**given["evidence"]), self.measured())
                return self._open(given)
            case "gripper.open_step":
                return self._open_step(given)
            case "gripper.home" | "gripper.acknowledge":
                if not isinstance(gripper, HomingGripper):
                    raise RefusedError("NO-HOMING", "This gripper is not homed from here.")
                if name == "gripper.home":
                    return gripper.home()
                gripper.acknowledge()
                return None
        raise ValueError(f"there is no order {name!r}")

    def _open(self, given: Arguments) -> Motion:
        opening = self.gripper.open_to(given["width_mm"], given["speed_mm_s"])
        self.staged = None
        return opening

    def _open_step(self, given: Arguments) -> Motion:
        measured, staged = self.measured(), self.staged
        if given["evidence"] is not None:
            refuse_opening(ReleaseEvidence(**given["evidence"]), measured)
            staged = StagedOpening(self.gripper.status().width_mm, given["force_n"])
        if staged is None:
            raise RefusedError("NOT-STAGED", "No opening in stages is in progress.")
        if not 0 <= measured.wrench_age_s <= OLD_S:
            raise RefusedError("RIG-WRENCH-OLD", "The rig has no fresh wrench.")
        staged.take_step(given["width_mm"], self.now_s(), measured.moved_mm)
        self.staged = staged
        return self.gripper.open_to(given["width_mm"], given["speed_mm_s"])

    def stop_gripper(self) -> Motion | None:
        """Stop the jaws and keep the grip; close loosened jaws and return this motion."""
        staged, self.staged = self.staged, None
        self.closing = stop_jaws(self.gripper, staged, self.closing)
        return self.closing


def _refuse_fast(name: str, speed: float, most: float) -> None:
    """Raise ``RefusedError`` unless ``0 <= speed <= most``; NaN is refused."""
    if not 0.0 <= speed <= most * (1.0 + 1e-9):
        raise RefusedError(name, f"A speed of {speed:.3g} is not within 0 to {most:.3g}.")


OLD_S = 0.05  # maximum age of a wrench used as evidence


@dataclass(frozen=True, slots=True)
class RigMeasurement:
    """Measurements of the rig for a release, NaN if unknown: press force by the contact law's own
    zero, largest travel of the standing arm (``travelled_mm``), change of the width since the grip.
    """

    press_n: float
    wrench_age_s: float
    moved_mm: float
    width_change_mm: float
    holding: bool
    devices_ready: bool


def refuse_opening(right: ReleaseAuthorisation, measured: RigMeasurement) -> None:
    """Raise ``RefusedError`` with the name of the first unmet condition."""
    refusal = next(_rows(right, measured), None)
    if refusal is not None:
        raise RefusedError(*refusal)


def _rows(right: ReleaseAuthorisation, m: RigMeasurement) -> Iterator[tuple[str, str]]:
    if isinstance(right, ByHand):
        if not right.confirmed:
            yield "NOT-CONFIRMED", "A piece is held: opening drops it. Confirm first."
    else:
        release = isinstance(right, ReleaseEvidence)
        told = release_refusal(right) if release else jig_refusal(right)  # type: ignore[arg-type]
        if told is not None:
            yield told
        yield from _ready_rows(m)
    if not 0 <= m.moved_mm <= STATIONARY_MM:
        yield "RIG-ARM-MOVING", "The rig measures that the arm is not standing still."
    if isinstance(right, ReleaseEvidence):
        yield from _pressed_rows(m)


def _ready_rows(m: RigMeasurement) -> Iterator[tuple[str, str]]:
    if not m.devices_ready:
        yield "RIG-DEVICES", "Arm, wrist sensor and gripper are not all ready."
    if not m.holding:
        yield "RIG-NOT-HOLDING", "The gripper tells that it holds no piece."
    if not abs(m.width_change_mm) <= MAX_WIDTH_CHANGE_MM:
        change_mm = m.width_change_mm
        yield "RIG-WIDTH", f"The jaws moved by {change_mm:.2f} mm since the piece was gripped."


def _pressed_rows(m: RigMeasurement) -> Iterator[tuple[str, str]]:
    if not 0 <= m.wrench_age_s <= OLD_S:
        yield "RIG-WRENCH-OLD", "The rig has no fresh wrench."
    if not UNLOADED_N[0] <= m.press_n <= UNLOADED_N[1]:
        yield (
            "RIG-NOT-UNLOADED",
            f"The rig feels {m.press_n:.2f} N: not {UNLOADED_N[0]} to {UNLOADED_N[1]} N.",
        )
