"""Release of the piece: unload, check the conditions, open the jaws at once or in stages.

In stages the jaws open by small held steps, and markers and wrench are watched meanwhile. If the
piece begins to turn, the jaws close again and the run goes on.
"""

from __future__ import annotations

import math

import numpy as np

from touchdown.backend import core, devices
from touchdown.backend.runs import motions
from touchdown.backend.runs.bench import Bench, JudgedProbe
from touchdown.backend.runs.plan import Plan, Wait, motion_done
from touchdown.backend.sensing import STANDARD_GRAVITY_M_S2, TurnDetector, slip_since_loading

REST_S = 1.0  # time limit for the arm to come to rest
# Before stages: press force that an unloading aims at (the interlock requires 0.3 to 2 N, and creep
# takes some), and time at rest, in which the noise of the signals is measured
UNLOAD_N, REST_STAGED_S = (0.8, 1.9), 1.2
FRAME_S = 0.04
OFFSET_N, OFFSET_NM = 0.2, 0.008  # slow offset of the wrist since the tare, standard deviations
UNWATCHED = "The piece cannot be watched: too few frames or wrench samples."


def release_piece(bench: Bench, judged: JudgedProbe, *, approved: bool) -> Plan[bool]:
    """Unload, settle, check slip again, open, rise. Return False if the piece is held again.

    Raises ``RefusedError`` if a release condition of the interlock does not hold.
    """
    settings = bench.settings.release
    probe = judged.pressed.probe
    yield core.PhaseEntered(bench.now_s(), "unload", probe)
    width_mm = bench.gripper.status().width_mm
    unload_n = settings.unload_n
    if settings.stages:
        # The support then carries the weight, and the hand nothing.
        unload_n = float(np.clip(_weight_n(bench), *UNLOAD_N))
    unload = bench.arm.unload(unload_n, bench.settings.probe.approach_mm_s)
    yield from motion_done(unload, motions.MOVE_S, "the arm to unload")
    rested_s = bench.now_s()
    yield from motions.wait(bench, REST_STAGED_S if settings.stages else settings.settle_s)
    yield from wait_at_rest(bench)
    watch = TurnDetector(bench.sensing.fields, bench.sensing.wrench)
    if settings.stages and not watch.learn(rested_s + settings.settle_s, bench.now_s()):
        raise core.RefusedError("NOT-WATCHED", UNWATCHED)
    yield core.PhaseEntered(bench.now_s(), "release", probe)
    yield from motions.wait_fresh_wrench(bench)
    evidence = release_evidence(bench, judged, width_mm, approved=approved)
    if settings.stages:
        return (yield from _open_in_stages(bench, probe, evidence, watch))
    yield from open_and_rise(bench, probe, evidence, width_mm)
    return True


def _open_in_stages(
    bench: Bench, probe: int, evidence: devices.ReleaseEvidence, watch: TurnDetector
) -> Plan[bool]:
    """Open in held steps, then at once, and rise; close and return False if the piece turns."""
    settings, width_mm = bench.settings.release, bench.gripper.status().width_mm
    force_n = bench.settings.probe.grip_force_n
    text = f"Opening in {settings.stages} steps of {settings.stage_mm:g} mm, each held for 1 s."
    yield core.Said(bench.now_s(), text)
    for step in range(1, settings.stages + 1):
        yield core.Progress(bench.now_s(), step, settings.stages, "opening the jaws")
        yield from motions.wait_fresh_wrench(bench)
        moved_mm = devices.travelled_mm(devices.recent_positions_mm(bench.arm.poses, bench.now_s()))
        opening = bench.gripper.open_step(
            evidence if step == 1 else None,
            width_mm + step * settings.stage_mm,
            settings.open_mm_s,
            force_n=force_n,
            moved_mm=moved_mm,
        )
        yield from motion_done(opening, motions.GRIP_S, "the gripper to open by a step")
        turned, watched = yield from _hold_step(bench, watch)
        if turned or (step == settings.stages and _leans(bench, watch)):
            return (yield from _hold_again(bench, probe, step))
        if not watched:
            raise core.RefusedError("NOT-WATCHED", UNWATCHED)
    wide_mm = bench.gripper.status().width_mm + 2.0 * settings.clearance_mm
    yield from _open_wide(bench, probe, bench.gripper.open_to(wide_mm, settings.open_mm_s))
    return True


def _hold_step(bench: Bench, watch: TurnDetector) -> Plan[tuple[bool, bool]]:
    """Hold until the piece turns or the step is over; return if it turned and was watched."""
    since_s, until_s = bench.now_s() + FRAME_S, bench.now_s() + devices.STAGE_S

    def turned() -> bool:
        return watch.hold(since_s, bench.now_s()) > bench.settings.release.turn_sigmas

    yield Wait(lambda: bench.now_s() >= until_s or turned(), 2.0 * devices.STAGE_S, "the next step")
    watched = watch.keep(since_s, bench.now_s())
    return turned(), watched


def _leans(bench: Bench, watch: TurnDetector) -> bool:
    """Return True if the piece leans on a finger, judged after the last step."""
    release, weight_n, (x, y) = bench.settings.release, _weight_n(bench), bench.piece.com_xy_mm
    # Load of the hand once it is free of the piece, which the tare includes.
    free = np.array([0.0, 0.0, weight_n, 1e-3 * y * weight_n, -1e-3 * x * weight_n, 0.0])
    lean = lean_sigmas(watch.load() - free)
    return watch.growth() > release.turn_sigmas or lean > release.lean_sigmas


def lean_sigmas(load: core.FloatArray) -> float:
    """Return a load (6,) of the free hand in standard deviations of the wrist's slow offset.

    Without Fz, which the friction of a piece that leans hardly changes. NaN is no lean.
    """
    return float(np.linalg.norm(np.delete(load / np.repeat([OFFSET_N, OFFSET_NM], 3), 2)))


def _weight_n(bench: Bench) -> float:
    return 1e-3 * bench.piece.mass_g * STANDARD_GRAVITY_M_S2


def _hold_again(bench: Bench, probe: int, step: int) -> Plan[bool]:
    """Close the jaws; return False if they hold the piece. A lost one counts as released."""
    opened_mm = step * bench.settings.release.stage_mm
    text = f"Probe {probe}: the piece begins to turn with the jaws opened by {opened_mm:.1f} mm: "
    yield core.Said(bench.now_s(), f"{text}closing them.")
    if (yield from motions.hold_again(bench)):
        bench.sensing.forget_references()
        return False
    text = "The jaws closed on nothing: the piece is no longer between them."
    yield core.Said(bench.now_s(), text)
    settings, width_mm = bench.settings.release, bench.piece.width_mm
    wide = bench.gripper.open_to(width_mm + 2.0 * settings.clearance_mm, settings.open_mm_s)
    yield from _open_wide(bench, probe, wide)
    return True


def open_and_rise(
    bench: Bench, probe: int, evidence: devices.ReleaseEvidence, width_mm: float
) -> Plan[None]:
    """Open slowly until both fingers are clear, then rise."""
    settings = bench.settings.release
    open_mm = width_mm + 2.0 * settings.clearance_mm
    opening = bench.gripper.release(evidence, open_mm, settings.open_mm_s)
    yield from _open_wide(bench, probe, opening)


def _open_wide(bench: Bench, probe: int, opening: devices.Motion) -> Plan[None]:
    settings = bench.settings.release
    yield from motion_done(opening, motions.MOVE_S, "the gripper to open")
    yield from motions.wait(bench, 0.5)
    yield core.PhaseEntered(bench.now_s(), "rise", probe)
    here = bench.arm.pose(max_age_s=0.2)
    up = core.Pose(here.x_mm, here.y_mm, here.z_mm + settings.rise_mm)
    yield from motions.move_to(bench, up, "the arm to rise")


def wait_at_rest(bench: Bench) -> Plan[None]:
    """Wait until the arm is at rest by its poses, ``REST_S`` at most."""
    until_s = bench.now_s() + REST_S

    def stands() -> bool:
        places_mm = devices.recent_positions_mm(bench.arm.poses, bench.now_s())
        return devices.travelled_mm(places_mm) <= devices.STATIONARY_MM or bench.now_s() >= until_s

    yield Wait(stands, 2.0 * REST_S, "the arm to stand still")


def release_evidence(
    bench: Bench, judged: JudgedProbe, width_mm: float, *, approved: bool
) -> devices.ReleaseEvidence:
    """Read the sensors again and return the release conditions."""
    now_s = bench.now_s()
    status = bench.gripper.status()
    window = bench.sensing.wrench.window(now_s - 0.1, now_s)
    sampled = len(window.t_s) > 0
    press_n = float(np.mean(window.values[:, 2])) if sampled else math.nan
    places_mm = devices.recent_positions_mm(bench.arm.poses, now_s)
    recording, onset_s = judged.pressed.episode.recording, judged.pressed.episode.onset_s
    slip_mm = math.nan
    if recording is not None and len(places_mm):
        slip_mm = slip_since_loading(recording, onset_s, float(places_mm[-1, 2]), press_n)
    return devices.ReleaseEvidence(
        verdict_stable=judged.stability.stable,
        verdict_of_last_probe=bench.sensing.tare_s < judged.at_s,
        verdict_age_s=now_s - judged.at_s,
        margin_mm=judged.stability.margin_mm,
        required_margin_mm=bench.settings.required_margin_mm,
        quality_accepted=judged.pressed.episode.quality.accepted,
        slip_mm=slip_mm,
        press_n=press_n,
        wrench_age_s=now_s - float(window.t_s[-1]) if sampled else math.nan,
        wrench_age_limit_s=bench.wrench_late_s + motions.WRENCH_AGE_LIMIT_S,
        moved_mm=devices.travelled_mm(places_mm),
        width_change_mm=status.width_mm - width_mm,
        holding=status.holding,
        approved=approved,
    )
