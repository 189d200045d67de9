"""Session on a lab file before anything is connected: nothing moves, and STOP works."""

from datetime import UTC, datetime, timedelta
from importlib.resources import files
from pathlib import Path

import pytest

from tests.backend.rig.scripted import LINES, scripted
from tests.backend.runs.test_calibrated import SEEN
from touchdown.backend.bench.laboratory import (
    LabChoice,
    calibrations_of,
    find_camera_conflicts,
    lab_session,
)
from touchdown.backend.calibration.records import DeviceName
from touchdown.backend.cli.doctor.command import lab_checks
from touchdown.backend.config.lab import load_lab
from touchdown.backend.core.faults import InputError, RefusedError
from touchdown.backend.devices.protocols import DeviceState
from touchdown.backend.runs.recorder import RecordingOptions
from touchdown.backend.runs.requests import ProbeRequest, SceneChoice, SetRequest, StackRequest

TEMPLATE = Path(str(files("touchdown.resources"))) / "benches" / "lab.toml"


@pytest.fixture
def session(tmp_path):
    text = TEMPLATE.read_text().replace("press_n = 25.0", "press_n = 20.0")
    path = tmp_path / "lab.toml"
    path.write_text(text.replace('piece = "pot"', 'piece = "mushroom"'))
    made = lab_session(LabChoice(path), keep=RecordingOptions(tmp_path / "runs"))
    yield made
    made.close()


def test_it_is_called_by_its_name_and_knows_its_limits(session, tmp_path):
    assert (session.name, session.description.mode, session.simulated) == (
        "My lab",
        "hardware",
        False,
    )
    assert session.interlock.limits.press_n == 20.0
    assert session.limits_source == str(tmp_path / "lab.toml")
    assert list(session.devices) == list(LINES)
    assert {device.state for device in session.devices.values()} == {DeviceState.CLOSED}
    assert session.hand is None
    assert (session.usual.piece, session.usual.bottoms) == ("mushroom", ("short",))


@pytest.mark.parametrize("request_", [ProbeRequest(), SetRequest(SceneChoice()), StackRequest()])
def test_nothing_starts_before_all_are_connected(session, request_):
    with pytest.raises(RefusedError, match=r"Not connected: force_torque.*Ctrl\+L"):
        session.start(request_)


def test_what_only_a_simulation_can_do_is_refused(session):
    with pytest.raises(RefusedError) as caught:
        session.start(StackRequest(strategy="pick-and-place"))
    assert caught.value.reason == "SIMULATED-ONLY"


def test_stop_reaches_arm_and_gripper_before_there_is_a_scene(session):
    devices, log = scripted()
    session.connection.devices.update(devices)
    session.interlock.forget_stoppers()
    session.join(session.connection, "Bench", session.interlock.limits, "lab.toml")
    session.stop()
    assert log == ["stop arm", "stop gripper"]
    with pytest.raises(RefusedError, match="stopped"):
        session.home_gripper()


def test_a_model_of_simulations_does_not_decide_alone_here(session):
    choice = StackRequest(piece="mushroom", bottoms=("short",)).scene()
    with pytest.raises(InputError, match=r"must not run in auto mode here: bench mode"):
        session._check(choice)
    asked = StackRequest(piece="mushroom", bottoms=("short",), mode="approve").scene()
    told = session._check(asked)
    assert told["lab"]["name"] == "My lab"
    assert told["model"]["piece"] == "mushroom"


def test_a_bottom_that_nobody_knows_is_said_before_any_device_is_touched(tmp_path):
    path = tmp_path / "lab.toml"
    path.write_text(TEMPLATE.read_text().replace('bottom = "short"', 'bottom = "moon"'))
    with pytest.raises(InputError, match="moon"):
        lab_session(LabChoice(path))


@pytest.mark.promise("C6")
@pytest.mark.parametrize("days", [1, 400])
def test_a_file_with_the_cameras_exchanged_is_told_and_the_calibration_counts(tmp_path, days):
    """An expired calibration still holds for the assignment of the cameras."""
    path = tmp_path / "lab.toml"
    path.write_text(TEMPLATE.read_text())
    lab = load_lab(path)
    own = lab.settings.gelsight
    serials = {"left": own.right.serial, "right": own.left.serial}
    assert all(serials.values())
    assert find_camera_conflicts(lab) == {}
    who = {"maker": "GelSight", "model": "Mini"}
    calibrations_of(lab).accept(
        SEEN.to_event(0.0, "camera"),
        {f"tactile_{f}": DeviceName(**who, serial=number) for f, number in serials.items()},
        now=datetime.now(UTC) - timedelta(days=days),
    )
    session = lab_session(LabChoice(path), keep=RecordingOptions(tmp_path / "runs"))
    devices, _ = scripted()
    for line in LINES:
        devices[line].connect(1.0, session.connection._cancel)
    session.connection.devices.update(devices)
    notices = {line.name: line.notice for line in session.connection.lines()}
    session.close()
    assert [name for name in LINES if notices[name]] == ["tactile_left", "tactile_right"]
    assert f"found {serials['left']} there" in notices["tactile_left"]
    checks = [look() for look in list(lab_checks(path))[:3]]
    assert [check.word for check in checks] == ["OK", "NOTE", "NOTE"]
    assert notices["tactile_left"] == f"{checks[2].detail}. {checks[2].fix}".removesuffix(".")
