"""Runs on hardware begin only with calibrations that hold; episodes say which ones they used."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from importlib.resources import files

import numpy as np
import pytest

from backend.assembly import SimulatedBenchChoice, simulated_session
from backend.calibration.estimate import Estimate, Quantity
from backend.calibration.kinds import WHATS
from backend.calibration.store import CalibrationStore
from backend.core.facts import EpisodeRecorded
from backend.core.faults import RefusedError
from backend.lab import LabChoice, lab_session
from backend.rig.connection import Connection
from backend.runs.calibrated import calibrations_for, device_names, payload_of
from backend.runs.requests import (
    CalibrateRequest,
    CollectRequest,
    ProbeRequest,
    SceneChoice,
    StackRequest,
)
from backend.session import Keep

NOW = datetime.now(UTC)
WEIGHED = Estimate(
    (
        Quantity("mass_kg", 1.5, 0.01, "kg"),
        Quantity("com_x_mm", 2.0, 0.1, "mm"),
        Quantity("com_y_mm", -1.0, 0.1, "mm"),
    ),
    np.eye(3), np.zeros(6), 0.05, 0.3, "N",
)  # fmt: skip


def filled(folder, devices, mode="hardware", at=NOW) -> CalibrationStore:
    store = CalibrationStore(folder, mode)
    for what in WHATS:
        store.accept(WEIGHED.told(0.0, what), device_names(devices), now=at)
    return store


@pytest.mark.parametrize("request_", [StackRequest(), CollectRequest()])
def test_campaigns_on_hardware_need_calibrations_that_hold(tmp_path, request_) -> None:
    for store in (None, CalibrationStore(tmp_path / "none", "hardware")):
        with pytest.raises(RefusedError, match="CALIBRATION-MISSING"):
            calibrations_for(request_, "hardware", store, {})
    old = filled(tmp_path / "old", {}, at=NOW - timedelta(days=40))
    with pytest.raises(RefusedError, match=r"Board: expired 39 days ago.*calibrate board"):
        calibrations_for(request_, "hardware", old, {})
    good = filled(tmp_path / "good", {})
    assert set(calibrations_for(request_, "hardware", good, {})) == set(WHATS)


def test_everything_else_begins_without_them(tmp_path) -> None:
    empty = CalibrationStore(tmp_path, "hardware")
    for mode in ("simulated", "emulated"):
        assert calibrations_for(StackRequest(), mode, None, {}) == {}
    for request in (ProbeRequest(), CalibrateRequest("payload")):
        assert calibrations_for(request, "hardware", empty, {}) == {}


def test_a_simulated_bench_uses_what_it_has_and_its_episodes_say_so(tmp_path) -> None:
    session = simulated_session(SimulatedBenchChoice(preset="off"), keep=Keep(None))
    recorded = []
    session.hub.subscribe(lambda f: recorded.append(f) if isinstance(f, EpisodeRecorded) else None)
    session.prepare(SceneChoice(estimates=False))
    store = session.calibrations = filled(tmp_path, session.devices, "simulated")
    session.prepare(SceneChoice(estimates=False))
    payload = payload_of(store, session.devices)
    assert payload is not None
    # Weight down; its arm turns the hand as the cross product says.
    force = np.array([0.0, 0.0, -1.5 * 9.80665])
    np.testing.assert_allclose(payload, [*force, *np.cross([0.002, -0.001, 0.0], force)])
    np.testing.assert_array_equal(session._scene.sensing.tare.payload, payload)
    session.run(ProbeRequest())
    session.close()
    told = dict(recorded[0].episode.metadata)
    for what in WHATS:
        standing = store.standing(what, device_names(session.devices))
        assert standing.record is not None
        assert told[f"calibration_{what}"] == standing.record.sha256


def test_a_sensor_that_was_changed_needs_a_new_payload(tmp_path) -> None:
    session = simulated_session(SimulatedBenchChoice(preset="off"), keep=Keep(None))
    session.prepare(SceneChoice(estimates=False))
    store = filled(tmp_path, session.devices, "simulated")
    names = device_names(session.devices)
    assert names["force_torque"].model
    other = names["force_torque"].model_copy(update={"serial": "another"})
    standing = store.standing("payload", {**names, "force_torque": other})
    assert standing.condition == "other device"
    session.close()


def test_a_lab_of_hardware_refuses_to_stack_and_looks_beside_its_file(
    tmp_path, monkeypatch
) -> None:
    template = files("resources") / "benches" / "lab.toml"
    path = tmp_path / "lab.toml"
    path.write_text(template.read_text(encoding="utf-8"))
    monkeypatch.setattr(Connection, "missing", lambda _self: ())
    session = lab_session(LabChoice(path), keep=Keep(None))
    try:
        with pytest.raises(RefusedError, match=r"Payload: never calibrated.*calibrate payload"):
            session.start(StackRequest(mode="approve"))
        filled(tmp_path / "calibrations", {})
        session.start(StackRequest(mode="approve"))
        assert session.engine.busy
    finally:
        session.close()
