"""Probe: press and assemble the signals into an episode; touch to find heights and edges."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from touchdown.backend.config import EARLY_TICKS, SAMPLES_PER_PROBE, TICK_S
from touchdown.backend.core import (
    Fault,
    FaultError,
    FloatArray,
    PhaseEntered,
    Pose,
    RefusedError,
    Said,
    ScenePicture,
)
from touchdown.backend.episodes import HOMOGRAPHY_KEY, PADS_KEY
from touchdown.backend.runs import messages, motions
from touchdown.backend.runs.bench import Bench, PressedProbe
from touchdown.backend.runs.jig import approach_with_piece
from touchdown.backend.runs.plan import Plan, Wait
from touchdown.backend.sensing import DRAGGED, TorsionSlipDetector, assemble_episode, synchronise

BEFORE_ONSET_S = 0.3
LEVEL_S = 0.2  # A tilted face rotates until it lies flat; slip in the grasp counts after this time
AFTER_LAST_TICK_S = 0.08  # arrival of the frame after the last tick (25 Hz plus jitter)
# The estimator gets all ticks but the last this long before the end, when the frame after the last
# but one has arrived
EARLY_S = 0.06
PRESSES = 2  # of a probe whose episodes are rejected
HUSH_S = 0.02  # lead time for repaints in progress to end before the decision
LONGEST_HUSH_S = 0.08


def press_once(
    bench: Bench, probe: int, offset_mm: FloatArray | None = None, *, decides: bool = False,
    drag_mm: float = 0.0,
) -> Plan[PressedProbe]:  # fmt: skip
    """Press and stay pressed; return the probe, accepted or not.

    ``offset_mm`` (2,) is the commanded displacement; with None it is the arm position. ``decides``:
    a decision follows at once, so repaints are held off. A press that is void after a short dropout
    of arm or wrist is repeated. A press dragged along y by ``drag_mm`` is not accepted.
    """

    def after_void(fault: Fault) -> Plan[None]:
        yield Said(bench.now_s(), f"Probe {probe} is void: {fault.what} Pressing again.")
        yield from motions.lift(bench, probe)

    press = partial(_press, bench, probe, offset_mm, decides=decides, drag_mm=drag_mm)
    return (yield from motions.retry_if_void(bench, press, after_void))


def _press(
    bench: Bench, probe: int, offset_mm: FloatArray | None, *, decides: bool, drag_mm: float
) -> Plan[PressedProbe]:
    yield from motions.zero_sensors(bench, probe)
    yield PhaseEntered(bench.now_s(), "approach", probe)
    here = bench.arm.pose(max_age_s=0.2)
    motion = bench.arm.press(motions.probe_command(bench, drag_mm))
    limit_s = 60.0
    yield Wait(lambda: motion.done or motion.onset_s is not None, limit_s, "contact")
    if motion.onset_s is not None:
        yield PhaseEntered(bench.now_s(), "press", probe)
    level_s = bench.now_s() + LEVEL_S
    yield Wait(lambda: motion.done or bench.now_s() >= level_s, limit_s, "the faces to meet")
    turning = TorsionSlipDetector(bench.sensing.fields)
    yield Wait(lambda: motion.done or turning.update(), limit_s, "the press to end")
    _refuse_turned(bench, turning)
    try:
        motion.result()
    except FaultError as cause:
        if cause.fault.code == "NO-CONTACT":
            # The arm is below any expected contact: return to the start of the press.
            yield from motions.move_to(bench, here, "the arm to go back up")
        raise
    onset_s = motion.onset_s
    if onset_s is None:
        raise FaultError(
            Fault(
                "NO-CONTACT",
                "The press ended without a contact.",
                "The probe is void; the gripper was not opened.",
                "Check the height of the support.",
                "arm",
            )
        )
    yield PhaseEntered(bench.now_s(), "hold", probe)
    end_s = onset_s + SAMPLES_PER_PROBE * TICK_S + AFTER_LAST_TICK_S
    scene = scene_pictures(bench)
    yield Wait(lambda: bench.now_s() >= end_s - EARLY_S or turning.update(), 5.0, "the last ticks")
    _refuse_turned(bench, turning)
    so_far = bench.sensing.recording(onset_s - BEFORE_ONSET_S, bench.now_s())
    bench.estimator.prepare(synchronise(so_far, onset_s).observation()[:EARLY_TICKS])
    yield Wait(lambda: bench.now_s() >= end_s - HUSH_S, 5.0, "the last frames")
    if decides:
        bench.repaint_hold.begin(LONGEST_HUSH_S)
    yield Wait(lambda: bench.now_s() >= end_s, 5.0, "the last frames")
    _refuse_turned(bench, turning)
    sampled_s = bench.wall_s()
    episode = assemble_episode(
        replace(bench.sensing.recording(onset_s - BEFORE_ONSET_S, end_s), scene=scene),
        onset_s=onset_s,
        offset_mm=np.array([here.x_mm, here.y_mm]) if offset_mm is None else offset_mm,
        piece=bench.piece.name,
        metadata=_calibration(bench),
    )
    if drag_mm:
        reasons = (*episode.quality.reasons, DRAGGED)
        episode = replace(
            episode, quality=replace(episode.quality, accepted=False, reasons=reasons)
        )
    return PressedProbe(episode, probe, end_s, sampled_s)


def _refuse_turned(bench: Bench, turning: TorsionSlipDetector) -> None:
    if not turning.update():
        return
    fault = turned_fault(turning.turned_rad)
    bench.interlock.raise_fault(fault)
    raise FaultError(fault)


def turned_fault(turned_rad: float) -> Fault:
    """Return the fault of a piece that rotated by ``turned_rad`` according to the markers."""
    return Fault(
        "PIECE-TURNED",
        f"The piece turned in the grasp: the markers by {math.degrees(turned_rad):.1f}°.",
        "Motion stopped; the probe in progress is void; the gripper was not opened.",
        "Take the piece out or grip it again by hand, then press Reset.",
        "gripper",
    )


def scene_pictures(bench: Bench) -> tuple[ScenePicture, ...]:
    """Return a picture of the bench, none without a scene camera."""
    if bench.scene_view is None:
        return ()
    return (ScenePicture(bench.now_s(), bench.scene_view.picture()),)


def _calibration(bench: Bench) -> tuple[tuple[str, str], ...]:
    """Return the metadata of a probe: pads, scene camera, references, drift and calibrations."""
    view = bench.scene_view
    pads = ((PADS_KEY, f"{bench.piece.width_mm:g}"),)
    board = pads if view is None else (*pads, (HOMOGRAPHY_KEY, view.homography.text()))
    references = bench.sensing.references.items()
    rest = ((f"reference_{finger}", taken.sha256) for finger, taken in references)
    drift = bench.sensing.drift
    drifted = () if drift is None else (("wrist_drift", drift.text()),)
    return (*board, *rest, *drifted, *bench.calibrations)


def probe_until_accepted(bench: Bench, probe: int) -> Plan[PressedProbe]:
    """Probe; lift and press again after a rejected episode, at most ``PRESSES`` times in all.

    Rejected episodes are kept in the store with their reasons.
    """
    for _ in range(PRESSES):
        pressed = yield from press_once(bench, probe, decides=True)
        if pressed.episode.quality.accepted:
            return pressed
        bench.repaint_hold.end()
        yield Said(bench.now_s(), messages.rejected_message(probe, pressed.episode.quality.reasons))
        bench.store.keep(pressed.episode)
        yield from motions.lift(bench, probe)
        yield from motions.wait_until_durable(bench)
    reasons = "; ".join(pressed.episode.quality.reasons)
    raise FaultError(
        Fault(
            "PROBE-REJECTED",
            f"Probe {probe} was rejected {PRESSES} times: {reasons}.",
            "The run ended; the gripper stays closed, the arm is lifted.",
            "Check the named sensor, then press Reset.",
        )
    )


# Touch probing with the held piece

SEARCH_MM = 3.0  # search range on both sides of the expected edge
RESOLUTION_MM, FINE_MM = 0.1, 0.05
BELOW_MM = 1.2  # Without contact this far below the centre's height, the piece is beside the bottom
DEPTH_MM, TOUCH_S = 0.1, 0.1
SETTLE_S = 0.3


def find_height(bench: Bench, centre: FloatArray) -> Plan[float]:
    """Carry the piece over ``centre`` (2,), touch, and return the height of contact.

    Raises ``RefusedError`` "ORIGIN-FAR" without contact.
    """
    x_mm, y_mm = centre.tolist()
    start_mm = (bench.piece.grip_height_mm or 0.0) + bench.settings.probe.start_height_mm
    yield from approach_with_piece(bench, Pose(x_mm, y_mm, start_mm))
    contact_mm = yield from touch_height_mm(bench, centre, start_mm, 2.0 * BELOW_MM)
    if contact_mm is None:
        raise RefusedError("ORIGIN-FAR", "No contact at the expected centre of the bottom.")
    return contact_mm


def edge_mm(
    bench: Bench,
    centre: FloatArray,
    axis: int,
    side: float,
    start_mm: float,
    to_mm: float = RESOLUTION_MM,
) -> Plan[float]:
    """Return the distance from ``centre`` along ``axis`` where contact ends, by bisection to
    ``to_mm``.

    ``side`` is +1 or -1; descents begin at ``start_mm``. Raises ``RefusedError`` "ORIGIN-FAR" if
    the edge is more than ``SEARCH_MM`` off.
    """
    expected_mm = bench.piece.face.half_extents_mm[axis] + bench.outline.half_extents_mm[axis]
    inside, outside = expected_mm - SEARCH_MM, expected_mm + SEARCH_MM
    least, most = inside, outside
    while outside - inside > to_mm:
        middle = 0.5 * (inside + outside)
        place = centre.copy()
        place[axis] += side * middle
        touched = yield from touch_height_mm(bench, place, start_mm, BELOW_MM)
        if touched is None:
            outside = middle
        else:
            inside = middle
    if inside == least or outside == most:
        raise RefusedError(
            "ORIGIN-FAR", f"The bottom is more than {SEARCH_MM:.0f} mm from where it should be."
        )
    return side * 0.5 * (inside + outside)


def touch_height_mm(
    bench: Bench, place: FloatArray, start_mm: float, below_mm: float
) -> Plan[float | None]:
    """Descend at ``place`` (2,) from ``start_mm``; return the height of contact, None without one.

    The descent ends ``below_mm`` below the usual contact height. The arm ends at ``start_mm``. A
    void touch is repeated.
    """
    touch = partial(_touched_mm, bench, place, start_mm, below_mm)
    return (
        yield from motions.retry_if_void(
            bench, touch, void_touch(bench, start_mm), motions.TOUCH_TRIES
        )
    )


def void_touch(bench: Bench, start_mm: float) -> Callable[[Fault], Plan[None]]:
    """Return the plan after a void touch: say why, rise to ``start_mm``."""

    def after_void(fault: Fault) -> Plan[None]:
        yield Said(bench.now_s(), f"The touch is void: {fault.what} Touching again.")
        yield from rise_from_contact(bench, start_mm)

    return after_void


def rise_from_contact(bench: Bench, start_mm: float) -> Plan[None]:
    """Rise straight up to ``start_mm`` from where the contact pushed the arm, without dragging."""
    yield PhaseEntered(bench.now_s(), "lift", 0)
    here = bench.arm.pose(max_age_s=0.2)
    up = Pose(here.x_mm, here.y_mm, start_mm)
    yield from motions.move_to(bench, up, "the arm to lift")


def _touched_mm(
    bench: Bench, place: FloatArray, start_mm: float, below_mm: float
) -> Plan[float | None]:
    x_mm, y_mm = place.tolist()
    yield from motions.move_to(bench, Pose(x_mm, y_mm, start_mm), "the arm to shift")
    yield from motions.wait(bench, SETTLE_S)
    yield PhaseEntered(bench.now_s(), "approach", 0)
    press = bench.arm.press(
        motions.press_command(bench, DEPTH_MM, TOUCH_S, 2.0 * TOUCH_S, below_mm)
    )
    yield Wait(lambda: press.done, motions.MOVE_S, "the touch to end")
    onset_s = press.onset_s
    try:
        press.result()
    except FaultError as cause:
        if cause.fault.code != "NO-CONTACT":
            raise
    height_mm = None
    if onset_s is not None:
        poses = bench.arm.poses.window(onset_s - 0.1, onset_s + 0.1)
        height_mm = float(np.interp(onset_s, poses.t_s, poses.values[:, 2]))
    yield from rise_from_contact(bench, start_mm)
    return height_mm
