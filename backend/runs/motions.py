"""Motions that plans consist of, and the end of a plan after cancel, stop, refusal or fault.

Motions are plans: they yield events and waits and never sleep. Cancel and refusal lift the arm;
stop and fault leave it where it is. A press that is void after a short dropout of arm or wrist is
repeated.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, Literal, TypeVar

import numpy as np

from touchdown.backend import core
from touchdown.backend.devices import VOID_PRESS, PressCommand
from touchdown.backend.geometry import Outline, overlap_polygon, rings_of
from touchdown.backend.runs.bench import Bench
from touchdown.backend.runs.plan import (
    CancelledError,
    PausePoint,
    Plan,
    StoppedError,
    Wait,
    motion_done,
    stale_fault,
    stopped_message,
)
from touchdown.backend.runs.recorder import DISK_FULL, refused_episode_fault


def descent_start(bench: Bench, at_mm: tuple[float, float]) -> core.Pose:
    """Return the start of a descent at (x, y): the start height above the expected contact.

    The contact height comes from the calibration of the board for this pair of piece and bottom,
    otherwise from the file of the piece.
    """
    contact_mm = bench.piece.grip_height_mm or 0.0
    board = bench.placed.board
    if board is not None and board.is_of(bench.piece.name, bench.bottom):
        off_mm = np.array([at_mm[0] - board.place.x_mm, at_mm[1] - board.place.y_mm])
        contact_mm = board.contact_at(middle_of_overlap(bench.piece.face, bench.outline, off_mm))
    return core.Pose(*at_mm, contact_mm + bench.settings.probe.start_height_mm)


def middle_of_overlap(
    face: Outline, bottom: Outline, offset_mm: core.FloatArray
) -> core.FloatArray:
    """Return the centroid (2,) of the overlap of ``face`` at ``offset_mm`` (2,) with ``bottom``.

    Without overlap it is the centre of the bottom.
    """
    x_mm, y_mm = offset_mm.tolist()
    moment, area = np.zeros(2), 0.0
    for ring in rings_of(overlap_polygon(face, (x_mm, y_mm), bottom)):
        after = np.roll(ring, -1, axis=0)
        cross = ring[:, 0] * after[:, 1] - after[:, 0] * ring[:, 1]
        moment += ((ring + after) * cross[:, None]).sum(axis=0)
        area += float(cross.sum())
    return moment / (3.0 * area) if area > 0.0 else moment


FIRST_POSES_S = 0.1  # a new scene has no arm pose before
OPERATOR_TIMEOUT_S = 24 * 3600.0
SETTLE_S = 0.3  # decay of vibration before reference and tare
REFERENCE_S = 5.0  # time limit of a reference; smears on single markers last up to 0.4 s
GRIP_S = 5.0
MOVE_S = 30.0  # time limit of a move at full speed; scaled by the override
LEASE_TRIES, AGAIN_S = 3, 0.1
NO_PART = "WSG-NO-PART"  # fault code of jaws that closed on nothing
UNLEASED = ("NO-LEASE", "LEASE-LAPSED")  # codes of a lapsed motion lease
# Largest age of the wrench at release beyond the sensor's own delay: 1.5 control cycles of 10 ms
WRENCH_AGE_LIMIT_S = 0.015
FRESH_S = 0.5  # time limit for a fresh wrench sample
WRITE_S = 60.0  # time limit of an episode write
NO_PIECE = (
    "The gripper closed on nothing: no piece is between the jaws. Open them and hold one between "
    "them, or set a new simulated scene (Ctrl+N in Operate)."
)


def wait(bench: Bench, seconds: float) -> Plan[None]:
    """Let ``seconds`` of bench time pass."""
    until_s = bench.now_s() + seconds
    yield Wait(lambda: bench.now_s() >= until_s, seconds + 1.0, "a pause to end")


def move_to(bench: Bench, place: core.Pose, what: str = "the arm to arrive") -> Plan[None]:
    """Move straight to ``place`` in air, as fast as the override allows.

    In real time the wrench may be too old for a lateral motion; then the next sample is waited for.
    If the motion lease lapses, the arm holds and the motion is commanded again.
    """
    for left in reversed(range(LEASE_TRIES)):
        if bench.real_time:
            yield from wait_fresh_wrench(bench)
        try:
            motion = bench.arm.move_to(place, bench.settings.probe.travel_mm_s)
            yield from motion_done(motion, MOVE_S / bench.interlock.override, what)
        except (core.FaultError, core.RefusedError) as cause:
            code = cause.reason if isinstance(cause, core.RefusedError) else cause.fault.code
            if code not in UNLEASED or not left or bench.interlock.latched:
                raise
            yield from wait(bench, AGAIN_S)
        else:
            return


def press_command(
    bench: Bench, depth_mm: float, ramp_s: float, hold_s: float, below_mm: float | None = None,
    drag_mm: float = 0.0,
) -> PressCommand:  # fmt: skip
    """Return a press with the method's gains, to ``below_mm`` below the usual contact at most."""
    probe = bench.settings.probe
    return PressCommand(
        depth_mm=depth_mm,
        ramp_s=ramp_s,
        hold_s=hold_s,
        approach_mm_s=probe.approach_mm_s,
        threshold_n=probe.threshold_n,
        max_travel_mm=probe.start_height_mm + (below_mm or probe.max_travel_mm),
        stiffness_n_mm=probe.stiffness_n_mm,
        drag_mm=drag_mm,
    )


def probe_command(bench: Bench, drag_mm: float = 0.0) -> PressCommand:
    """Return the press of a probe, dragged along y by ``drag_mm``."""
    probe = bench.settings.probe
    ramp_s = probe.ramp_fraction * probe.duration_s
    return press_command(bench, probe.depth_mm, ramp_s, probe.duration_s, drag_mm=drag_mm)


def ask_operator(
    bench: Bench, question: core.Event, what: str, patience_s: float = math.inf
) -> Plan[bool | None]:
    """Publish ``question`` and return the operator's yes or no; ``what`` names the wait.

    None if no answer came within ``patience_s``; a later one has no effect.
    """
    prompt, until_s = bench.prompt, bench.now_s() + patience_s
    prompt.ask()
    yield question

    def is_over() -> bool:
        return prompt.reply is not None or bench.now_s() >= until_s

    yield Wait(is_over, OPERATOR_TIMEOUT_S, what)
    return prompt.withdraw()


def take_piece(bench: Bench) -> Plan[None]:
    """Close the gripper on the piece and let it settle; does nothing if a piece is held."""
    if bench.gripper.status().holding:
        return
    yield core.PhaseEntered(bench.now_s(), "grip", 0)
    grip = bench.gripper.grip(bench.settings.probe.grip_force_n)
    yield from motion_done(grip, GRIP_S, "the gripper to hold the piece")
    yield from wait(bench, SETTLE_S)
    if not bench.gripper.status().holding:
        raise core.RefusedError("NO-PIECE", NO_PIECE)


def hold_again(bench: Bench) -> Plan[bool]:
    """Close loosened jaws; return True if they hold the piece, False if it is gone.

    A cancel takes effect once they are closed, so that it lifts the piece.
    """
    grip, what = bench.gripper.grip(bench.settings.probe.grip_force_n), "the gripper to hold"
    try:
        yield from motion_done(grip, GRIP_S, what)
    except CancelledError:
        yield Wait(lambda: grip.done, GRIP_S, what)
        raise
    except core.FaultError as error:
        if bench.interlock.latched or error.fault.code != NO_PART:
            raise
    yield from wait(bench, SETTLE_S)
    return bench.gripper.status().holding


def zero_sensors(bench: Bench, probe: int) -> Plan[None]:
    """Take the tare and both tactile references, at rest in air.

    Retries for ``REFERENCE_S`` after a hidden marker, a gap in the samples or a knock.
    """
    yield core.PhaseEntered(bench.now_s(), "reference", probe)
    count = bench.settings.probe.reference_frames
    yield from wait(bench, SETTLE_S + count / 25.0)

    def take() -> None:
        bench.sensing.zero_wrench(bench.now_s())
        bench.sensing.take_references(count)

    try:
        yield from _until_still(bench, take)
    except core.RefusedError as cause:
        raise core.FaultError(
            core.Fault(
                "NO-REFERENCE",
                f"No tactile reference within {REFERENCE_S:.0f} s: {cause.detail}",
                "No probe was started; the gripper was not opened.",
                "Look at the tactile images, then press Reset.",
                "tactile",
            )
        ) from cause


def zero_wrench(bench: Bench) -> Plan[None]:
    """Take the tare alone, at rest in air; retries as ``zero_sensors``."""
    yield from wait(bench, SETTLE_S)
    yield from _until_still(bench, lambda: bench.sensing.zero_wrench(bench.now_s()))


def _until_still(bench: Bench, take: Callable[[], object]) -> Plan[None]:
    """Call ``take`` until it succeeds; raises its error after ``REFERENCE_S``."""
    give_up_s = bench.now_s() + REFERENCE_S
    while True:
        try:
            take()
        except (core.FaultError, core.RefusedError):
            if bench.now_s() >= give_up_s:
                raise
        else:
            return
        yield from wait(bench, 0.1)


def lift(bench: Bench, probe: int) -> Plan[None]:
    """Rise straight by the start height."""
    yield core.PhaseEntered(bench.now_s(), "lift", probe)
    here = bench.arm.pose(max_age_s=0.2)
    up = core.Pose(here.x_mm, here.y_mm, here.z_mm + bench.settings.probe.start_height_mm)
    yield from move_to(bench, up, "the arm to lift")


def shift_piece(bench: Bench, step_mm: tuple[float, float], probe: int) -> Plan[None]:
    """Move sideways by ``step_mm`` with the arm lifted."""
    yield core.PhaseEntered(bench.now_s(), "shift", probe)
    here = bench.arm.pose(max_age_s=0.2)
    there = core.Pose(here.x_mm + step_mm[0], here.y_mm + step_mm[1], here.z_mm)
    yield from move_to(bench, there, "the arm to shift")


def wait_fresh_wrench(bench: Bench) -> Plan[None]:
    """Wait for the next wrench sample if the newest is too old, ``FRESH_S`` at most."""
    until_s = bench.now_s() + FRESH_S
    limit_s = bench.wrench_late_s + WRENCH_AGE_LIMIT_S

    def is_fresh() -> bool:
        now_s = bench.now_s()
        return len(bench.sensing.wrench.window(now_s - limit_s, now_s).t_s) > 0

    if not is_fresh():
        yield Wait(lambda: is_fresh() or bench.now_s() >= until_s, 2.0 * FRESH_S, "a fresh wrench")


def wait_while_writing(bench: Bench, written: Callable[[], bool]) -> Plan[None]:
    """In real time, wait until ``written()`` while the sensors are read.

    Otherwise a slow disk would leave a wrench too old for a lateral motion. A stepped bench does
    not wait: no number may depend on the disk.
    """
    if bench.real_time and not written():
        yield Wait(written, WRITE_S, "the episode to be on the disk")


def wait_until_durable(bench: Bench) -> Plan[Path | None]:
    """Return the file of the last episode; a full disk pauses the run until it is written.

    Raises ``FaultError`` for other errors of the disk, and if the run ends while it waits; the
    episode is then lost.
    """
    store = bench.store
    while True:
        yield from wait_while_writing(bench, lambda: store.written)
        try:
            return store.settle()
        except core.FaultError as error:
            if error.fault.code != DISK_FULL:
                raise
            refused = error
        try:
            yield PausePoint(refused_episode_fault(refused.fault))
        except (CancelledError, StoppedError):
            raise refused from None


VOID_TRIES = 3  # presses in all while each is void
TOUCH_TRIES = 6  # touches in all while each is void; a calibration has dozens of short ones
# Codes of short dropouts of arm, wrist or this program, shorter than a latched fault
VOID = (VOID_PRESS, "FT-STALE", "LEASE-LAPSED")
T = TypeVar("T")


def retry_if_void(
    bench: Bench,
    attempt: Callable[[], Plan[T]],
    after_void: Callable[[core.Fault], Plan[None]],
    tries: int = VOID_TRIES,
) -> Plan[T]:
    """Return the result of ``attempt``, repeated up to ``tries`` times while its press is void.

    ``after_void`` reports the fault and draws the arm back, once wrench samples arrive again. The
    last void press is raised, as is any other fault, and any that latched the interlock.
    """
    for left in reversed(range(tries)):
        try:
            return (yield from attempt())
        except core.FaultError as error:
            if error.fault.code not in VOID or not left:
                raise
            yield from wait_fresh_wrench(bench)
            if bench.interlock.latched:
                raise
            yield from after_void(error.fault)
    raise AssertionError("unreachable: the loop returns or raises")


RunEnding = Literal["finished", "cancelled", "stopped", "failed"]
R = TypeVar("R")


@dataclass(frozen=True, slots=True)
class PlanEnd(Generic[R]):
    """End of a plan: its ``value``, or None with the ``reason``.

    ``run_ending`` is the ending of the whole run, None where the run may continue.
    """

    value: R | None
    run_ending: RunEnding | None = None
    reason: str = ""


def run_to_end(bench: Bench, plan: Plan[R]) -> Plan[PlanEnd[R]]:
    """Run ``plan`` to its end.

    Cancel and refusal lift the arm; stop and fault leave it where it is.
    """
    try:
        value = yield from plan
    except CancelledError as cause:
        yield from _retreat(bench)
        return PlanEnd(None, "cancelled", str(cause))
    except StoppedError as cause:
        return PlanEnd(None, "stopped", str(cause))
    except core.RefusedError as cause:
        faults = bench.interlock.faults
        if faults:
            # The command met the latch of a fault that this run has not published yet.
            yield core.FaultRaised(bench.now_s(), faults[0])
            return PlanEnd(None, "failed", str(core.FaultError(faults[0])))
        if bench.interlock.latched:
            return PlanEnd(None, "stopped", stopped_message(bench.interlock.stopped_by))
        yield core.Said(bench.now_s(), f"Refused: {cause}")
        yield from _retreat(bench)
        return PlanEnd(None, None, str(cause))
    except (core.FaultError, core.StaleSampleError) as cause:
        if bench.interlock.stopped_by and not bench.interlock.faults:
            # STOP interrupted the motion: that is no device fault.
            return PlanEnd(None, "stopped", stopped_message(bench.interlock.stopped_by))
        # A fault that stopped the arm shows as an interrupted motion: report its cause.
        faults = bench.interlock.faults
        found = stale_fault(cause) if isinstance(cause, core.StaleSampleError) else cause.fault
        bench.interlock.raise_fault(faults[0] if faults else found)
        first = core.FaultError((bench.interlock.faults or (found,))[0])
        yield core.FaultRaised(bench.now_s(), first.fault)
        return PlanEnd(None, "failed", str(first))
    return PlanEnd(value)


def run_finished(bench: Bench, run_id: str, ended: PlanEnd[R], done: str) -> core.RunFinished:
    """Return the last event of a run that consists of one plan; ``done`` says what it did."""
    ending = ended.run_ending or ("finished" if ended.value else "failed")
    return core.RunFinished(bench.now_s(), run_id, ending, ended.reason or done)


def _retreat(bench: Bench) -> Plan[None]:
    """Lift straight off if the bench may still move; the piece stays in the gripper.

    Jaws that an opening in stages has loosened close first.
    """
    if bench.interlock.staged is not None and not bench.interlock.latched:
        yield from hold_again(bench)
    if bench.gripper.status().holding and not bench.interlock.latched:
        yield from lift(bench, bench.status().probe)
