"""Hand-over of the piece: take it from the jig, weigh it, put it back; by hand without a jig."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from touchdown.backend import core
from touchdown.backend.devices import JigEvidence, recent_positions_mm, travelled_mm
from touchdown.backend.runs.bench import Bench
from touchdown.backend.runs.motions import MOVE_S, ask_operator, move_to, take_piece, wait
from touchdown.backend.runs.plan import CancelledError, Plan, motion_done
from touchdown.backend.sensing import STANDARD_GRAVITY_M_S2

WEIGH_S = 0.5  # averaging time of the weight; the mean of 500 samples errs by 5 mN
SETTLE_S = 0.3


def with_handed_piece(bench: Bench) -> Bench:
    """Return the bench with the hand-over at the present arm pose.

    A hand holds a piece less precisely than a jig: the label uncertainty is larger.
    """
    collect = bench.settings.collect
    collect = collect.model_copy(update={"grip_sigma_mm": collect.handed_sigma_mm})
    settings = bench.settings.model_copy(update={"collect": collect})
    return replace(bench, jig=bench.arm.pose(max_age_s=0.2), handed=True, settings=settings)


def pick_piece(bench: Bench) -> Plan[float]:
    """Take the piece from the jig or the operator and raise it; return its mass in g.

    Raises ``RefusedError`` if the gripper holds something, ``FaultError`` "WRONG-WEIGHT" if the
    weight does not match (nominal masses are only reported), ``CancelledError`` if the operator
    declines.
    """
    jig = _jig(bench)
    if bench.gripper.status().holding:
        raise core.RefusedError(
            "HOLDING", "A piece is held already: put it back into its jig first."
        )
    yield core.PhaseEntered(bench.now_s(), "shift", 0)
    yield from wait(bench, SETTLE_S)
    yield from move_to(bench, jig)
    yield from wait(bench, SETTLE_S + WEIGH_S)
    empty_n = _vertical_n(bench)
    bench.sensing.forget_references()
    if bench.handed:
        yield from _hand_at_the_jaws(bench, gives=True)
    yield from take_piece(bench)
    yield from move_to(bench, _above(bench, jig))
    yield from wait(bench, SETTLE_S + WEIGH_S)
    weight_n = empty_n - _vertical_n(bench)
    yield from _weighed(bench, weight_n)
    return 1e3 * weight_n / STANDARD_GRAVITY_M_S2


def return_piece(bench: Bench) -> Plan[None]:
    """Carry the piece back and release it in the jig or in the operator's hand.

    Raises ``RefusedError`` if it does not sit freely in the jig.
    """
    jig = _jig(bench)
    yield core.PhaseEntered(bench.now_s(), "shift", 0)
    here = bench.arm.pose(max_age_s=0.2)
    high = _above(bench, jig)
    yield from move_to(bench, core.Pose(here.x_mm, here.y_mm, high.z_mm))
    yield from move_to(bench, high)
    yield from move_to(bench, jig)
    yield from wait(bench, SETTLE_S)
    yield core.PhaseEntered(bench.now_s(), "release", 0)
    width_mm = bench.gripper.status().width_mm + bench.settings.collect.open_mm
    speed_mm_s = bench.settings.release.open_mm_s
    if bench.handed:
        yield from _hand_at_the_jaws(bench, gives=False)
        opening = bench.gripper.open_by_hand(width_mm, speed_mm_s, confirmed=True)
    else:
        opening = bench.gripper.put_back(_evidence(bench, jig), width_mm, speed_mm_s)
    yield from motion_done(opening, MOVE_S, "the gripper to open")
    yield from wait(bench, SETTLE_S)


def approach_with_piece(bench: Bench, place: core.Pose) -> Plan[None]:
    """Carry the held piece over ``place``: up, across, and down."""
    high_mm = _above(bench, _jig(bench)).z_mm
    here = bench.arm.pose(max_age_s=0.2)
    yield from move_to(bench, core.Pose(here.x_mm, here.y_mm, max(here.z_mm, high_mm)))
    yield from move_to(bench, core.Pose(place.x_mm, place.y_mm, high_mm))
    yield from move_to(bench, place)


def wait_for_refit(bench: Bench) -> Plan[bool]:
    """Wait until the operator has refitted bottom and gels; raises ``CancelledError`` on a no."""
    question = core.HandOverAwaited(bench.now_s(), bench.bottom, gives=False, anew=True)
    if not (yield from ask_operator(bench, question, "a new mounting")):
        raise CancelledError("bottom and gels were not refitted")
    return True


def _hand_at_the_jaws(bench: Bench, *, gives: bool) -> Plan[None]:
    """Wait for the operator's hand at the jaws; raises ``CancelledError`` on a no."""
    question = core.HandOverAwaited(bench.now_s(), bench.piece.name, gives)
    if not (yield from ask_operator(bench, question, "the operator's hand")):
        raise CancelledError("the piece was not handed over")


def _weighed(bench: Bench, weight_n: float) -> Plan[None]:
    piece = bench.piece
    expected_n = 1e-3 * piece.mass_g * STANDARD_GRAVITY_M_S2
    if abs(weight_n - expected_n) <= bench.settings.collect.weight_tolerance_n:
        return
    grams = 1e3 * weight_n / STANDARD_GRAVITY_M_S2
    what = f"The held piece weighs {grams:.0f} g; {piece.name} has {piece.mass_g:.0f} g"
    if piece.nominal and weight_n > 0:
        yield core.Said(bench.now_s(), f"{what} by its file, which is nominal.")
        return
    raise core.FaultError(
        core.Fault(
            "WRONG-WEIGHT",
            f"{what}.",
            "Nothing was probed; the piece stays in the gripper.",
            "Check which piece is in the jig and that it hangs freely, then press Reset.",
            "force_torque",
        )
    )


def _vertical_n(bench: Bench) -> float:
    now_s = bench.now_s()
    window = bench.sensing.raw.samples.window(now_s - WEIGH_S, now_s)
    vertical_n = window.values[:, 2]
    if not len(vertical_n) or not np.isfinite(vertical_n).all():
        raise core.FaultError(
            core.Fault(
                "FT-STALE",
                "The force/torque sensor sent no valid sample while the weight was measured.",
                "Nothing was probed; the gripper was not opened.",
                "Check the sensor and its cable, then press Reset.",
                "force_torque",
            )
        )
    return float(np.mean(vertical_n))


def _evidence(bench: Bench, jig: core.Pose) -> JigEvidence:
    now_s = bench.now_s()
    places_mm = recent_positions_mm(bench.arm.poses, now_s)
    wrench = bench.sensing.wrench.window(now_s - 0.1, now_s).values
    target = np.array([jig.x_mm, jig.y_mm, jig.z_mm])
    return JigEvidence(
        from_jig_mm=float(np.abs(places_mm[-1] - target).max()) if len(places_mm) else math.nan,
        moved_mm=travelled_mm(places_mm),
        force_n=float(np.abs(wrench[:, :3].mean(axis=0)).max()) if len(wrench) else math.nan,
        holding=bench.gripper.status().holding,
    )


def _jig(bench: Bench) -> core.Pose:
    if bench.jig is None:
        raise core.RefusedError("NO-JIG", "This bench has no taught place of a jig.")
    return bench.jig


def _above(bench: Bench, jig: core.Pose) -> core.Pose:
    return core.Pose(jig.x_mm, jig.y_mm, jig.z_mm + bench.settings.collect.clearance_mm)
