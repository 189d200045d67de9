"""Runs on hardware need valid calibrations; episodes record the calibrations in use."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from tests.backend.bench.brisk import brisk_bench, brisk_session, on
from tests.backend.runs.oracle_bench import OracleSession, request
from tests.backend.runs.test_event_log import last_trial
from tests.backend.runs.test_requests import hold, order, position
from touchdown.backend.bench import LabChoice, SimulatedBenchChoice, lab_session, simulated_session
from touchdown.backend.calibration.applied import calibrated_cameras, camera_conflicts
from touchdown.backend.calibration.cameras import mirrored_dots, numbers_to_dots
from touchdown.backend.calibration.records import CalibrationStore
from touchdown.backend.calibration.result import (
    CALIBRATION_KINDS,
    CALIBRATION_NAMES,
    CalibrationEstimate,
    Quantity,
)
from touchdown.backend.config.hardware import GelsightSettings
from touchdown.backend.core.events import (
    EpisodeRecorded,
    Event,
    FaultRaised,
    Paused,
    PhaseEntered,
    Released,
    RunFinished,
)
from touchdown.backend.core.faults import RefusedError
from touchdown.backend.core.values import Outcome
from touchdown.backend.devices.protocols import Identity
from touchdown.backend.emulation.simulated_disturbances import Disturbance, DisturbanceScript
from touchdown.backend.episodes.episode_mcap import read_episode
from touchdown.backend.rig.connection import BenchConnection
from touchdown.backend.runs import (
    CalibrateRequest,
    CollectRequest,
    ProbeRequest,
    RecordingOptions,
    RunState,
    SceneChoice,
    StackRequest,
    accept_calibration,
    calibrations_for,
    device_names,
    payload_wrench,
)
from touchdown.backend.simulation.finger_camera import load_gel_appearance

NOW = datetime.now(UTC)
WEIGHED = CalibrationEstimate(
    (
        Quantity("mass_kg", 1.5, 0.01, "kg"),
        Quantity("com_x_mm", 2.0, 0.1, "mm"),
        Quantity("com_y_mm", -1.0, 0.1, "mm"),
        Quantity("face_x_mm", 0.1, 0.05, "mm"),
        Quantity("face_y_mm", 0.2, 0.05, "mm"),
        *(Quantity(name, 0.5, 0.01, "mm") for name in CALIBRATION_KINDS["board"].values),
        *(Quantity(name, 0.06, 0.01, "mm/px") for name in CALIBRATION_KINDS["camera"].values),
    ),
    np.eye(14), np.zeros(6), 0.05, 0.3, "N",
)  # fmt: skip
FELT = CalibrationEstimate(
    tuple(
        Quantity(name, value, 0.01, "mm")
        for name, value in (
            ("x_mm", 0.5), ("y_mm", 0.1), ("z_mm", 30.0), ("slope_x_rad", 0.0), ("slope_y_rad", 0.0)
        )
    ),
    np.eye(5), np.zeros(5), 0.05, 0.1, "mm",
)  # fmt: skip
SEEN = CalibrationEstimate(
    (
        Quantity("exchanged", 1.0, 0.0, ""),
        Quantity("left_mirror", 2.0, 0.0, ""),
        Quantity("right_mirror", 1.0, 0.0, ""),
        Quantity("left_u_mm_px", 0.058, 0.0, "mm/px"),
        Quantity("left_v_mm_px", 0.06, 0.0, "mm/px"),
        Quantity("right_u_mm_px", 0.059, 0.0, "mm/px"),
        Quantity("right_v_mm_px", 0.06, 0.0, "mm/px"),
    ),
    np.zeros((7, 7)), np.zeros(4), 1.7, 3.0, "px",
)  # fmt: skip


class Camera:
    """Camera as used by a calibration."""

    def __init__(self, serial, mirror) -> None:
        self.identity = Identity("GelSight", "Mini", serial, "")
        self._mirror = mirror

    def describe(self):
        return {"mirror": self._mirror}


def filled(folder, devices, mode="hardware", at=NOW) -> CalibrationStore:
    store = CalibrationStore(folder, mode)
    for what in CALIBRATION_NAMES:
        store.accept(WEIGHED.to_event(0.0, what), device_names(devices), now=at)
    return store


@pytest.mark.parametrize("request_", [StackRequest(), CollectRequest()])
def test_campaigns_on_hardware_need_calibrations_that_hold(tmp_path, request_):
    for store in (None, CalibrationStore(tmp_path / "none", "hardware")):
        with pytest.raises(RefusedError, match="CALIBRATION-MISSING"):
            calibrations_for(request_, "hardware", store, {})
    old = filled(tmp_path / "old", {}, at=NOW - timedelta(days=40))
    with pytest.raises(RefusedError, match=r"Board: expired 39 days ago.*calibrate board"):
        calibrations_for(request_, "hardware", old, {})
    good = filled(tmp_path / "good", {})
    assert set(calibrations_for(request_, "hardware", good, {})) == set(CALIBRATION_NAMES)


def test_a_board_felt_on_another_bottom_is_no_board_of_this_one(tmp_path):
    store = filled(tmp_path, {})
    store.accept(FELT.to_event(0.0, "board", "pot on square15"), {}, now=NOW + timedelta(seconds=2))
    with pytest.raises(RefusedError, match=r"measured on square15, not on short.*--bottom short"):
        calibrations_for(StackRequest(bottoms=("short",)), "hardware", store, {})
    assert calibrations_for(CollectRequest(bottom="square15"), "hardware", store, {})


@pytest.mark.promise("C6")
def test_cameras_are_kept_as_they_sit_whatever_the_settings_were(tmp_path):
    devices = {
        f"tactile_{finger}": Camera(serial, mirror)
        for finger, serial, mirror in (("left", "AAAA-1111", "x"), ("right", "BBBB-2222", "none"))
    }
    store = CalibrationStore(tmp_path, "hardware")
    at_px = {
        "A": load_gel_appearance().rest_px,
        "B": load_gel_appearance().rest_px + np.array([5.0, -3.0]),
    }
    shown = (mirrored_dots(at_px["A"], "x"), at_px["B"])
    gels_px = tuple(np.concatenate([px.ravel() for px in shown]).tolist())
    accept_calibration(store, replace(SEEN, gels_px=gels_px).to_event(0.0, "camera"), devices)
    record = store.status("camera", {}).record
    # The fingerprints go with their cameras, and are those of the raw pictures.
    for name, gel in (("tactile_left", "B"), ("tactile_right", "A")):
        np.testing.assert_allclose(numbers_to_dots(record.file.gels[name]), at_px[gel], atol=1e-3)
    settings = GelsightSettings.model_validate(
        {
            "left": {"serial": "AAAA-1111", "mirror": "x"},
            "right": {"serial": "BBBB-2222", "crop_fraction": 0.2},
        }
    )
    seen = calibrated_cameras(settings, record)
    # The left finger is the camera B, of which y is reversed; of the camera A, x was set and is
    # reversed again.
    assert (seen.left.serial, seen.left.mirror, seen.left.crop_fraction) == ("BBBB-2222", "y", 0.2)
    assert (seen.right.serial, seen.right.mirror) == ("AAAA-1111", "none")
    assert (seen.mm_per_px_x, seen.mm_per_px_y) == pytest.approx((0.0585, 0.06))
    # What it corrects is the file, however often it is read; other cameras are left alone.
    assert calibrated_cameras(seen, record) == seen
    # That it counts is said, of each camera that is named otherwise.
    told = camera_conflicts(settings, record, "run 'touchdown calibrate camera'")
    assert list(told) == ["tactile_left", "tactile_right"]
    assert "names AAAA-1111 for the left finger" in told["tactile_left"]
    assert "found BBBB-2222 there, which is used" in told["tactile_left"]
    assert "run 'touchdown calibrate camera'" in told["tactile_left"]
    assert told["tactile_right"].endswith("found AAAA-1111 there, which is used")
    assert (
        camera_conflicts(seen, record, "") == camera_conflicts(GelsightSettings(), record, "") == {}
    )
    other = GelsightSettings.model_validate({"left": {"serial": "CCCC-3333"}})
    assert calibrated_cameras(other, record) == other


def test_everything_else_begins_without_them(tmp_path):
    empty = CalibrationStore(tmp_path, "hardware")
    for mode in ("simulated", "emulated"):
        assert calibrations_for(StackRequest(), mode, None, {}) == {}
    for asked in (ProbeRequest(), CalibrateRequest("payload")):
        assert calibrations_for(asked, "hardware", empty, {}) == {}


@pytest.fixture
def session():
    choice = SimulatedBenchChoice(preset="off")
    with simulated_session(choice, keep=RecordingOptions(None)) as made:
        made.prepare(SceneChoice(estimates=False))
        yield made


def test_a_simulated_bench_uses_what_it_has_and_its_episodes_say_so(session, tmp_path):
    recorded = []
    on(session, EpisodeRecorded, recorded.append)
    store = session.calibrations = filled(tmp_path, session.devices, "simulated")
    session.prepare(SceneChoice(estimates=False))
    payload = payload_wrench(store, session.devices)
    # Weight down; its arm turns the hand as the cross product says.
    force = np.array([0.0, 0.0, -1.5 * 9.80665])
    np.testing.assert_allclose(payload, [*force, *np.cross([0.002, -0.001, 0.0], force)])
    np.testing.assert_array_equal(session._scene.sensing._tare.payload, payload)
    session.run(ProbeRequest())
    told = dict(recorded[0].episode.metadata)
    for what in CALIBRATION_NAMES:
        standing = store.status(what, device_names(session.devices))
        assert told[f"calibration_{what}"] == standing.record.sha256


def test_a_run_has_the_payload_it_was_checked_with_though_the_file_is_damaged_since(
    session, tmp_path, monkeypatch
):
    store = session.calibrations = filled(tmp_path, session.devices, "simulated")
    checked = payload_wrench(store, session.devices)
    make_stage = session._make_stage

    def damaging(choice, raw):
        for path in tmp_path.glob("payload-*.json"):
            path.write_text("[]")
        return make_stage(choice, raw)

    monkeypatch.setattr(session, "_make_stage", damaging)
    session.run(StackRequest(strategy="pick-and-place"))
    assert payload_wrench(store, session.devices) is None
    np.testing.assert_array_equal(session._scene.sensing._tare.payload, checked)


def test_a_sensor_that_was_changed_needs_a_new_payload(session, tmp_path):
    store = filled(tmp_path, session.devices, "simulated")
    names = device_names(session.devices)
    assert names["force_torque"].model
    other = names["force_torque"].model_copy(update={"serial": "another"})
    standing = store.status("payload", {**names, "force_torque": other})
    assert standing.condition == "other device"


def test_a_lab_of_hardware_refuses_to_stack_and_looks_beside_its_file(tmp_path, monkeypatch):
    template = files("touchdown.resources") / "benches" / "lab.toml"
    path = tmp_path / "lab.toml"
    path.write_text(template.read_text(encoding="utf-8"))
    monkeypatch.setattr(BenchConnection, "missing", lambda _self: ())
    with lab_session(LabChoice(path), keep=RecordingOptions(None)) as session:
        with pytest.raises(RefusedError, match=r"Payload: never calibrated.*calibrate payload"):
            session.start(StackRequest(mode="approve"))
        filled(tmp_path / "calibrations", {})
        session.start(StackRequest(mode="approve"))
        assert session.engine.busy


def test_a_lab_counts_the_presses_of_its_gels_and_names_a_replaced_one(tmp_path):
    template = (files("touchdown.resources") / "benches" / "lab.toml").read_text(encoding="utf-8")
    path = tmp_path / "lab.toml"
    filled(tmp_path / "calibrations", {}, at=NOW - timedelta(minutes=1))
    for gel, presses in (("A-1", 3), ("B-2", 0)):
        path.write_text(template.replace('"FILL-IN1" }', f'"FILL-IN1", gel = "{gel}" }}'))
        with lab_session(LabChoice(path), keep=RecordingOptions(None)) as session:
            for _ in range(presses):
                session.events.publish(PhaseEntered(0.0, "press", 1))
            (life,) = session.calibrations.gels.lives()
            assert (life.serial, life.presses) == (gel, presses)
            told = dict(session.connection.notices)
    assert told["tactile_left"].startswith(
        f"The left gel was replaced on {datetime.now():%Y-%m-%d}"
    )
    assert "(A-1 by B-2): calibration, models and certificates" in told["tactile_left"]
    with pytest.raises(RefusedError, match=r"calibrate camera.*GEL-REPLACED"):
        calibrations_for(CollectRequest(), "hardware", session.calibrations, {})


MOST_S = 40.0


class Slowed(OracleSession):
    """Run whose wrist sensor delivers 300 of 1000 samples/s from the first probe on."""

    def __init__(self, runs: Path | None) -> None:
        super().__init__("force_torque:slow=300@2.0", runs=runs)
        self.session.start(request())

    def go_on_until(self, what: str) -> None:
        """Advance until ``what`` is the state of the run, or the pause of a degraded sensor."""
        while what != self.state():
            self.session.engine.tick()
            self.session.advance()
            assert self.session.clock_s() < MOST_S, self.state()

    def state(self) -> str:
        """Return the state; "stands" while the checkpoint waits for the sensor."""
        session = self.session
        stands = session.engine._stand_until_s is not None and session.degraded
        running = session.status().state is RunState.RUNNING
        return "stands" if stands and running else session.status().state.value

    def fail(self, kind: str) -> None:
        """Let the wrist sensor fail permanently."""
        bench = self.benches[-1]
        bench._script = DisturbanceScript(
            (Disturbance("force_torque", kind, self.session.clock_s()),)
        )


@pytest.mark.promise("S9")
@pytest.mark.parametrize(
    ("until", "kind"), [("stands", "nan"), ("stands", "stop"), ("paused", "stop")]
)
def test_a_sensor_lost_while_its_run_stands_degraded_ends_it_and_keeps_the_probe(
    until, kind, tmp_path
):
    bench = Slowed(tmp_path)
    bench.go_on_until(until)
    (kept,) = bench.of(EpisodeRecorded)
    assert isinstance(kept, EpisodeRecorded)
    assert [fact.fault.code for fact in bench.of(Paused)] == ["DEGRADED"] * (until == "paused")
    bench.fail(kind)
    failed_s = bench.session.clock_s()
    bench.go_on_until("idle")
    assert bench.session.clock_s() - failed_s < 0.4
    (raised,) = bench.of(FaultRaised)
    assert (raised.fault.code, raised.fault.device) == ("FT-STALE", "force_torque")
    assert last_trial(bench).outcome is Outcome.ABORTED
    assert bench.of(RunFinished)[-1].ending == "failed"
    assert bench.of(Released) == []
    assert bench.session._scene.gripper.status().holding, "the piece is kept"
    (file,) = tmp_path.rglob("*.mcap")
    assert read_episode(file).quality.accepted
    bench.session.close()


@pytest.mark.promise("S6")
def test_with_a_slow_sensor_the_arm_only_jogs_away_and_holds_what_it_holds():
    made = simulated_session(
        brisk_bench(faults=("force_torque:slow=300@0",)), keep=RecordingOptions(None)
    )
    made.prepare(SceneChoice(estimates=False))
    while made.clock_s() < 1.3:
        made.advance()
    assert [(one.device, one.how) for one in made.degraded] == [("force_torque", "slow")]
    with pytest.raises(RefusedError, match="delivered less than half") as refused:
        made.hand.jog.renew(order(made, axis="x"))
    assert refused.value.reason == "DEGRADED"
    with pytest.raises(RefusedError, match="only \\+Z is possible"):
        made.hand.jog.step("z", "XYZ", -0.5, 2.0)
    with pytest.raises(RefusedError, match="Turn once it is well"):
        made.hand.jog.step("rz", "XYZ", 0.01, 0.05)
    before = position(made)
    hold(made, 0.3, hold=2, speed=5.0)
    assert position(made)[2] > before[2]
    made.hand.jog.end(2)
    made.hand.grip(8.0)
    while made.hand.active:
        made.advance()
    assert made._scene.gripper.status().holding
    made.close()


def test_after_the_piece_was_let_go_a_probe_says_that_and_what_to_do():
    session = brisk_session()
    session.prepare(SceneChoice(estimates=False))
    facts: list[Event] = []
    session.events.subscribe(facts.append)
    for command in (lambda hand: hand.grip(8.0), lambda hand: hand.open(confirmed=True)):
        command(session.hand)
        session.advance()
        while session.hand.active:
            session.advance()
    session.run(ProbeRequest())
    assert [f.phase for f in facts if isinstance(f, PhaseEntered)] == ["grip"], "nothing is pressed"
    (ended,) = [f for f in facts if isinstance(f, RunFinished)]
    assert ended.ending == "failed"
    assert ended.reason.startswith("The gripper closed on nothing: no piece is between the jaws.")
    assert "set a new simulated scene (Ctrl+N in Operate)" in ended.reason
    assert not session.interlock.latched
    session.close()
