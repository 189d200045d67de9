"""An arm with a wrong frame reaches the true position after calibration."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.backend.bench.brisk import brisk_method, brisk_session, on
from tests.backend.runs.blind_bench import BlindBench
from tests.backend.runs.gel_bench import LOOKS, Gel, GelBench
from tests.backend.runs.oracle_bench import Oracle, OracleSession, request
from tests.backend.runs.skewed_arm import SkewedArm
from touchdown.backend.calibration.applied import UNCALIBRATED, HandPosition, calibrated_positions
from touchdown.backend.calibration.estimators import BOARD_LIMIT_MM
from touchdown.backend.calibration.records import CalibrationStore
from touchdown.backend.calibration.result import CalibrationEstimate, Quantity
from touchdown.backend.config.method import (
    EARLY_TICKS,
    CollectSettings,
    PolicySettings,
    StackSettings,
)
from touchdown.backend.core import (
    FINGERS,
    ActionChosen,
    ContactPatch,
    Episode,
    EpisodeQuality,
    EpisodeRecorded,
    Event,
    FaultRaised,
    Noticed,
    Outcome,
    PhaseEntered,
    Pose,
    RawStreams,
    Recording,
    RepaintHold,
    SampleStream,
    StabilityJudged,
    Stream,
    TrialFinished,
)
from touchdown.backend.devices import GripStatus, ReleaseEvidence
from touchdown.backend.devices.gelsight.emulator import other_gel, small_dots
from touchdown.backend.emulation.simulated_disturbances import Disturbance, DisturbanceScript
from touchdown.backend.episodes.quality import count_coverage
from touchdown.backend.geometry import circle, load_pieces
from touchdown.backend.runs import probe
from touchdown.backend.runs.calibrate import measure_board
from touchdown.backend.runs.calibrations import DriftMonitor, GelCheck, contact_height_mm
from touchdown.backend.runs.campaign import Campaign, last_signal_excerpt
from touchdown.backend.runs.collector import Collector, measure_offset
from touchdown.backend.runs.jig import approach_with_piece, pick_piece, return_piece
from touchdown.backend.runs.motions import REFERENCE_S, descent_start
from touchdown.backend.runs.probe import BELOW_MM, touch_height_mm
from touchdown.backend.runs.release import release_evidence
from touchdown.backend.runs.requests import CalibrateRequest, ProbeRequest, SceneChoice
from touchdown.backend.sensing.live import LiveSensing

OFF_MM = np.array([0.45, -0.4, -0.6])
TILT_RAD = np.array([0.01, 0.008, 0.0])
WANTED_MM = np.array([4.0, -3.0])
ABOUT = "pot on square15"


def touch_there(bench):
    """Touch at ``WANTED_MM`` as a campaign does; return position, expected and measured contact
    height.
    """
    yield from pick_piece(bench)
    centre = bench.placed.origin((0.0, 0.0), 0.2, bench.bottom)
    there = (centre.x_mm + WANTED_MM[0], centre.y_mm + WANTED_MM[1])
    start = descent_start(bench, there)
    yield from approach_with_piece(bench, start)
    felt_mm = yield from touch_height_mm(bench, np.array(there), start.z_mm, BELOW_MM)
    yield from return_piece(bench)
    return np.array(there), start.z_mm - bench.settings.probe.start_height_mm, felt_mm


def test_a_wrong_prior_is_put_right_by_the_board(tmp_path, monkeypatch):
    monkeypatch.setattr(probe, "SEARCH_MM", 1.6)
    request = CalibrateRequest("board", seed=5)
    skewed = []

    def skew(arm):
        skewed.append(SkewedArm(arm, OFF_MM, TILT_RAD))
        return skewed[0]

    blind = BlindBench(request.scene(), "off", arm=skew)
    jig_mm = [blind.bench.jig.x_mm, blind.bench.jig.y_mm, blind.bench.jig.z_mm]
    jig = Pose(*skewed[0].believed(np.array(jig_mm)).tolist())
    blind.bench = replace(blind.bench, jig=jig)
    found = blind.run(lambda bench: measure_board(bench, request))
    assert found.acceptable
    store = CalibrationStore(tmp_path, "simulated")
    store.accept(found.to_event(0.0, "board", ABOUT), {})
    used = store.in_use({}, required=False)
    placed = calibrated_positions(used)
    misses: dict[str, tuple[float, float]] = {}
    for name, known in (("calibrated", placed), ("not", UNCALIBRATED)):
        bench = replace(blind.bench, placed=known)
        there_mm, expected_mm, felt_mm = blind.run(lambda _, bench=bench: touch_there(bench))
        hand_mm = skewed[0].true(np.array([*there_mm, felt_mm]))[:2]
        off_mm = hand_mm - blind.centres_mm[-1] - WANTED_MM
        misses[name] = (np.abs(off_mm).max(), abs(felt_mm - expected_mm))
    assert max(misses["calibrated"]) <= BOARD_LIMIT_MM
    assert misses["not"][0] > 0.3
    assert misses["not"][1] > 0.4
    # Of another bottom it says nothing; with another piece, nothing of the height.
    assert placed.origin((0.0, 0.0), 0.2, "short") == UNCALIBRATED.origin((0.0, 0.0), 0.2, "short")
    assert not placed.board.is_of("barrel", "square15")
    # The guard of the arm goes by the height that was felt, of this piece on this bottom alone.
    pot = blind.bench.piece
    assert contact_height_mm(pot, "square15", used) == found.value("z_mm")
    assert (
        contact_height_mm(pot, "short", used)
        == contact_height_mm(pot, "square15", {})
        == pot.grip_height_mm
    )
    assert abs(found.value("z_mm") - pot.grip_height_mm) > 0.3


def test_the_hand_stands_off_a_known_bottom_by_the_face(tmp_path):
    estimate = CalibrationEstimate(
        (Quantity("face_x_mm", 0.3, 0.05, "mm"), Quantity("face_y_mm", -0.2, 0.05, "mm")),
        np.eye(2), np.zeros(2), 0.05, 0.2, "mm",
    )  # fmt: skip
    store = CalibrationStore(tmp_path, "simulated")
    store.accept(estimate.to_event(0.0, "tool"), {})
    placed = calibrated_positions(store.in_use({}, required=False))
    at = placed.origin((10.0, 5.0), 0.2, "short")
    assert (at.x_mm, at.y_mm) == pytest.approx((9.7, 5.2))
    assert at.sigma_mm == pytest.approx(np.hypot(0.2, 0.05))


def test_the_label_is_where_the_arm_was_at_contact_seen_from_the_origin():
    """The arm moves by (3, -5, -2) mm/s; contact lies between two poses."""
    t_s = np.array([0.9, 1.0, 1.1])
    pose_mm = np.array([10.0, -4.0, 21.0]) + np.outer(t_s - 1.0, [3.0, -5.0, -2.0])
    recording = Recording(t_s, np.zeros((3, 6)), (), (), t_s, pose_mm, np.zeros(6))
    quality = EpisodeQuality(True, (), 0, 0.0, 0, 5.0, 0.0)
    observation = np.zeros((20, 258), np.float32)
    episode = Episode("e", "pot", observation, np.array([7.0, 9.0]), 1.04, quality, recording)
    settings = CollectSettings(arm_sigma_mm=0.02, grip_sigma_mm=0.03)
    found = measure_offset(episode, HandPosition(8.5, -1.25, 0.06), settings)
    assert found.offset_mm == pytest.approx((1.62, -2.95))
    assert found.contact_mm == pytest.approx(20.92)
    assert found.sigma_mm == pytest.approx(0.07)
    label = found.label()
    assert (label.x_um, label.y_um, label.theta_mdeg, label.sigma_um) == (1620, -2950, 0, 70)


def test_the_signals_of_a_probe_are_its_largest_shifts_and_tx_ty_fz():
    observation = np.zeros((20, 258), np.float32)
    observation[-1, [10, 70, 140, 200]] = 2.0, -3.0, -2.5, 1.5  # u, v of the left; of the right
    observation[-1, 252:] = 0.1, 0.2, 9.0, -0.04, 0.05, 0.06
    assert last_signal_excerpt(observation) == pytest.approx((-2.5, -3.0, -0.04, 0.05, 9.0))


SEEN = count_coverage(np.empty((0, 2)), circle(15.0), circle(25.0))


class Reached(Exception):  # noqa: N818
    """Raised with the first target of the arm."""


def collector(*entries: Any) -> Collector:
    campaign = Campaign("c", "pot", "circle25", "random", 2, 5, skipped=(4,))
    return Collector(campaign, None, deque(maxlen=1), SEEN, list(entries))


def test_a_probe_goes_to_its_displacement_from_the_origin():
    ordered: list[Pose] = []

    def move_to(place: Pose, speed_mm_s: float) -> None:
        ordered.append(place)
        raise Reached

    bench: Any = SimpleNamespace(
        settings=StackSettings(),
        piece=load_pieces().top("pot"),
        placed=UNCALIBRATED,
        real_time=False,
        arm=SimpleNamespace(move_to=move_to),
    )
    origin = HandPosition(10.0, -4.0, 0.1)
    with pytest.raises(Reached):
        list(collector()._probe(bench, 0, (1.5, -2.25), origin, 21.0))
    above_mm = StackSettings().probe.start_height_mm
    assert ordered == [Pose(11.5, -6.25, 21.0 + above_mm)]


def test_what_was_deleted_or_rejected_is_neither_done_nor_left_out():
    def entry(item: int, accepted: bool, deleted: bool) -> Any:
        return SimpleNamespace(
            plan_item=item, quality=SimpleNamespace(accepted=accepted), deleted=deleted
        )

    resumed = collector(
        entry(0, accepted=True, deleted=False),
        entry(1, accepted=True, deleted=True),
        entry(2, accepted=False, deleted=False),
        entry(3, accepted=True, deleted=False),
    )
    assert resumed.done == 2
    assert list(resumed.todo) == [1, 2]


@pytest.mark.parametrize("tries", [1, 2, 3])
def test_a_place_of_rejected_probes_is_tried_as_the_settings_say(tries):
    working, pressed = collector(), []
    working.recorder = SimpleNamespace(record=lambda *_: None)
    method = StackSettings.model_validate({"collect": {"tries": tries}})
    where: Any = SimpleNamespace(label=lambda: None, offset_mm=np.zeros(2))
    while working.todo:
        pressed.append(working.todo[0])
        quality = SimpleNamespace(accepted=pressed[-1] != 0)
        probe: Any = SimpleNamespace(episode=SimpleNamespace(quality=quality))
        pending: Any = SimpleNamespace(pressed=probe, where=where)
        working._record(pending, None, method.collect.tries)
    assert pressed == [0] * tries + [1, 2, 3, 0]
    assert working.campaign.skipped == (0, 4)


SURFACE_MM = 30.0


class Bench:
    """Hand and 100 Hz wrist sensor with a given force creep."""

    def __init__(self) -> None:
        frames = {finger: Stream(f"tactile_{finger}", 4) for finger in FINGERS}
        raw = RawStreams(frames, SampleStream("force_torque", 6, 4000), SampleStream("arm", 3, 10))
        fields = {finger: Stream(f"markers_{finger}", 4) for finger in FINGERS}
        self.sensing = LiveSensing(raw, fields, SampleStream("wrench", 6, 4000), np.zeros(6))
        self.now_s, self.force_n, self.told = 0.0, -15.0, list[Noticed]()
        self.at, self.grip = Pose(0.0, 0.0, SURFACE_MM + 3.0), GripStatus(24.0, 10.0, True)
        self._rng = np.random.default_rng(3)
        scene = SimpleNamespace(
            now_s=lambda: self.now_s, arm=self, gripper=self, sensing=self.sensing
        )
        self._teller = DriftMonitor(scene, lambda: SURFACE_MM, self.told.append)

    def pose(self, _max_age_s: float) -> Pose:
        return self.at

    def status(self) -> GripStatus:
        return self.grip

    def go(self, seconds: float, n_per_s: float = 0.0, turn_rad_s: float = 0.0) -> None:
        for _ in range(round(10 * seconds)):
            t_s = self.now_s + np.arange(1, 11) * 0.01
            self.now_s += 0.1
            self.force_n += 0.1 * n_per_s
            self.at = replace(self.at, rx_rad=self.at.rx_rad + 0.1 * turn_rad_s)
            wrench = 0.1 * self._rng.standard_normal((10, 6))
            wrench[:, 2] += self.force_n
            self.sensing.raw.samples.put(t_s, wrench)
            self._teller.update()


@pytest.fixture
def drifting() -> Bench:
    made = Bench()
    made.go(8.0)
    assert made.sensing.drift.moved_n < 0.1
    return made


def test_a_drift_in_still_air_is_told_once_before_it_reaches_1_n(drifting):
    drifting.go(18.0, 0.05)
    (told,) = drifting.told
    assert told.fault.code == "FT-DRIFT"
    assert 0.45 < 0.05 * (told.t_s - 8.0) < 0.8
    assert "Zero it in air (Z)" in told.text


@pytest.mark.promise("S8")
def test_what_creeps_in_contact_is_no_drift_however_long(drifting):
    drifting.at = replace(drifting.at, z_mm=SURFACE_MM + 0.2)
    drifting.force_n += 8.0
    drifting.go(40.0, -0.05)
    drifting.at = replace(drifting.at, z_mm=SURFACE_MM + 3.0)
    drifting.force_n = -15.0
    drifting.go(3.0)
    assert drifting.told == []
    assert drifting.sensing.drift.moved_n < 0.1


def test_a_hand_that_turns_or_takes_another_piece_begins_anew(drifting):
    drifting.go(10.0, 0.1, turn_rad_s=0.01)
    drifting.at = replace(drifting.at, rx_rad=0.0)
    drifting.go(3.0)
    drifting.force_n += 1.0
    drifting.grip = GripStatus(float("nan"), 0.0, False)
    drifting.go(3.0)
    drifting.force_n -= 0.2
    drifting.grip = GripStatus(18.0, 10.0, True)
    drifting.go(3.0)
    assert drifting.told == []
    assert drifting.sensing.drift.moved_n < 0.15


def test_the_simulated_sensor_drifts_on_demand_and_its_probe_keeps_how_far():
    session = brisk_session(faults=("force_torque:drift=0.09@0.5",))
    told, episodes = list[Noticed](), list[EpisodeRecorded]()
    on(session, Noticed, told.append)
    on(session, EpisodeRecorded, episodes.append)
    session.prepare(SceneChoice("pot", ("short",)))
    while session.clock_s() < 9.0 and not told:
        session.advance()
    assert 0.45 < 0.09 * (told[0].t_s - 0.5) < 0.8
    session.run(ProbeRequest())
    assert dict(episodes[0].episode.metadata)["wrist_drift"].endswith(" s")
    assert len(told) == 1
    session.close()


@pytest.mark.parametrize("preset", ["quiet", "hard"])
def test_the_early_ticks_are_those_of_the_episode_bit_for_bit(preset):
    bench = OracleSession(preset=preset)
    bench.session.run(request())
    decided = 0
    for oracle in bench.oracles:
        # A probe that was rejected was prepared for and never asked about.
        taken = {early.tobytes() for early in oracle.prepared}
        for episode in oracle.asked:
            assert episode.observation[:EARLY_TICKS].tobytes() in taken
            decided += 1
        assert all(early.shape == (EARLY_TICKS, 258) for early in oracle.prepared)
    assert decided == len(bench.of(ActionChosen)) > 0


def test_nobody_draws_beside_a_decision(monkeypatch):
    method = brisk_method().model_copy(update={"policy": PolicySettings(max_probes=1)})
    bench = OracleSession(preset="quiet", method=method)
    session, after = bench.session, []
    session.repaint_hold = RepaintHold(lambda: 0.0)

    on(session, ActionChosen, lambda _: after.append(session.repaint_hold.on))
    asked: list[bool] = []
    answer = Oracle.estimate

    def estimate(self: Oracle, episode: Episode) -> ContactPatch:
        asked.append(session.repaint_hold.on)
        return answer(self, episode)

    monkeypatch.setattr(Oracle, "estimate", estimate)
    session.run(request())
    assert asked == [True] * len(asked)
    assert after == [False] * len(asked)
    assert asked


FINE = {finger: Gel(look, 3 + seed) for seed, (finger, look) in enumerate(LOOKS.items())}
LEFT = LOOKS["left"]


@pytest.fixture
def fitted(tmp_path):
    made = GelBench(tmp_path, FINE)
    made.calibrate()
    yield made
    made.connection.close()


def drawn(rest_px) -> Gel:
    return Gel(replace(LEFT, rest_px=np.asarray(rest_px, dtype=float).reshape(63, 2)), 5)


@pytest.mark.promise("C6")
def test_the_same_gels_are_accepted_in_other_light_and_as_a_setting_mirrors_them(fitted):
    fitted.gels = {"left": Gel(LEFT, 90, (1.2, -0.8), 0.9), "right": FINE["right"]}
    assert fitted.connect() == {}
    fitted.mirror = "y"
    assert fitted.connect() == {}
    assert fitted.connection.ready


@pytest.mark.promise("C6")
def test_gels_that_changed_places_are_refused_and_whose_they_are_is_said(fitted):
    fitted.gels = {"left": FINE["right"], "right": FINE["left"]}
    fitted.log.clear()
    found = fitted.faults()
    assert {fault.code for fault in found.values()} == {"GEL-OTHER"}
    assert fitted.connection.missing() == ("tactile_left", "tactile_right")
    assert found["tactile_left"].next_step.startswith("It is the gel of the right finger")
    assert "rms, limit 1" in found["tactile_left"].what
    assert fitted.log.index("close tactile_left") < fitted.log.index("connect arm")


@pytest.mark.promise("C6")
def test_one_other_gel_or_one_turned_round_is_refused_and_the_other_camera_stays(fitted):
    fitted.gels = {**FINE, "left": Gel(LEFT, 5, fitted=other_gel)}
    found = fitted.faults()
    assert list(found) == ["tactile_left"]
    assert "exchanged" in found["tactile_left"].next_step
    assert "run 'touchdown calibrate camera --accept'" in found["tactile_left"].next_step
    # To follow that, any gel of the right grid can be connected.
    fitted.connection.prove = GelCheck(
        None, fitted.devices, fitted.frames, lambda cancel: fitted.shoot()
    ).prove
    assert fitted.connect() == {}
    fitted.connection.prove = fitted.check.prove
    turned = LEFT.rest_px.reshape(7, 9, 2)[::-1] * [1, -1] + [0, 239]
    fitted.gels = {**FINE, "left": drawn(turned)}
    assert "mirrored in y" in fitted.faults()["tactile_left"].next_step


@pytest.mark.promise("C6")
def test_a_held_piece_may_press_the_dots_out_of_their_rest(fitted):
    outwards = LEFT.rest_px + 1.5 * np.sign(LEFT.rest_px - [160, 120])
    fitted.gels = {"left": drawn(outwards), "right": FINE["left"]}
    assert fitted.connect() == {"tactile_left": "GEL-OTHER", "tactile_right": "GEL-OTHER"}
    fitted.holding = True
    assert fitted.connect() == {"tactile_right": "GEL-OTHER"}


@pytest.mark.promise("C6")
def test_a_calibration_without_a_fingerprint_stays_valid_and_says_so(tmp_path):
    fitted = GelBench(tmp_path, FINE)
    fitted.calibrate(fingerprint=False)
    standing = fitted.store.status("camera", {})
    assert (standing.condition, standing.notice) == ("valid", "no fingerprint of the gels yet")
    fitted.gels = {"left": FINE["right"], "right": FINE["left"]}
    assert fitted.connect() == {}
    fitted.connection.close()


@pytest.mark.promise("C7")
def test_a_camera_without_pictures_and_one_of_another_grid_are_named(fitted):
    fitted.gels = {"right": Gel(LOOKS["right"], 6, fitted=small_dots)}
    found = fitted.faults()
    assert found["tactile_left"].code == "GEL-UNSEEN"
    assert found["tactile_right"].code == "GEL-GRID"
    assert "8x10 small-dot gel" in found["tactile_right"].what


NOW_S, JUDGED_S = 10.0, 8.75


def evidence(tare_s: float = 4.0, width_mm: float = 20.0, accepted: bool = True) -> ReleaseEvidence:
    """Wrench and poses of the last second; the fingers tell ``width_mm``, 20 mm before."""
    t_s = NOW_S - 1.0 + 0.01 * np.arange(101)
    wrench, poses = SampleStream("wrench", 6, 200), SampleStream("poses", 3, 200)
    wrench.put(t_s, np.tile([0.3, -0.4, 1.1, 0.01, -0.02, 0.03], (101, 1)))
    poses.put(t_s, np.array([5.0, -7.0, 30.0]) + np.outer(t_s - NOW_S, [0.1, -0.2, 0.05]))
    episode = SimpleNamespace(
        recording=None, onset_s=7.0, quality=SimpleNamespace(accepted=accepted)
    )
    bench: Any = SimpleNamespace(
        now_s=lambda: NOW_S,
        gripper=SimpleNamespace(status=lambda: GripStatus(width_mm, 9.0, True)),
        sensing=SimpleNamespace(wrench=wrench, tare_s=tare_s),
        arm=SimpleNamespace(poses=poses),
        settings=StackSettings(),
        wrench_late_s=0.005,
    )
    judged: Any = SimpleNamespace(
        pressed=SimpleNamespace(episode=episode),
        stability=SimpleNamespace(stable=True, margin_mm=1.25),
        at_s=JUDGED_S,
    )
    return release_evidence(bench, judged, 20.0, approved=True)


def test_all_of_it_is_read():
    found = evidence()
    assert (found.verdict_stable, found.quality_accepted, found.holding) == (True, True, True)
    assert (found.margin_mm, found.verdict_age_s) == (1.25, 1.25)
    assert found.press_n == pytest.approx(1.1)
    assert found.wrench_age_s == pytest.approx(0.0, abs=1e-9)
    assert found.wrench_age_limit_s == pytest.approx(0.02)
    assert found.moved_mm == pytest.approx(0.04, abs=2e-3)
    assert not evidence(accepted=False).quality_accepted


@pytest.mark.parametrize(("tare_s", "last"), [(JUDGED_S - 0.01, True), (JUDGED_S + 0.01, False)])
def test_a_verdict_from_before_the_last_tare_is_not_of_the_last_probe(tare_s, last):
    assert evidence(tare_s=tare_s).verdict_of_last_probe is last


def test_the_width_counts_from_the_grasp():
    assert evidence(width_mm=20.4).width_change_mm == pytest.approx(0.4)
    assert evidence(width_mm=19.9).width_change_mm == pytest.approx(-0.1)


def test_a_mug_is_released_with_its_centre_of_mass_over_the_support():
    com = np.array(load_pieces().top("mug").com_xy_mm)
    bench = OracleSession(preset="quiet")
    bench.session.run(request(piece="mug"))
    (end,) = bench.of(TrialFinished)
    assert end.outcome is Outcome.PLACED
    probed, judged, chosen = map(bench.of, (EpisodeRecorded, StabilityJudged, ActionChosen))
    assert len(probed) == len(judged) == len(chosen) == end.probes > 1
    for made, verdict in zip(probed, judged, strict=True):
        off_mm = np.asarray(verdict.stability.centre_mm) - made.episode.offset_mm
        np.testing.assert_allclose(off_mm, com, atol=1e-9)
    # Face and bottom are discs of 20 mm: the support is a lens, whose edges are theirs.
    truth = bench.benches[-1].truth()
    assert truth.stands is True
    over = np.asarray(truth.offset_mm) + com
    inside = 10.0 - max(np.hypot(*over), np.hypot(*com))
    assert end.margin_mm == pytest.approx(inside, abs=0.1)
    bench.session.close()


# Shorter than what counts as silent, and no window of a tare is free of it.
BURST_S, EVERY_S = 0.15, 0.25


def spoil(bench: OracleSession, bursts: int) -> list[float]:
    """Inject bursts of NaN from the first reference on; return their start."""
    began: list[float] = []

    def hear(fact: Event) -> None:
        if isinstance(fact, PhaseEntered) and fact.phase == "reference" and not began:
            began.append(fact.t_s)
            # The first one lies in the window of the first try.
            at = [fact.t_s + 0.4 + EVERY_S * n for n in range(bursts)]
            found = (Disturbance("force_torque", "nan", t_s, BURST_S) for t_s in at)
            bench.benches[-1]._script = DisturbanceScript(tuple(found))

    bench.session.events.subscribe(hear)
    return began


def approaches(bench: OracleSession) -> list[float]:
    """Return the start times of the descents to a probe."""
    return [f.t_s for f in bench.of(PhaseEntered) if getattr(f, "phase", "") == "approach"]


@pytest.mark.promise("S8")
def test_a_spoilt_tare_is_taken_again():
    bursts = 3
    bench = OracleSession()
    began = spoil(bench, bursts)

    def enough(fact: Event) -> None:
        if isinstance(fact, PhaseEntered) and fact.phase == "approach":
            bench.session.stop()

    bench.session.events.subscribe(enough)
    bench.session.run(request(trials=1))
    assert bench.session.interlock.faults == ()
    # Not before the bursts had left the window.
    assert approaches(bench)[0] > began[0] + 0.4 + EVERY_S * (bursts - 1) + BURST_S


@pytest.mark.promise("S8")
def test_a_tare_that_stays_spoilt_ends_the_run_before_a_probe():
    bench = OracleSession()
    began = spoil(bench, 40)
    bench.session.run(request(trials=1))
    end = bench.of(TrialFinished)[-1]
    assert end.outcome is Outcome.ABORTED
    assert [fault.code for fault in bench.session.interlock.faults] == ["TARE-REFUSED"]
    assert approaches(bench) == []
    (told,) = bench.of(FaultRaised)
    assert REFERENCE_S <= told.t_s - began[0] <= REFERENCE_S + 2.0
    assert bench.benches[-1].gripper.status().holding
