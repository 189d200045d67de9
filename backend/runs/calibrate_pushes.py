"""Press at the rim of the bottom on four sides, so that the piece leans: which camera is which."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from backend.calibration.camera import SIDES, Push, Side, estimate_cameras, tells_fingers
from backend.calibration.estimate import Estimate
from backend.calibration.gels import as_numbers
from backend.core.facts import PhaseEntered, Progress, Said
from backend.core.faults import Fault, RefusedError
from backend.core.flow import FINGERS, FloatArray, Pose
from backend.devices.protocols import PressCommand
from backend.runs import words
from backend.runs.again import again_if_void
from backend.runs.bench import Bench
from backend.runs.jig import pick, put_back
from backend.runs.motions import MOVE_S, go, rest, zero_sensors
from backend.runs.plan import Checkpoint, Plan, Waiting
from backend.runs.requests import CalibrateRequest
from backend.runs.touching import find_height, rise_to
from backend.sensing.reference import take_reference

OUT = 0.7
"""The axis of the tool goes beyond the rim of the bottom by this share of the half width of the
face: nearer to the middle the face lies flat, and the piece does not lean."""
ACROSS: tuple[Side, Side] = ("+y", "-y")
"""The sides on which one finger feels more than the other."""
ROUNDS, MOST_ROUNDS = 3, 10
MOST = len(SIDES) + len(ACROSS) * (MOST_ROUNDS - 1)
REST_S, LOOKS = 0.8, 8
DEPTH_MM, RAMP_S, HOLD_S, MEAN_S = 1.2, 0.8, 1.4, 0.4


def measure_cameras(bench: Bench, request: CalibrateRequest) -> Plan[Estimate]:
    """Return the scale of both cameras; an obstacle if a finger or a mirror is set wrongly."""
    gels_px, why = yield from _gels_at_rest(bench)
    pushed = yield from _pushes(bench, request)
    found = estimate_cameras(pushed, request.pitch_mm)
    known = "The gels are known again by their dots." if gels_px else f"No fingerprint: {why}"
    return replace(found, gels_px=gels_px, note=f"{found.note} {known}")


def _gels_at_rest(bench: Bench) -> Plan[tuple[tuple[float, ...], str]]:
    """Return the resting dots of both gels while the hand is still empty, or none and why.

    A dot that is not seen for a moment is waited for: without it the gels are not known again.
    """
    numbers, why = tuple[float, ...](), ""
    for _ in range(LOOKS):
        yield from rest(bench, REST_S)
        numbers, why = _dots_at_rest(bench)
        if numbers:
            break
    return numbers, why


def _dots_at_rest(bench: Bench) -> tuple[tuple[float, ...], str]:
    now_s = bench.now_s()
    numbers: list[float] = []
    for finger in FINGERS:
        fields = bench.sensing.fields[finger].between(now_s - REST_S, now_s)
        try:
            numbers += as_numbers(take_reference(fields).position_px)
        except RefusedError as error:
            return (), f"{finger}: {error.detail}"
    return tuple(numbers), ""


def _pushes(bench: Bench, request: CalibrateRequest) -> Plan[list[Push]]:
    yield from pick(bench)
    sigma_mm = bench.settings.collect.origin_sigma_mm
    centre = bench.placed.origin(request.origin_mm, sigma_mm, request.bottom)
    origin = np.array([centre.x_mm, centre.y_mm])
    contact_mm = yield from find_height(bench, origin)
    start_mm = contact_mm + bench.settings.probe.start_height_mm
    out_mm = np.array(bench.outline.half_extents_mm) + OUT * np.array(
        bench.piece.face.half_extents_mm
    )
    pushed: list[Push] = []
    while (side := next_side(pushed)) is not None:
        yield Checkpoint()
        yield Progress(bench.now_s(), len(pushed), MOST, f"press at the rim, {side}")
        x_mm, y_mm = (origin + out_mm * _towards(side)).tolist()
        yield from go(bench, Pose(x_mm, y_mm, start_mm), "the arm to shift")
        push, after_void = partial(_push, bench, side), partial(_after_void, bench, start_mm)
        each = yield from again_if_void(bench, push, after_void)
        pushed.append(each)
        yield from rise_to(bench, start_mm)
    yield Progress(bench.now_s(), MOST, MOST, "back to the jig")
    yield from put_back(bench)
    return pushed


def next_side(pushed: Sequence[Push]) -> Side | None:
    """Return where to press next, None for enough: once to each side, then to both sides of y until
    the fingers are told apart by more than the gels creep, ``ROUNDS`` times or more.
    """
    if len(pushed) < len(SIDES):
        return SIDES[len(pushed)]
    if pushed[-1].side == ACROSS[0]:
        return ACROSS[1]
    rounds = sum(push.side == ACROSS[1] for push in pushed)
    if rounds >= ROUNDS and (tells_fingers(pushed) or rounds >= MOST_ROUNDS):
        return None
    return ACROSS[0]


def _after_void(bench: Bench, start_mm: float, fault: Fault) -> Plan[None]:
    yield Said(bench.now_s(), words.void_touch(fault))
    yield from rise_to(bench, start_mm)


def _push(bench: Bench, side: Side) -> Plan[Push]:
    """Press here and stay pressed."""
    yield from zero_sensors(bench, 0)
    yield PhaseEntered(bench.now_s(), "press", 0)
    probe = bench.settings.probe
    press = bench.arm.press(
        PressCommand(
            depth_mm=DEPTH_MM,
            ramp_s=RAMP_S,
            hold_s=HOLD_S,
            approach_mm_s=probe.approach_mm_s,
            threshold_n=probe.threshold_n,
            max_travel_mm=probe.start_height_mm + probe.max_travel_mm,
            stiffness_n_mm=probe.stiffness_n_mm,
        )
    )
    yield Waiting(lambda: press.done, MOVE_S, "the press to end")
    press.result()
    return _felt(bench, side)


def _felt(bench: Bench, side: Side) -> Push:
    """Return the means of the end of the press."""
    now_s = bench.now_s()
    at_rest, moved = [], []
    for finger in FINGERS:
        fields = bench.sensing.fields[finger].between(now_s - MEAN_S, now_s)
        if not fields:
            raise RefusedError("NO-SAMPLES", f"The {finger} camera was silent.")
        at_rest.append(bench.sensing.references[finger].position_px)
        moved.append(np.mean([field.displacement_px for field in fields], axis=0))
    return Push(side, np.stack(at_rest), np.stack(moved))


def _towards(side: Side) -> FloatArray:
    way = np.zeros(2)
    way["xy".index(side[1])] = 1.0 if side[0] == "+" else -1.0
    return way
