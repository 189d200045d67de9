"""Lab files: each version is read, a bad one names its key, and kind and addresses must agree."""

import re
import tomllib
from datetime import UTC, datetime, timedelta
from importlib.resources import files
from itertools import islice
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
from touchdown.backend.config import HardwareSettings, Limits, is_lab_file, load_lab, save_lab
from touchdown.backend.config.lab import LAB_FILE_VERSION, edit_toml
from touchdown.backend.core.faults import InputError, RefusedError
from touchdown.backend.devices import DeviceState
from touchdown.backend.runs.recorder import RecordingOptions
from touchdown.backend.runs.requests import ProbeRequest, SceneChoice, SetRequest, StackRequest

BENCHES = Path(str(files("touchdown.resources"))) / "benches"
EMULATED = """
[melfa]
host = "127.0.0.1"
[wsg]
host = "localhost"
[ft]
driver = "dynpick"
address = "socket://127.0.0.1:4000"
[gelsight]
by_id = "/srv/bench/by-id"
"""
HEAD = 'version = 1\nname = "Bench 2"\nkind = "{kind}"\n'


def written(tmp_path, text):
    path = tmp_path / "lab.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_the_template_is_a_lab_file_of_real_devices():
    lab = load_lab(BENCHES / "lab.toml")
    assert lab.settings.kind == lab.facts.mode == "hardware"
    assert lab.calibrations == BENCHES / "calibrations"
    assert lab.settings.limits == Limits()


def test_lab_files_and_simulated_benches_are_told_apart():
    found = {path.name: is_lab_file(path) for path in BENCHES.glob("*.toml")}
    assert [name for name, lab in found.items() if lab] == ["lab.toml"]


@pytest.mark.parametrize("version", [LAB_FILE_VERSION + 1, 0, -1, '"1"', "true", None])
def test_a_version_that_nobody_knows_is_refused(tmp_path, version):
    line = "" if version is None else f"version = {version}\n"
    path = written(tmp_path, line + 'name = "x"\nkind = "hardware"\n')
    with pytest.raises(InputError, match="'version'") as caught:
        load_lab(path)
    assert caught.value.where == str(path)


@pytest.mark.promise("D8")
@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("[limits]\nspeed_mm_s = 300.0\n", "limits.speed_mm_s"),
        ("[limits]\ntrip_n = 70.0\n", "limits"),
        ("[limits]\nleast_y_mm = 10.0\nmost_y_mm = -10.0\n", "limits"),
        ("[limits]\nspeed = 1.0\n", "limits.speed"),
        ("[mounting]\npayload_kg = -1.0\n", "mounting.payload_kg"),
        ("[serials]\ncamera = 'x'\n", "serials.camera"),
        ("[melfa]\nidle_check_s = -1.0\n", "melfa.idle_check_s"),
        ("piece = 3\n", "piece"),
    ],
)
def test_a_bad_value_names_file_key_and_reason(tmp_path, text, key):
    top, tables = (text, "") if text.startswith("piece") else ("", text)
    path = written(tmp_path, HEAD.format(kind="hardware") + top + tables)
    with pytest.raises(InputError, match=re.escape(f"'{key}'")) as caught:
        load_lab(path)
    assert caught.value.where == str(path)
    assert caught.value.fix


def test_an_order_of_limits_that_makes_no_sense_names_both(tmp_path):
    text = HEAD.format(kind="hardware") + "[limits]\njog_mm_s = 60.0\n"
    with pytest.raises(InputError, match="'jog_mm_s' is above 'speed_mm_s'"):
        load_lab(written(tmp_path, text))


def test_an_emulated_bench_cannot_call_itself_hardware(tmp_path):
    with pytest.raises(InputError, match=r"declared hardware.*arm is on this computer"):
        load_lab(written(tmp_path, HEAD.format(kind="hardware") + EMULATED))


@pytest.mark.parametrize(
    ("given", "real", "key"),
    [
        ('host = "127.0.0.1"', 'host = "192.168.0.20"', "melfa.host"),
        ('host = "localhost"', 'host = "gripper.lab"', "wsg.host"),
        ("socket://127.0.0.1:4000", "/dev/ttyUSB0", "ft.address"),
        ("socket://127.0.0.1:4000", "udp://192.168.1.1:49152", "ft.address"),
        ("/srv/bench/by-id", "/dev/v4l/by-id", "gelsight.by_id"),
    ],
)
def test_no_real_device_is_called_emulated(tmp_path, given, real, key):
    text = HEAD.format(kind="emulated") + EMULATED
    assert load_lab(written(tmp_path, text)).facts.mode == "emulated"
    with pytest.raises(InputError, match=re.escape(f"'{key}' is not the address")):
        load_lab(written(tmp_path, text.replace(given, real)))


def test_where_cameras_of_other_makes_are_is_not_asked(tmp_path):
    text = (HEAD.format(kind="emulated") + EMULATED).replace("/srv/bench/by-id", "/dev/v4l/by-id")
    text = text.replace("[gelsight]", '[gelsight]\ndriver = "lerobot"')
    assert load_lab(written(tmp_path, text)).settings.gelsight.driver == "lerobot"


def test_a_folder_in_memory_is_no_device(tmp_path):
    """A folder for temporary files may be below /dev/shm."""
    for given, real in (("socket://127.0.0.1:4000", "/dev/shm/b/ft"), ("/srv/", "/dev/shm/")):
        text = (HEAD.format(kind="emulated") + EMULATED).replace(given, real)
        assert real in text
        assert load_lab(written(tmp_path, text)).facts.mode == "emulated"


def test_facts_follow_the_sensors_and_not_their_addresses(tmp_path):
    def facts(more):
        return load_lab(written(tmp_path, HEAD.format(kind="hardware") + more)).facts

    plain = facts("")
    named = '[gelsight]\nleft = { gel = "A-1" }\n'
    assert (facts(named).sha256, facts(named).gels) == (plain.sha256, ("A-1", ""))
    labs = [load_lab(written(tmp_path, HEAD.format(kind="hardware") + t)).identity
            for t in ("", named, named.replace("A-1", "B"))]  # fmt: skip
    assert labs[0].sha256 == plain.sha256
    assert len({lab.sha256 for lab in labs}) == 3, "a certificate names the gels, if known"
    assert facts('[melfa]\nhost = "10.0.0.7"\n[limits]\nprobe_n = 20.0\n') == plain
    assert facts("[gelsight]\nmm_per_px_x = 0.06\n").sha256 != plain.sha256
    assert facts("[mounting]\nsensor_height_mm = 90.0\n").ft_frame != plain.ft_frame
    assert plain.mm_per_px == pytest.approx((0.05885, 0.05885))


TEMPLATE = (BENCHES / "lab.toml").read_text("utf-8")


@pytest.fixture
def path(tmp_path):
    return written(tmp_path, TEMPLATE)


def differing(before, after):
    return [(a, b) for a, b in zip(before.splitlines(), after.splitlines(), strict=True) if a != b]


def test_values_change_where_they_stand_and_comments_stay(path):
    wanted = {
        "ft.driver": "bota",
        "ft.address": "/dev/serial/by-id/a # b",
        "gelsight.left.serial": "2D8Y-69GR",
        "wsg.host": "10.0.0.7",
        "serials.gripper": "12345",
    }
    assert save_lab(path, wanted)
    settings = load_lab(path).settings
    assert (settings.ft.driver, settings.ft.address) == ("bota", "/dev/serial/by-id/a # b")
    assert settings.gelsight.left.serial == "2D8Y-69GR"
    assert settings.gelsight.right.serial == "FILL-IN2"
    assert (settings.wsg.host, settings.serials.gripper) == ("10.0.0.7", "12345")
    changed = differing(TEMPLATE, path.read_text("utf-8"))
    assert len(changed) == len(wanted)
    kept = [old.rpartition("#")[2] for old, new in changed if "#" in old]
    assert kept == [new.rpartition("#")[2] for old, new in changed if "#" in old]
    assert len(kept) == 2


def test_keys_and_tables_that_are_missing_are_added(path):
    assert save_lab(path, {"melfa.driver": "ur", "melfa.r3.port": 10003, "wsg.port": 1001})
    settings = load_lab(path).settings
    assert (settings.melfa.driver, settings.melfa.r3.port) == ("ur", 10003)
    assert settings.wsg.port == 1001
    before, after = tomllib.loads(TEMPLATE), tomllib.loads(path.read_text("utf-8"))
    assert {key: after[key] for key in before if key not in ("melfa", "wsg")} == {
        key: value for key, value in before.items() if key not in ("melfa", "wsg")
    }


def test_a_lab_file_with_settings_that_were_removed_still_opens(path):
    text = TEMPLATE.replace("trip_n = 40.0", "press_n = 25.0\ntrip_n = 40.0")
    path.write_text(f"{text}\n[bota]\nquiet_in_config = false\nsinc = 128\n", "utf-8")
    assert load_lab(path).settings.bota.sinc == 128
    monitor = {"type_robmon": 902, "type_pose": 903, "type_joint": 904, "type_force": 901}
    force_control = {"limited_stiffness_mode": 4, "off_on_reset": False}
    melfa = {"mxt_in_fsc": True, "monitor": monitor, "mxt": {"lost_limit": 7}, "fsc": force_control}
    melfa |= {"flags": [4, 2, 1], "force_variable_text": "(.+)"}
    wsg = {"bad_crc_reply": "none", "grasp_force_parameter": False, "temperature": "i16, 0.1 degC"}
    tables = {"melfa": melfa, "wsg": wsg, "netft": {"onrobot_commands": [130, 131]}}
    assert HardwareSettings.model_validate(tables).melfa.monitor.type_force == 901


def test_what_is_the_same_is_not_written(path):
    before = path.stat().st_mtime_ns
    assert not save_lab(path, {"ft.driver": "dynpick"})
    assert path.stat().st_mtime_ns == before


@pytest.mark.parametrize(
    ("values", "key"),
    [({"wsg.port": 70000}, "wsg.port"), ({"melfa.host": "127.0.0.1"}, "melfa.host")],
)
def test_what_could_not_be_used_changes_nothing(path, values, key):
    with pytest.raises(InputError) as refused:
        save_lab(path, values)
    assert key in refused.value.what + refused.value.fix
    assert path.read_text("utf-8") == TEMPLATE


def test_a_file_that_is_not_understood_is_left_to_its_author():
    strange = '"ft" = { "driver" = "bota" }\n'
    with pytest.raises(InputError, match="not supported"):
        edit_toml(strange, {"ft.driver": "dynpick"}, "lab.toml")


@pytest.fixture
def session(tmp_path):
    text = TEMPLATE.replace("probe_n = 30.0", "probe_n = 20.0")
    path = written(tmp_path, text.replace('piece = "pot"', 'piece = "mushroom"'))
    made = lab_session(LabChoice(path), keep=RecordingOptions(tmp_path / "runs"))
    yield made
    made.close()


def test_it_is_called_by_its_name_and_knows_its_limits(session, tmp_path):
    told = session.name, session.description.mode, session.simulated
    assert told == ("My lab", "hardware", False)
    assert session.interlock.limits.probe_n == 20.0
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
    path = written(tmp_path, TEMPLATE.replace('bottom = "short"', 'bottom = "moon"'))
    with pytest.raises(InputError, match="moon"):
        lab_session(LabChoice(path))


@pytest.mark.promise("C6")
@pytest.mark.parametrize("days", [1, 400])
def test_a_file_with_the_cameras_exchanged_is_told_and_the_calibration_counts(path, tmp_path, days):
    """An expired calibration still holds for the assignment of the cameras."""
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
    checks = list(islice(lab_checks(path), 3))
    assert [check.word for check in checks] == ["OK", "NOTE", "NOTE"]
    assert notices["tactile_left"] == f"{checks[2].detail}. {checks[2].fix}".removesuffix(".")
    assert "run 'touchdown calibrate camera --bench" in notices["tactile_left"]
    with lab_session(LabChoice(path, window=True), keep=RecordingOptions(None)) as seen:
        notice = seen.connection.notices["tactile_left"]
        assert notice.endswith("measure Tactile cameras in Calibrate (Ctrl+Shift+K)")
        assert "Calibrate (Ctrl+Shift+K)" in seen.calibrations.status("board", {}).fix
