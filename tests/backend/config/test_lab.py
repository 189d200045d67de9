"""Lab files: each version is read, a bad one names its key, and kind and addresses must agree."""

import re
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path

import pytest

from touchdown.backend.config.lab import (
    LAB_FILE_VERSION,
    LabSettings,
    LimitSettings,
    is_lab_file,
    load_lab,
)
from touchdown.backend.core.faults import InputError
from touchdown.backend.devices.interlock import Limits

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
    assert lab.settings.limits == LimitSettings()


def test_lab_files_and_simulated_benches_are_told_apart():
    found = {path.name: is_lab_file(path) for path in BENCHES.glob("*.toml")}
    assert [name for name, lab in found.items() if lab] == ["lab.toml"]


def test_the_limits_of_the_file_are_those_of_the_interlock():
    assert LimitSettings().model_dump() == asdict(Limits())


@pytest.mark.parametrize("version", [LAB_FILE_VERSION + 1, 0, -1, '"1"', "true"])
def test_a_version_that_nobody_knows_is_refused(tmp_path, version):
    path = written(tmp_path, f'version = {version}\nname = "x"\nkind = "hardware"\n')
    with pytest.raises(InputError, match="'version'") as caught:
        load_lab(path)
    assert caught.value.where == str(path)


def test_a_file_without_a_version_is_refused(tmp_path):
    with pytest.raises(InputError, match="'version': None"):
        load_lab(written(tmp_path, "[ft]\nsign = -1\n"))


@pytest.mark.promise("D8")
@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("[limits]\nspeed_mm_s = 300.0\n", "limits.speed_mm_s"),
        ("[limits]\nleast_x_mm = nan\n", "limits.least_x_mm"),
        ("[limits]\ntrip_n = 70.0\n", "limits"),
        ("[limits]\nleast_y_mm = 10.0\nmost_y_mm = -10.0\n", "limits"),
        ("[limits]\nspeed = 1.0\n", "limits.speed"),
        ("[mounting]\npayload_kg = -1.0\n", "mounting.payload_kg"),
        ("[serials]\ncamera = 'x'\n", "serials.camera"),
        ("[melfa]\nflags = [4, 4, 1]\n", "melfa.flags"),
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
    assert facts('[melfa]\nhost = "10.0.0.7"\n[limits]\npress_n = 20.0\n') == plain
    assert facts("[gelsight]\nmm_per_px_x = 0.06\n").sha256 != plain.sha256
    assert facts("[mounting]\nsensor_height_mm = 90.0\n").ft_frame != plain.ft_frame
    assert plain.mm_per_px == pytest.approx((0.05885, 0.05885))


def test_every_table_of_devices_can_stand_in_a_lab_file():
    assert {"melfa", "wsg", "ft", "gelsight"} <= LabSettings.model_fields.keys()
