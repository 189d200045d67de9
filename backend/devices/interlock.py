"""Safety interlock of arm, gripper: stop latch, motion lease, limits, release conditions.

Plans and windows use the guarded devices only. ``stop`` works from any thread in every state, never
waits and never opens the gripper; jaws that open in stages close. Motion needs a lease: the owner
of the motion renews it, and motion ends when it expires. Each refusal has a name
(``RefusedError.reason``).

Translation directions are unit vectors in the bench frame, z points up. Turns are (3, 3) in the
bench frame; ``surface_mm`` is the height of ``G`` at which a held piece touches the support, NaN if
unknown.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np

from touchdown.backend.config import Limits
from touchdown.backend.core import (
    LEVEL_TOLERANCE_RAD,
    Fault,
    FloatArray,
    Pose,
    RefusedError,
    SampleStream,
    TouchdownError,
    pose_rotation,
    rotation_angle_rad,
    tilt_margin_rad,
    tilt_rad,
)
from touchdown.backend.devices.protocols import RETREAT_FAULTS, Gripper, Motion

LEAST_OVERRIDE = 0.1  # below this, a move of a run would exceed its time limit
LEASE_S = 0.25  # motion ends this long after the last renewal


@dataclass(frozen=True, slots=True)
class ReleaseEvidence:
    """Conditions for opening the jaws in a run. ``press_n`` and its age are read after unloading;
    ``moved_mm`` is the largest travel of the standing arm (``travelled_mm``); ``width_change_mm``
    is relative to the grasp; ``approved`` is True if no approval is required.
    """

    verdict_stable: bool
    verdict_of_last_probe: bool
    verdict_age_s: float
    margin_mm: float
    required_margin_mm: float
    quality_accepted: bool
    slip_mm: float
    press_n: float
    wrench_age_s: float
    wrench_age_limit_s: float
    moved_mm: float
    width_change_mm: float
    holding: bool
    approved: bool


MAX_VERDICT_AGE_S = 5.0
UNLOADED_N = (0.3, 2.0)
MAX_RELEASE_SLIP_MM = 0.3
STATIONARY_MM = 0.05
MAX_WIDTH_CHANGE_MM = 0.3


# Conditions on the estimate; only these are waived for the untested-release baseline.
VERDICT_ROWS = frozenset(
    {"VERDICT-NOT-STABLE", "VERDICT-NOT-LAST", "VERDICT-OLD", "MARGIN", "QUALITY"}
)


def release_refusal(evidence: ReleaseEvidence, *, untested: bool = False) -> tuple[str, str] | None:
    """Return None if the piece may be released, else (name, sentence) of the first refusal.

    Every condition is a positive comparison, so that NaN refuses. ``untested`` waives the
    conditions on the estimate: the pick-and-place baseline has none.
    """
    e = evidence
    rows = (
        ("VERDICT-NOT-STABLE", e.verdict_stable, "This probe did not find the piece stable."),
        ("VERDICT-NOT-LAST", e.verdict_of_last_probe, "The estimate is not of the last probe."),
        ("VERDICT-OLD", 0 <= e.verdict_age_s <= MAX_VERDICT_AGE_S, "The estimate is too old."),
        (
            "MARGIN",
            e.margin_mm >= e.required_margin_mm and math.isfinite(e.margin_mm),
            f"The margin {e.margin_mm:.2f} mm is below {e.required_margin_mm:.2f} mm.",
        ),
        ("QUALITY", e.quality_accepted, "The episode was not accepted."),
        (
            "SLIP",
            0 <= e.slip_mm <= MAX_RELEASE_SLIP_MM,
            f"The piece slipped by {e.slip_mm:.2f} mm in the grasp.",
        ),
        ("WRENCH-OLD", 0 <= e.wrench_age_s <= e.wrench_age_limit_s, "The wrench is too old."),
        (
            "NOT-UNLOADED",
            UNLOADED_N[0] <= e.press_n <= UNLOADED_N[1],
            f"{e.press_n:.2f} N press force: not {UNLOADED_N[0]} to {UNLOADED_N[1]} N.",
        ),
        ("ARM-MOVING", 0 <= e.moved_mm <= STATIONARY_MM, "The arm is not standing still."),
        (
            "WIDTH",
            abs(e.width_change_mm) <= MAX_WIDTH_CHANGE_MM,
            f"The grip width changed by {e.width_change_mm:.2f} mm.",
        ),
        ("NOT-HOLDING", e.holding, "The gripper does not hold a piece."),
        ("NOT-APPROVED", e.approved, "The operator has not approved this release."),
    )
    for name, holds, sentence in rows:
        if not holds and not (untested and name in VERDICT_ROWS):
            return name, sentence
    return None


# An opening in stages: largest step of the width, least time of a step, and largest sum.
STAGE_MM, STAGE_S, STAGES_MM = 0.1, 1.0, 4.0
WIDTH_NOISE_MM = 0.05


class StagedOpening:
    """Opening of the jaws in small held steps, from the first one to the grip or to open jaws.

    Meanwhile STOP and faults close the jaws with ``force_n`` a finger, and nothing else moves.
    ``width_mm``: measured width before the first step.
    """

    def __init__(self, width_mm: float, force_n: float) -> None:
        self.force_n = force_n
        self._gripped_mm = self._width_mm = width_mm
        self._stepped_s = -math.inf

    def take_step(self, width_mm: float, now_s: float, moved_mm: float) -> None:
        """Record a step to ``width_mm``; raise ``RefusedError`` if it breaks a limit.

        ``moved_mm`` is the largest travel of the standing arm (``travelled_mm``). NaN is refused.
        """
        if not 0.0 < self.force_n < math.inf:
            raise RefusedError("STAGE-FORCE", "The jaws could not close again without a force.")
        step_mm = width_mm - self._width_mm
        noise_mm = WIDTH_NOISE_MM if math.isinf(self._stepped_s) else 1e-6  # of the measured width
        if not 0.0 < step_mm <= STAGE_MM + noise_mm:
            raise RefusedError("STAGE-STEP", f"{step_mm:.2f} mm is not within 0 to {STAGE_MM} mm.")
        if not width_mm - self._gripped_mm <= STAGES_MM:
            raise RefusedError("STAGE-WIDTH", f"The jaws would open by more than {STAGES_MM} mm.")
        if not now_s - self._stepped_s >= STAGE_S - 1e-6:
            raise RefusedError("STAGE-EARLY", f"Each step is held for {STAGE_S:.0f} s.")
        if not 0 <= moved_mm <= STATIONARY_MM:
            raise RefusedError("ARM-MOVING", "The arm is not standing still.")
        self._width_mm, self._stepped_s = width_mm, now_s


CLOSES = "Motion stopped; the jaws had opened in stages and are told to close."


def stop_jaws(
    gripper: Gripper, staged: StagedOpening | None, closing: Motion | None
) -> Motion | None:
    """Stop the gripper and keep the grip; close jaws that a ``staged`` opening has loosened.

    ``closing``: what the last call returned. A further stop does not interrupt it.
    """
    if staged is not None:
        try:
            return gripper.grip(staged.force_n)
        except TouchdownError:
            closing = None
    if closing is None or closing.done:
        gripper.stop()
        return None
    return closing


class Interlock:
    """Stop latch, motion lease, limits and latched faults. Thread-safe.

    Parameters
    ----------
    limits
        Limits of motion and force; the defaults of ``Limits`` if None.

    """

    def __init__(self, limits: Limits | None = None) -> None:
        self.limits: Limits = limits or Limits()
        self._lock = threading.RLock()
        self._stoppers: list[tuple[Callable[[], None], Callable[[], None] | None]] = []
        self.stopped_by: str = ""  # source of the stop, empty if not stopped
        self.faults: tuple[Fault, ...] = ()  # latched faults, oldest first
        self.lease_until_s: float = -math.inf  # bench time until which motion is permitted
        # Factor of every commanded speed in air, ``LEAST_OVERRIDE`` to 1; presses are unaffected.
        self.override: float = 1.0
        # True from the reset of a fault until the wrist is free of contact: meanwhile the arm moves
        # by hand only, slowly and away from contact.
        self.recovering: bool = False
        # Description of a late or slow device, empty if there is none. Meanwhile the arm moves by
        # hand only away from contact.
        self.degraded = ""
        self.late: Mapping[str, str] = {}  # description by device of all that are late or slow
        # True only on a simulated bench while the pick-and-place baseline runs.
        self.untested_release = False
        self.staged: StagedOpening | None = None  # the opening in stages in progress

    @property
    def latched(self) -> bool:
        """True after ``stop`` or a fault, until ``reset``."""
        return bool(self.stopped_by) or bool(self.faults)

    def override_speed(self, share: float) -> None:
        """Set the speed factor of later commands; raises ``RefusedError`` outside the range."""
        if not LEAST_OVERRIDE <= share <= 1.0:
            raise RefusedError("OVERRIDE", f"{100 * share:.0f} % is not within 10 to 100 %.")
        self.override = share

    def change_limits(self, limits: Limits, now_s: float) -> None:
        """Replace the limits; raises ``RefusedError`` while motion is permitted."""
        with self._lock:
            if self.has_lease(now_s):
                raise RefusedError(
                    "MOVING", "The limits cannot change during a motion: wait for its end."
                )
            self.limits = limits

    def on_stop(
        self, stopper: Callable[[], None], retreat: Callable[[], None] | None = None
    ) -> None:
        """Call ``stopper`` at every stop, or ``retreat`` at a fault of ``RETREATS``. Both must
        return at once; without ``retreat`` every fault stops.
        """
        with self._lock:
            self._stoppers.append((stopper, retreat))

    def forget_stoppers(self) -> None:
        """Drop the stoppers of devices that no longer exist."""
        with self._lock:
            self._stoppers.clear()

    def stop(self, who: str = "operator") -> None:
        """Latch, and stop arm and gripper, bypassing their queues."""
        with self._lock:
            self.stopped_by = self.stopped_by or who
            stoppers = tuple(self._stoppers)
        for stopper, _ in stoppers:
            stopper()

    def raise_fault(self, fault: Fault) -> None:
        """Latch ``fault`` (once per code and device); stop, or retreat if that is its reaction. The
        strongest reaction wins: no retreat after a STOP or with a fault that stops. The text names
        the other devices that are late, because the first fault ends a run.
        """
        with self._lock:
            codes = {f.code for f in self.faults}
            if (fault.code, fault.device) not in {(f.code, f.device) for f in self.faults}:
                known = {fault.device, *(f.device for f in self.faults)}
                others = [text for device, text in self.late.items() if device not in known]
                fault = replace(fault, what=" ".join([fault.what, *others]))
                if self.staged is not None:
                    fault = replace(fault, consequence=CLOSES)
                self.faults = (*self.faults, fault)
            stoppers = tuple(self._stoppers)
            stopped = bool(self.stopped_by) or not codes | {fault.code} <= RETREAT_FAULTS
            stopped = stopped or self.staged is not None  # the arm stands until the jaws hold
        for stopper, retreat in stoppers:
            if stopped or retreat is None:
                stopper()
            elif not codes:
                # Only once: an active retreat must not restart.
                retreat()

    def reset(self) -> None:
        """Clear the latch and the faults, on the operator's command only. Moves nothing."""
        with self._lock:
            self.recovering = bool(self.faults)
            self.stopped_by = ""
            self.faults = ()
            self.lease_until_s = -math.inf

    def renew_lease(self, now_s: float) -> None:
        """Renew the permission to move for ``LEASE_S`` from now."""
        with self._lock:
            self.lease_until_s = now_s + LEASE_S

    def drop_lease(self) -> None:
        """Return the permission to move."""
        with self._lock:
            self.lease_until_s = -math.inf

    def has_lease(self, now_s: float) -> bool:
        """Return True while motion is permitted."""
        return now_s <= self.lease_until_s

    def refuse_latched(self) -> None:
        """Raise ``RefusedError`` after a stop or a fault, until ``reset``."""
        with self._lock:
            stopped_by, faults = self.stopped_by, self.faults
        if stopped_by:
            raise RefusedError("STOPPED", f"Stopped by {stopped_by}: press Reset first.")
        if faults:
            what = " ".join(fault.what for fault in faults)
            raise RefusedError("FAULT", f"{what} Press Reset first.")

    def require_motion(self, now_s: float) -> None:
        """Raise ``RefusedError`` unless motion may start now."""
        self.refuse_latched()
        if not self.has_lease(now_s):
            raise RefusedError("NO-LEASE", "There is no live motion lease.")


# Tolerance of the taught position of the jig on each axis.
NEAR_JIG_MM = 0.5
STILL_MM = 0.05
JAMMED_N = 2.0  # limit of the force on any axis for a piece that sits freely in the jig


@dataclass(frozen=True, slots=True)
class JigEvidence:
    """Measurements over the jig. ``from_jig_mm``: largest distance on one axis from the taught
    position; ``moved_mm``: largest travel of the standing arm (``travelled_mm``); ``force_n``:
    largest force beyond the weight of gripper and piece.
    """

    from_jig_mm: float
    moved_mm: float
    force_n: float
    holding: bool


def jig_refusal(evidence: JigEvidence) -> tuple[str, str] | None:
    """Return None if the piece may be released in the jig, else (name, sentence); NaN refuses."""
    e = evidence
    rows = (
        (
            "NOT-AT-JIG",
            0 <= e.from_jig_mm <= NEAR_JIG_MM,
            f"The arm is {e.from_jig_mm:.2f} mm from the taught place of the jig.",
        ),
        ("ARM-MOVING", 0 <= e.moved_mm <= STILL_MM, "The arm is not standing still."),
        ("JAMMED", 0 <= e.force_n <= JAMMED_N, f"{e.force_n:.1f} N on the piece in the jig."),
        ("NOT-HOLDING", e.holding, "The gripper does not hold a piece."),
    )
    return next(((name, sentence) for name, holds, sentence in rows if not holds), None)


@dataclass(frozen=True, slots=True)
class ByHand:
    """Authorisation by the operator."""

    confirmed: bool


ReleaseAuthorisation = ReleaseEvidence | JigEvidence | ByHand


@runtime_checkable
class AuthorisedGripper(Protocol):
    """A gripper that checks the measurements of the rig before it opens on a held piece.

    Its ``stop`` closes the jaws during an opening in stages.
    """

    def open_step(
        self, right: ReleaseEvidence | None, width_mm: float, speed_mm_s: float, force_n: float
    ) -> Motion:
        """Open by one step of an opening in stages; the first one needs its ``right``."""

    def open_held(self, right: ReleaseAuthorisation, width_mm: float, speed_mm_s: float) -> Motion:
        """Open to ``width_mm`` if ``right`` and the measurements permit it, else raise
        ``RefusedError``.
        """


STILL_S = 0.2  # required standstill of the arm before the jaws open
# While a controller program holds the arm, positions come about ten times per second, or less
# often: then the last two positions within this time count.
POSITION_WINDOW_S = 0.8


def recent_positions_mm(poses: SampleStream, now_s: float) -> FloatArray:
    """Return the positions (n, 3) of the last ``STILL_S``, mm; at least the last two, or none."""
    told = poses.window(now_s - POSITION_WINDOW_S, now_s)
    recent = int((told.t_s >= now_s - STILL_S).sum())
    count = len(told.t_s)
    return told.values[count - max(recent, 2) :] if count >= 2 else np.empty((0, 3))


def travelled_mm(places_mm: FloatArray) -> float:
    """Return the largest travel on one axis of ``places_mm`` (n, 3), NaN for fewer than two."""
    return float(np.ptp(places_mm, axis=0).max()) if len(places_mm) > 1 else math.nan


Direction = tuple[float, float, float]


def distance_to_limit_mm(pose: Pose, way: Direction, limits: Limits) -> float:
    """Return the distance of ``G`` to the edge of the workspace along ``way``, mm; 0 outside."""
    across = way[0] ** 2 + way[1] ** 2
    inside = limits.reach_mm**2 - pose.x_mm**2 - pose.y_mm**2
    outwards = pose.x_mm * way[0] + pose.y_mm * way[1]
    room = math.inf
    if across > 0.0:
        root = outwards**2 + across * inside
        room = (math.sqrt(root) - outwards) / across if root > 0.0 else 0.0
    if way[2] > 0.0:
        room = min(room, (limits.highest_mm - pose.z_mm) / way[2])
    elif way[2] < 0.0:
        room = min(room, (limits.lowest_mm - pose.z_mm) / way[2])
    sides = (
        (pose.x_mm, way[0], limits.least_x_mm, limits.most_x_mm),
        (pose.y_mm, way[1], limits.least_y_mm, limits.most_y_mm),
    )
    for at, part, least, most in sides:
        if part != 0.0:
            room = min(room, ((most if part > 0.0 else least) - at) / part)
    return max(room, 0.0)


def outside_box_mm(pose: Pose, limits: Limits) -> float:
    """Return the distance of ``pose`` outside the workspace box, mm; 0 inside."""
    return max(
        0.0,
        limits.least_x_mm - pose.x_mm,
        pose.x_mm - limits.most_x_mm,
        limits.least_y_mm - pose.y_mm,
        pose.y_mm - limits.most_y_mm,
    )


def refuse_outside(target: Pose, limits: Limits) -> None:
    """Raise ``RefusedError`` unless ``target`` is in the workspace."""
    over = math.hypot(target.x_mm, target.y_mm) - limits.reach_mm
    if not over <= 0.0:
        raise RefusedError("REACH", f"The target is {over:.1f} mm outside the workspace.")
    over = outside_box_mm(target, limits)
    if not over <= 0.0:
        raise RefusedError("BOX", f"The target is {over:.1f} mm outside the workspace box.")
    if not limits.lowest_mm <= target.z_mm <= limits.highest_mm:
        raise RefusedError(
            "HEIGHT",
            f"z = {target.z_mm:.1f} mm is not within {limits.lowest_mm:.0f} to "
            f"{limits.highest_mm:.0f} mm.",
        )


def refuse_unknown(press_n: float) -> None:
    """Raise ``RefusedError`` if there is no recent sample of the wrist sensor."""
    if not math.isfinite(press_n):
        raise RefusedError("FT-UNKNOWN", "The force at the wrist is not known.")


def refuse_forced(
    press_n: float, way: Direction, limits: Limits, *, recovering: bool, degraded: str = ""
) -> None:
    """Raise ``RefusedError`` if the contact force forbids ``way``; NaN refuses. ``degraded``
    describes a late or slow device; then only the way out of contact is permitted.
    """
    refuse_unknown(press_n)
    # Below the contact threshold the sign is noise, and up is away from the support.
    up = press_n >= -limits.contact_n
    if (way[2] if up else -way[2]) > 0.99:
        return
    free = "+Z" if up else "\N{MINUS SIGN}Z"
    if abs(press_n) > limits.jog_guard_n:
        raise RefusedError(
            "JOG-FORCE",
            f"Fz is {press_n:.1f} N, over the guard of {limits.jog_guard_n:.0f} N: "
            f"only {free} is possible.",
        )
    if recovering:
        raise RefusedError(
            "RECOVERY", f"After a fault only {free}, away from contact, is possible."
        )
    if degraded:
        raise RefusedError("DEGRADED", f"{degraded} Until it is well only {free} is possible.")
    if abs(press_n) > limits.contact_n and math.hypot(way[0], way[1]) > 1e-6:
        raise RefusedError("DRAGGING", f"Fz is {press_n:.1f} N: lift first, then move sideways.")


def fastest_mm_s(
    pose: Pose, surface_mm: float, press_n: float, limits: Limits, *, recovering: bool
) -> tuple[float, str]:
    """Return the highest speed here, and the reason if it is reduced, else "". ``surface_mm`` is
    the height of ``G`` at which a held piece touches the support; NaN counts as near.
    """
    if not abs(press_n) <= limits.contact_n:
        return limits.contact_speed_mm_s, f"|Fz| over {limits.contact_n:.0f} N"
    if not pose.z_mm - surface_mm >= limits.near_mm:
        return limits.contact_speed_mm_s, f"within {limits.near_mm:.0f} mm of the surface"
    if recovering:
        return limits.recovery_mm_s, "recovery"
    return limits.jog_mm_s, ""


SLACK_RAD = 1e-6  # tolerance of a hand at its limit


def refuse_turning(pose: Pose, surface_mm: float, press_n: float, limits: Limits) -> None:
    """Raise ``RefusedError`` unless the hand may turn, or stay turned, at this position."""
    refuse_unknown(press_n)
    if not abs(press_n) <= limits.contact_n:
        raise RefusedError(
            "TURN-PRESSING", f"Fz is {press_n:.1f} N: lift first, then turn the hand."
        )
    if math.isnan(surface_mm):
        raise RefusedError(
            "TURN-LOW", "The height of the surface is not known: the hand cannot turn over it."
        )
    up_mm = surface_mm + limits.turn_clear_mm - pose.z_mm
    if not up_mm <= 0.0:
        raise RefusedError(
            "TURN-LOW",
            f"The hand turns only {limits.turn_clear_mm:.0f} mm or more above the surface: "
            f"jog +Z by {up_mm:.1f} mm first.",
        )


def refuse_place(pose: Pose, surface_mm: float, limits: Limits) -> None:
    """Raise ``RefusedError`` unless the hand may be at ``pose``."""
    refuse_outside(pose, limits)
    lean_rad = tilt_rad(pose_rotation(pose))
    if not lean_rad <= limits.tilt_rad + SLACK_RAD:
        raise RefusedError(
            "TILT",
            f"The hand would tilt by {math.degrees(lean_rad):.1f}\N{DEGREE SIGN}; "
            f"the limit is {math.degrees(limits.tilt_rad):.0f}\N{DEGREE SIGN}.",
        )
    if rotation_angle_rad(pose) > LEVEL_TOLERANCE_RAD:
        refuse_turning(pose, surface_mm, 0.0, limits)


def turn_to_limit_rad(pose: Pose, axis: Direction, limits: Limits) -> float:
    """Return the turn of the hand about ``axis`` (unit, bench frame) to its limit, rad. At most
    half a turn.
    """
    room = tilt_margin_rad(pose_rotation(pose), np.array(axis), limits.tilt_rad)
    return min(room, math.pi)


def turned_descent_mm(pose: Pose, surface_mm: float, limits: Limits) -> float:
    """Return the distance a turned hand may go down, mm; only the soft limit holds an unturned
    one.
    """
    if rotation_angle_rad(pose) <= LEVEL_TOLERANCE_RAD:
        return math.inf
    return max(pose.z_mm - surface_mm - limits.turn_clear_mm, 0.0)
