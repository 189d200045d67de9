"""Calibration runs: board, payload, wrist, tool, cameras; and the daily check.

A run measures and reports the estimate with its residual; only the daily check is stored at once.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from touchdown.backend.calibration import (
    ON_BOTTOM,
    PAYLOAD_POSES,
    SIDES,
    TOOL_GRIPS,
    CalibrationEstimate,
    CalibrationName,
    PoseReadings,
    Quantity,
    Side,
    SidePress,
    TouchedEdge,
    YawOf,
    dots_to_numbers,
    estimate_board,
    estimate_cameras,
    estimate_held_piece,
    estimate_level_payload,
    estimate_payload,
    estimate_tool,
    estimate_wrist,
    fingers_distinguishable,
    quantity,
)
from touchdown.backend.config import StackSettings
from touchdown.backend.core import (
    FINGERS,
    MARKERS,
    Finger,
    FloatArray,
    InputError,
    MarkerState,
    PhaseEntered,
    PieceWeighed,
    Pose,
    Progress,
    Recording,
    RefusedError,
    RunStarted,
    Said,
    pose_rotation,
)
from touchdown.backend.geometry import LEAST_WEIGHED_G, Outline, Piece
from touchdown.backend.runs import motions, probe
from touchdown.backend.runs.bench import Bench, RunContext
from touchdown.backend.runs.jig import pick_piece, return_piece, with_handed_piece
from touchdown.backend.runs.plan import PausePoint, Plan, Wait
from touchdown.backend.runs.requests import CalibrateRequest, request_record
from touchdown.backend.sensing import STANDARD_GRAVITY_M_S2, take_reference

INSET_MM = 2.0  # distance of a probed point from the ends of an edge
CORNERS = ((0.0, 0.0), (1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))
BOARD_REACH = 0.6  # offset of the corner touches, as a share of the half width of the bottom
EDGES = tuple((axis, side, way) for axis in range(2) for side in (-1.0, 1.0) for way in (-1.0, 1.0))
BOARD_STEPS = len(CORNERS) + len(EDGES)
BOARD_ROUNDS = 2


@dataclass(frozen=True, slots=True)
class EdgeOffsets:
    """Distances from the edge middle at which edges are probed (across x, across y), in mm.

    ``yaw_of`` names the body whose yaw follows from them.
    """

    mm: tuple[float, float]
    yaw_of: YawOf


def measure_board(bench: Bench, request: CalibrateRequest) -> Plan[CalibrationEstimate]:
    """Measure the position of the bottom in the arm's frame, with the held piece."""
    yield from pick_piece(bench)
    centre = np.array(request.origin_mm)
    contact_mm = yield from probe.find_height(bench, centre)
    start_mm = contact_mm + bench.settings.probe.start_height_mm
    along = along_edges(bench.piece.face, bench.outline)
    touches, edges = np.empty((0, 3)), list[TouchedEdge]()
    for before in range(BOARD_ROUNDS):
        touches = np.vstack([touches, (yield from _touches(bench, centre, start_mm, before))])
        edges += yield from _edges(bench, centre, start_mm, along, before)
        found = estimate_board(touches, edges, along.yaw_of)
        if found.residual <= found.limit:
            break
        if before + 1 < BOARD_ROUNDS:
            text = (
                f"The residual is {found.residual:.2f} mm, beyond its limit of "
                f"{found.limit:.1f} mm: the board is probed once more, and both rounds count."
            )
            yield Said(bench.now_s(), text)
    yield _progress(bench, before, BOARD_STEPS, "back to the jig")
    yield from return_piece(bench)
    return found


def _edges(
    bench: Bench, centre: FloatArray, start_mm: float, along: EdgeOffsets, before: int
) -> Plan[list[TouchedEdge]]:
    edges = []
    for at, (axis, side, way) in enumerate(EDGES):
        yield PausePoint()
        yield _progress(bench, before, len(CORNERS) + at, f"edge {at + 1} of {len(EDGES)}")
        off = along.mm[axis] * way
        edges.append((yield from probed_edge(bench, centre, (axis, side, off), start_mm)))
    return edges


def probed_edge(
    bench: Bench, centre: FloatArray, where: tuple[int, float, float], start_mm: float
) -> Plan[TouchedEdge]:
    """Probe one edge around ``centre`` (2,).

    ``where`` is the axis across the edge, the side (+1 or -1) and the distance along the edge, mm.
    """
    axis, side, off_mm = where
    from_mm = centre.copy()
    from_mm[1 - axis] += off_mm
    at = yield from probe.edge_mm(bench, from_mm, axis, side, start_mm, probe.FINE_MM)
    return TouchedEdge(axis, side, off_mm, float(centre[axis]) + at)


def along_edges(face: Outline, bottom: Outline) -> EdgeOffsets:
    """Return where to probe the edges so that the yaw of one body can be estimated.

    A straight edge of the bottom gives its own yaw along the stretch that a round face, or the
    corner of a shorter face, reaches. A face longer than the bottom gives the yaw of the piece.
    """
    bodies: tuple[tuple[Outline, Outline, YawOf], ...] = (
        (bottom, face, "board"),
        (face, bottom, "piece"),
    )
    for straight, other, yaw_of in bodies:
        longer, shorter = _half_lengths(straight), _half_lengths(other)
        if straight.kind == "circle" or longer is None or shorter is None:
            continue
        room = tuple(longer[1 - k] - shorter[1 - k] - INSET_MM for k in range(2))
        if min(room) >= INSET_MM:
            return EdgeOffsets((room[0], room[1]), yaw_of)
    return EdgeOffsets((0.0, 0.0), "")


def _half_lengths(outline: Outline) -> tuple[float, float] | None:
    """Return the half sides of a rectangle along the axes, zeros for a circle, else None."""
    if outline.kind == "circle":
        return 0.0, 0.0
    if len(outline.vertices_mm) != 4:
        return None
    x_mm, y_mm = outline.half_extents_mm
    if all(math.isclose(abs(x), x_mm) and math.isclose(abs(y), y_mm) for x, y in
           outline.vertices_mm):  # fmt: skip
        return x_mm, y_mm
    return None


def _touches(bench: Bench, centre: FloatArray, start_mm: float, before: int) -> Plan[FloatArray]:
    """Return (5, 3): centre of the overlap and height of contact in the arm's frame."""
    out_mm = BOARD_REACH * np.array(bench.outline.half_extents_mm)
    found = []
    for at, corner in enumerate(CORNERS):
        yield PausePoint()
        yield _progress(bench, before, at, f"touch {at + 1} of {len(CORNERS)}")
        off = out_mm * corner
        height_mm = yield from probe.touch_height_mm(bench, centre + off, start_mm, probe.BELOW_MM)
        if height_mm is None:
            raise RefusedError(
                "NO-TOUCH", "A touch on the bottom found no contact: check the origin."
            )
        middle = motions.middle_of_overlap(bench.piece.face, bench.outline, off)
        found.append([*(centre + middle), height_mm])
    return np.array(found)


def _progress(bench: Bench, before: int, done: int, text: str) -> Progress:
    steps = BOARD_STEPS * (before + 1)
    return Progress(bench.now_s(), BOARD_STEPS * before + done, steps, text)


TOOL_SIDES = ((0, -1.0), (0, 1.0), (1, -1.0), (1, 1.0))
TOOL_STEPS = TOOL_GRIPS * len(TOOL_SIDES)


def measure_tool(bench: Bench, request: CalibrateRequest) -> Plan[CalibrationEstimate]:
    """Measure the centre of the face relative to the tool axis."""
    bottom = np.array(request.origin_mm)
    centres = []
    for grip in range(TOOL_GRIPS):
        yield from pick_piece(bench)
        contact_mm = yield from probe.find_height(bench, bottom)
        start_mm = contact_mm + bench.settings.probe.start_height_mm
        centres.append((yield from _face_centre(bench, bottom, start_mm, grip)))
        yield from return_piece(bench)
    yield Progress(bench.now_s(), TOOL_STEPS, TOOL_STEPS, "done")
    sigma_mm = bench.settings.collect.origin_sigma_mm
    return estimate_tool(bottom, sigma_mm, np.stack(centres))


def _face_centre(bench: Bench, bottom: FloatArray, start_mm: float, grip: int) -> Plan[FloatArray]:
    """Return the hand position (2,) with the face centred over the bottom."""
    between = np.zeros(2)
    for at, (axis, side) in enumerate(TOOL_SIDES):
        yield PausePoint()
        done = grip * len(TOOL_SIDES) + at
        yield Progress(bench.now_s(), done, TOOL_STEPS, f"grip {grip + 1} of {TOOL_GRIPS}")
        edge = yield from probed_edge(bench, bottom, (axis, side, 0.0), start_mm)
        between[axis] += 0.5 * edge.at_mm
    return between


RAISE_MM = 60.0  # height above the start pose at which the hand tilts
LEAN = math.radians(14.0)
# Rotations about x and y, rad
LEANS = (
    (0.0, 0.0), (LEAN, 0.0), (-LEAN, 0.0), (0.0, LEAN), (0.0, -LEAN), (0.7 * LEAN, 0.7 * LEAN),
)  # fmt: skip
# Positions (x, y) of a level hand; the pull of the cables differs between them
LEVEL_MM = ((0.0, 0.0), (30.0, 0.0), (-30.0, 0.0), (0.0, 30.0), (0.0, -30.0), (0.0, 0.0))
SETTLE_S, WEIGH_S = 0.5, 1.0
MIN_SAMPLES = 10  # of one mean
MOMENT_NMM = 0.3  # standard uncertainty of a moment of the held piece [U]


def measure_payload(bench: Bench, request: CalibrateRequest) -> Plan[CalibrationEstimate]:
    """Measure the payload below the wrist sensor, with an empty gripper.

    An arm that cannot tilt its hand stays level: mass and horizontal centre of mass only.
    """
    found = yield from _weighed(bench)
    if bench.arm.rotates:
        return estimate_payload(found.turns, found.wrenches)
    return estimate_level_payload(found.wrenches)


def measure_wrist(bench: Bench, request: CalibrateRequest) -> Plan[CalibrationEstimate]:
    """Measure the yaw of the wrist sensor; raises ``RefusedError`` if the hand cannot tilt."""
    if not bench.arm.rotates:
        raise RefusedError("CANNOT-TURN", "This arm keeps its hand level: the yaw shows no weight.")
    found = yield from _weighed(bench)
    return estimate_wrist(found.turns, found.wrenches)


def _weighed(bench: Bench) -> Plan[PoseReadings]:
    if bench.gripper.status().holding:
        raise RefusedError("HOLDING", "A piece is held: put it away, the gripper is weighed empty.")
    return (yield from read_poses(bench))


def check_weighing(piece: Piece, settings: StackSettings) -> None:
    """Raise ``InputError`` for a piece too light to be weighed, or unknown and not weighed."""
    unknown = not piece.com_known and settings.strategy != "pick-and-place"
    if settings.weigh and piece.mass_g < LEAST_WEIGHED_G:
        spread_mm = MOMENT_NMM / (1e-3 * piece.mass_g * STANDARD_GRAVITY_M_S2)
        what = (
            f"'{piece.name}' is too light to be weighed: the wrist sensor knows moments to "
            f"{MOMENT_NMM:g} N·mm, which is {spread_mm:.1f} mm times the weight of "
            f"{piece.mass_g:g} g."
        )
        fix = f"Weigh pieces of {LEAST_WEIGHED_G:g} g or more"
        fix += "; enter com_xy_mm in the piece file." if unknown else "; run without weighing."
        raise InputError(what, piece.source, fix)
    if unknown and not settings.weigh:
        what = f"The centre of mass of '{piece.name}' is unknown."
        fix = "Weigh it before the first probe (--weigh), or enter com_xy_mm in the piece file."
        raise InputError(what, piece.source, fix)


def weigh_empty(bench: Bench) -> Plan[PoseReadings]:
    """Read the wrist sensor in six poses of the empty hand, and move back.

    Raises ``RefusedError`` if a piece is held or the hand cannot tilt.
    """
    if not bench.arm.rotates:
        what = "This arm keeps its hand level: the centre of mass cannot be weighed."
        raise RefusedError("CANNOT-TURN", what)
    yield from motions.wait(bench, motions.FIRST_POSES_S)
    here = bench.arm.pose(max_age_s=0.2)
    empty = yield from _weighed(bench)
    yield from motions.move_to(bench, here)
    return empty


def weigh_held(bench: Bench, empty: PoseReadings) -> Plan[Bench]:
    """Weigh the held piece in the same poses, and move back.

    Returns the bench with the measured centre of mass and its uncertainty. Raises ``RefusedError``
    as ``estimate_held_piece``, with the piece held and the hand back where it was.
    """
    piece, here = bench.piece, bench.arm.pose(max_age_s=0.2)
    held = yield from read_poses(bench)
    yield from motions.move_to(bench, here)
    assert piece.grip_height_mm is not None
    lever_mm = piece.grip_height_mm + (bench.sensor_height_mm or math.nan)
    found = estimate_held_piece(empty, held, lever_mm)
    yield Said(bench.now_s(), f"{found.words()}.")
    x, y, _ = found.com_mm.tolist()
    x_sigma, y_sigma, _ = found.sigma_mm.tolist()
    yield PieceWeighed(bench.now_s(), found.mass_g, found.mass_sigma_g, (x, y), (x_sigma, y_sigma))
    known = replace(piece, com_xy_mm=(x, y))
    return replace(bench, piece=known, com_sigma_mm=max(x_sigma, y_sigma))


def read_poses(bench: Bench) -> Plan[PoseReadings]:
    """Return mean untared readings of the hand, high above the bench, in six poses."""
    # The change of wrench by tilting must not count as contact.
    yield from motions.zero_wrench(bench)
    here = bench.arm.pose(max_age_s=0.2)
    times, turns, wrenches, sigmas = [], [], [], []
    high_mm = here.z_mm + RAISE_MM
    if bench.arm.rotates:
        places = [Pose(here.x_mm, here.y_mm, high_mm, rx, ry) for rx, ry in LEANS]
    else:
        places = [Pose(here.x_mm + x, here.y_mm + y, high_mm) for x, y in LEVEL_MM]
    for at, place in enumerate(places):
        yield PausePoint()
        yield Progress(bench.now_s(), at, PAYLOAD_POSES, f"pose {at + 1} of {PAYLOAD_POSES}")
        yield PhaseEntered(bench.now_s(), "shift", 0)
        yield from motions.move_to(bench, place, "the hand to lean")
        yield from motions.wait(bench, SETTLE_S + WEIGH_S)
        turns.append(pose_rotation(bench.arm.pose(max_age_s=0.2)))
        now_s = bench.now_s()
        rows = bench.sensing.raw.samples.window(now_s - WEIGH_S, now_s).values
        if len(rows) < MIN_SAMPLES:
            rows = np.full((2, 6), np.nan)
        times.append(now_s - 0.5 * WEIGH_S)
        wrenches.append(rows.mean(axis=0))
        sigmas.append(rows.std(axis=0, ddof=1) / math.sqrt(len(rows)))
    yield Progress(bench.now_s(), PAYLOAD_POSES, PAYLOAD_POSES, "back to level")
    yield from motions.move_to(bench, Pose(here.x_mm, here.y_mm, high_mm), "the hand to level")
    return PoseReadings(np.array(times), np.stack(turns), np.stack(wrenches), np.stack(sigmas))


# Offset of the tool axis beyond the rim of the bottom, as a share of the half width of the face.
# Closer to the middle the face lies flat and the piece does not tilt.
PUSH_REACH = 0.7
ACROSS: tuple[Side, Side] = ("+y", "-y")  # sides on which the fingers are loaded differently
PUSH_ROUNDS, MOST_PUSH_ROUNDS = 3, 10
MOST_PUSHES = len(SIDES) + len(ACROSS) * (MOST_PUSH_ROUNDS - 1)
REST_S, LOOKS = 0.8, 8
DEPTH_MM, RAMP_S, HOLD_S, MEAN_S = 1.2, 0.8, 1.4, 0.4


def measure_cameras(bench: Bench, request: CalibrateRequest) -> Plan[CalibrationEstimate]:
    """Measure the scale of both cameras and check their assignment and mirroring."""
    gels_px, why = yield from _gels_at_rest(bench)
    presses = yield from _side_presses(bench, request)
    found = estimate_cameras(presses, request.pitch_mm)
    known = "The gels are known again by their dots." if gels_px else f"No fingerprint: {why}"
    return replace(found, gels_px=gels_px, note=f"{found.note} {known}")


def _gels_at_rest(bench: Bench) -> Plan[tuple[tuple[float, ...], str]]:
    """Return the resting markers of both gels with an empty hand, or none and the reason.

    Retries while a marker is hidden: a fingerprint needs all of them.
    """
    why = ""
    for _ in range(LOOKS):
        yield from motions.wait(bench, REST_S)
        now_s, numbers = bench.now_s(), list[float]()
        try:
            for finger in FINGERS:
                fields = bench.sensing.fields[finger].between(now_s - REST_S, now_s)
                numbers += dots_to_numbers(take_reference(fields).position_px)
        except RefusedError as error:
            why = f"{finger}: {error.detail}"
        else:
            return tuple(numbers), ""
    return (), why


def _side_presses(bench: Bench, request: CalibrateRequest) -> Plan[list[SidePress]]:
    origin, start_mm = yield from _take_to_bottom(bench, request)
    out_mm = np.array(bench.outline.half_extents_mm) + PUSH_REACH * np.array(
        bench.piece.face.half_extents_mm
    )
    presses: list[SidePress] = []
    while (side := next_side(presses)) is not None:
        yield PausePoint()
        yield Progress(bench.now_s(), len(presses), MOST_PUSHES, f"press at the rim, {side}")
        way = np.zeros(2)
        way["xy".index(side[1])] = 1.0 if side[0] == "+" else -1.0
        x_mm, y_mm = (origin + out_mm * way).tolist()
        yield from motions.move_to(bench, Pose(x_mm, y_mm, start_mm), "the arm to shift")
        push = partial(_side_press, bench, side)
        presses.append(
            (yield from motions.retry_if_void(bench, push, probe.void_touch(bench, start_mm)))
        )
        yield from probe.rise_from_contact(bench, start_mm)
    yield Progress(bench.now_s(), MOST_PUSHES, MOST_PUSHES, "back to the jig")
    yield from return_piece(bench)
    return presses


def _take_to_bottom(bench: Bench, request: CalibrateRequest) -> Plan[tuple[FloatArray, float]]:
    """Take the piece to the bottom; return its centre (2,) and the start height of a press."""
    yield from pick_piece(bench)
    sigma_mm = bench.settings.collect.origin_sigma_mm
    centre = bench.placed.origin(request.origin_mm, sigma_mm, request.bottom)
    origin = np.array([centre.x_mm, centre.y_mm])
    contact_mm = yield from probe.find_height(bench, origin)
    return origin, contact_mm + bench.settings.probe.start_height_mm


def next_side(presses: Sequence[SidePress]) -> Side | None:
    """Return the next side to press on, None when there are enough presses.

    Each side is pressed once. Then both y sides alternate for ``PUSH_ROUNDS`` or more rounds, until
    the difference between the fingers exceeds the creep of the gels.
    """
    if len(presses) < len(SIDES):
        return SIDES[len(presses)]
    if presses[-1].side == ACROSS[0]:
        return ACROSS[1]
    rounds = sum(push.side == ACROSS[1] for push in presses)
    if rounds >= PUSH_ROUNDS and (fingers_distinguishable(presses) or rounds >= MOST_PUSH_ROUNDS):
        return None
    return ACROSS[0]


def _side_press(bench: Bench, side: Side) -> Plan[SidePress]:
    yield from motions.zero_sensors(bench, 0)
    yield PhaseEntered(bench.now_s(), "press", 0)
    press = bench.arm.press(motions.press_command(bench, DEPTH_MM, RAMP_S, HOLD_S))
    yield Wait(lambda: press.done, motions.MOVE_S, "the press to end")
    press.result()
    now_s = bench.now_s()
    at_rest, moved = [], []
    for finger in FINGERS:
        fields = bench.sensing.fields[finger].between(now_s - MEAN_S, now_s)
        if not fields:
            raise RefusedError("NO-SAMPLES", f"The {finger} camera sent no images.")
        at_rest.append(bench.sensing.references[finger].position_px)
        moved.append(np.mean([field.displacement_px for field in fields], axis=0))
    return SidePress(side, np.stack(at_rest), np.stack(moved))


DAY_RESTS, DAY_REST_S, DAY_PRESSES = 4, 5.0, 4
LEAST_PRESS_N = 2.0  # pictures of a smaller press force do not count
SEEN_SHARE = 0.5  # a marker that is seen in fewer pictures is missing


def measure_day(bench: Bench, request: CalibrateRequest) -> Plan[CalibrationEstimate]:
    """Measure the quantities of the daily check with the empty hand at rest, then with presses.

    Nothing is gripped while a value at rest is out of the limits for any bench.
    """
    begun_s, found = bench.now_s(), defaultdict[str, list[float]](list)
    places = dict[Finger, FloatArray]()
    for rest in range(DAY_RESTS):
        yield PausePoint()
        yield Progress(bench.now_s(), rest, DAY_RESTS + DAY_PRESSES, "at rest, the hand is empty")
        yield from motions.wait(bench, DAY_REST_S)
        for finger in FINGERS:
            now_s = bench.now_s()
            fields = bench.sensing.fields[finger].between(now_s - DAY_REST_S, now_s)
            states = [f.state == MarkerState.SEEN for f in fields] or [np.zeros(MARKERS, bool)]
            seen = np.mean(states, axis=0) >= SEEN_SHARE
            found[f"{finger}_markers"] = [min([*found[f"{finger}_markers"], float(seen.sum())])]
            if seen.any():
                places_px = np.stack([f.position_px[seen] for f in fields])
                places[finger] = places_px.mean(axis=(0, 1))
                found[f"{finger}_noise_px"].append(float(places_px.std(axis=0).mean()))
    samples = bench.sensing.raw.samples.window(begun_s, bench.now_s())
    if len(samples.t_s) < MIN_SAMPLES or not np.isfinite(samples.values).all():
        raise RefusedError("NO-SAMPLES", "The wrist sensor sent no valid samples at rest.")
    line = np.polynomial.polynomial.polyfit(samples.t_s - begun_s, samples.values[:, :3], 1)
    left_n = samples.values[:, :3] - line[0] - np.outer(samples.t_s - begun_s, line[1])
    found["wrist_noise_n"] = [float(left_n.std(axis=0).max())]
    found["wrist_drift_n_min"] = [60.0 * float(np.linalg.norm(line[1]))]
    if all(quantity(n).low <= np.mean(v) <= quantity(n).high for n, v in found.items()):
        yield from _day_presses(bench, request, found, places)
    quantities = [
        Quantity(name, float(np.mean(v)), float(np.std(v)) / math.sqrt(len(v)), quantity(name).unit)
        for name, v in found.items()
    ]
    variances = np.diag([q.sigma**2 for q in quantities])
    return CalibrationEstimate(tuple(quantities), variances, np.zeros(0), 0.0, 1.0, "of the limits")


def _day_presses(
    bench: Bench,
    request: CalibrateRequest,
    found: Mapping[str, list[float]],
    places: Mapping[Finger, FloatArray],
) -> Plan[None]:
    """Press on the bottom; add motion of the markers per force, and their offset by the grasp."""
    origin, start_mm = yield from _take_to_bottom(bench, request)
    x_mm, y_mm = origin.tolist()
    steps = DAY_RESTS + DAY_PRESSES
    for press in range(1, DAY_PRESSES + 1):
        yield PausePoint()
        yield Progress(bench.now_s(), DAY_RESTS + press - 1, steps, f"press {press}")
        yield from motions.move_to(bench, Pose(x_mm, y_mm, start_mm), "the arm to shift")
        recording = (yield from probe.press_once(bench, press)).episode.recording
        assert recording is not None
        for finger in FINGERS:
            held_px = bench.sensing.references[finger].position_px.mean(axis=0)
            offset_px = float(np.linalg.norm(held_px - places[finger]))
            found[f"{finger}_offset_px"].append(offset_px)
            found[f"{finger}_stiffness_px_n"].append(motion_per_force(recording, finger))
        yield from probe.rise_from_contact(bench, start_mm)
    yield Progress(bench.now_s(), steps, steps, "back to the jig")
    yield from return_piece(bench)


def motion_per_force(recording: Recording, finger: Finger) -> float:
    """Return the mean motion of the markers over the press force, px/N, by least squares."""
    fields = [field for field in recording.fields if field.finger == finger]
    moved_px = np.linalg.norm([f.displacement_px.mean(axis=0) for f in fields], axis=1)
    press_n = np.interp([f.t_s for f in fields], recording.wrench_t_s, recording.wrench[:, 2])
    press_n[press_n < LEAST_PRESS_N] = 0.0
    return float(moved_px @ press_n / max(press_n @ press_n, LEAST_PRESS_N))


Measure = Callable[[Bench, CalibrateRequest], Plan[CalibrationEstimate]]
MEASURES: dict[CalibrationName, Measure] = {
    "payload": measure_payload,
    "board": measure_board,
    "tool": measure_tool,
    "wrist": measure_wrist,
    "camera": measure_cameras,
    "day": measure_day,
}


def calibrate_run(session: RunContext, request: CalibrateRequest) -> Plan[None]:
    """Measure a calibration and report it; accepting it is a separate step of the operator."""
    choice = request.scene()
    settings = request_record(request, session.method, session.check_scene(choice))
    session.open_record()
    yield RunStarted(
        0.0, session.run_id, request.piece, request.bottom, request.what, request.seed, 1,
        session.simulated, settings, activity="calibrate",
    )  # fmt: skip
    bench = session.set_scene(choice, session.method)
    ended = yield from motions.run_to_end(bench, _measured(bench, request))
    if ended.value is not None:
        about = f"{request.piece}{ON_BOTTOM}{request.bottom}" if request.what == "board" else ""
        measured = ended.value.to_event(bench.now_s(), request.what, about)
        yield session.day_checks.judge(measured) if request.what == "day" else measured
    done = (
        "The daily check is stored" if request.what == "day" else f"The {request.what} is measured"
    )
    yield motions.run_finished(bench, session.run_id, ended, f"{done}.")


def _measured(bench: Bench, request: CalibrateRequest) -> Plan[CalibrationEstimate]:
    yield from motions.wait(bench, motions.FIRST_POSES_S)
    if request.takes_piece and (request.hand_over or bench.jig is None):
        bench = with_handed_piece(bench)
    return (yield from MEASURES[request.what](bench, request))
