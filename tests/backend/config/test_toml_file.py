"""Settings of real devices: documented with their defaults, and bad ones are refused."""

from __future__ import annotations

import json
import math
import re
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Literal, get_args, get_origin

import pytest

from touchdown.backend.calibration.records import CalibrationValue
from touchdown.backend.config.bench_description import BenchDescription
from touchdown.backend.config.hardware import PLACEHOLDERS, HardwareSettings
from touchdown.backend.config.lab import LabSettings
from touchdown.backend.config.method import ProbeSettings, Settings, StackSettings, TrainingSettings
from touchdown.backend.config.simulation import PRESETS, SimulationSettings, load_simulation
from touchdown.backend.config.toml_file import MAX_BYTES, parse_settings, read_settings
from touchdown.backend.core.faults import InputError
from touchdown.backend.emulation.fault_plan import PlannedFault
from touchdown.backend.geometry.pieces import (
    CircleFace,
    PieceFile,
    PolygonFace,
    RectangleFace,
    RegularFace,
    SquareFace,
)

DOCUMENT = Path(__file__).resolve().parents[3] / "docs" / "hardware.md"


def leaves(settings, prefix=""):
    for name in type(settings).model_fields:
        value = getattr(settings, name)
        if isinstance(value, Settings):
            yield from leaves(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def printed(value):
    if isinstance(value, str):
        return value
    if isinstance(value, dict):
        return "first that exists"
    return "unset" if value is None else json.dumps(value)


def test_the_document_lists_every_setting_with_its_default():
    rows = re.findall(r"^\| `([a-z0-9_.]+)` \| `(.*?)` \| (.+) \|$", DOCUMENT.read_text(), re.M)
    wanted = {key: printed(value) for key, value in leaves(HardwareSettings())}
    assert {key: default for key, default, _ in rows} == wanted


def test_placeholders_are_called_so():
    text = DOCUMENT.read_text()
    named = re.findall(r"^\| `([a-z0-9_.]+)` \| `.+?` \| placeholder:", text, re.M)
    assert named == list(PLACEHOLDERS)


@pytest.mark.parametrize(
    ("content", "key"),
    [
        ({"melfa": {"mxt": {"step_fraction": 1.5}}}, "melfa.mxt.step_fraction"),
        ({"melfa": {"override_start": 0}}, "melfa.override_start"),
        ({"ft": {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]}}, "ft.rotation"),
        ({"ft": {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}}, "ft.rotation"),
        ({"ft": {"sign": 0}}, "ft.sign"),
        ({"optoforce": {"counts": [1, 2, 3, 4, 5, 0]}}, "optoforce.counts.5"),
        ({"wsg": {"strok_mm": 60}}, "wsg.strok_mm"),
    ],
)
def test_a_bad_value_names_its_key(content, key):
    with pytest.raises(InputError, match=re.escape(f"'{key}'")):
        parse_settings(HardwareSettings, content, "lab.toml")


BAD_NUMBERS = (math.nan, math.inf, -math.inf, 1e300, -1e300, True, "1")
CONTACT = {"roles": ["top"], "title": "x", "height_mm": 50.0, "com_height_mm": 20.0,
           "mass_g": 1.0, "grip_height_mm": 30.0}  # fmt: skip


def filled(kind, value):
    """Return ``value`` in the shape of the annotation ``kind``; None if it holds no number."""
    if kind in (int, float):
        return value
    arguments = [a for a in get_args(kind) if a is not type(None)]
    if get_origin(kind) is Literal:
        return value if {type(a) for a in arguments} <= {int, float} else None
    if get_origin(kind) is Annotated:
        return filled(arguments[0], value)
    if get_origin(kind) is tuple:
        shape = [filled(a, value) for a in arguments if a is not Ellipsis]
        return None if None in shape else shape
    # A text may stand for a number, as "unknown" does for a centre of mass.
    arguments = [a for a in arguments if get_origin(a) is not Literal or filled(a, value)]
    return filled(arguments[0], value) if len(arguments) == 1 else None


def numbers(model, value):
    """Yield (path, content) with ``value`` at each numeric field of ``model``."""
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, Settings):
            for path, content in numbers(field.annotation, value):
                yield f"{name}.{path}", {name: content}
        elif (bad := filled(field.annotation, value)) is not None:
            yield name, {name: bad}


MODELS = {
    "method": (StackSettings, {}, 43),
    "training": (TrainingSettings, {}, 8),
    "simulation": (SimulationSettings, {}, 45),
    "lab": (LabSettings, {"version": 1, "name": "x", "kind": "hardware"}, 100),
    "bench": (BenchDescription, {}, 2),
    "piece": (PieceFile, {**CONTACT, "face": {"shape": "circle", "diameter_mm": 9.0}}, 6),
    "calibration": (CalibrationValue, {"value": 1.0, "sigma": 1.0, "unit": "mm"}, 2),
    "fault": (PlannedFault, {"at_s": 1.0, "device": "arm", "kind": "alarm"}, 6),
    "circle": (CircleFace, {"shape": "circle"}, 1),
    "square": (SquareFace, {"shape": "square"}, 1),
    "rectangle": (RectangleFace, {"shape": "rectangle", "x_mm": 1.0, "y_mm": 1.0}, 2),
    "regular": (RegularFace, {"shape": "regular", "sides": 5, "across_corners_mm": 9.0}, 3),
    "polygon": (PolygonFace, {"shape": "polygon"}, 1),
}


@pytest.mark.promise("D8")
@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("value", BAD_NUMBERS)
def test_no_number_of_any_file_is_of_another_type_or_beyond_reason(name, value):
    model, base, least = MODELS[name]
    tried = list(numbers(model, value))
    assert len(tried) >= least
    for path, content in tried:
        with pytest.raises(InputError) as refused:
            parse_settings(model, {**base, **content}, "file")
        assert re.search(rf"'{path}[.']", refused.value.what), path


def test_switches_are_true_or_false_and_integers_may_stand_for_decimals():
    for content in ({"slip": 1}, {"slip": "true"}, {"hysteresis": 0.0}):
        with pytest.raises(InputError, match="grasp"):
            parse_settings(SimulationSettings, {"grasp": content}, "file")
    settings = parse_settings(StackSettings, {"probe": {"depth_mm": 2}}, "file")
    assert (settings.probe.depth_mm, type(settings.probe.depth_mm)) == (2.0, float)


def test_a_turned_sensor_is_accepted():
    content = {"ft": {"rotation": [[0, -1, 0], [1, 0, 0], [0, 0, 1]], "sign": -1}}
    assert parse_settings(HardwareSettings, content, "lab.toml").ft.rotation[0] == (0.0, -1.0, 0.0)


METHOD = partial(read_settings, StackSettings)


def _write(tmp_path, text):
    path = tmp_path / "bench.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_values_are_taken_and_the_rest_is_default(tmp_path):
    settings = read_settings(
        StackSettings, _write(tmp_path, 'strategy = "pick-and-place"\n[probe]\ndepth_mm = 1.0\n')
    )
    assert settings.strategy == "pick-and-place"
    assert settings.probe.depth_mm == 1.0
    assert settings.probe.ramp_fraction == ProbeSettings().ramp_fraction


def test_an_empty_file_is_the_paper(tmp_path):
    settings = read_settings(StackSettings, _write(tmp_path, ""))
    assert settings == StackSettings()
    assert (settings.probe.depth_mm, settings.probe.duration_s) == (1.5, 2.0)
    assert settings.probe.stiffness_n_mm == (30.0, 30.0, 15.0)
    assert (settings.stability.delta, settings.policy.longest_step_mm) == (0.9, 3.0)


@pytest.mark.parametrize(
    ("read", "text", "key"),
    [
        (METHOD, "[probe]\ndepth_mm = -1.0\n", "probe.depth_mm"),
        (METHOD, '[probe]\ndepth_mm = "deep"\n', "probe.depth_mm"),
        (METHOD, "[probe]\nstiffness_n_mm = [30.0, 30.0]\n", "probe.stiffness_n_mm"),
        (METHOD, "[stability]\ndelta = 1.0\n", "stability.delta"),
        (METHOD, "[policy]\nmax_probes = 0\n", "policy.max_probes"),
        (METHOD, 'strategy = "hope"\n', "strategy"),
        (METHOD, "[probe]\ndepth = 1.0\n", "probe.depth"),
        (METHOD, "probe = 3\n", "probe"),
        (load_simulation, 'preset = "loud"', "preset"),
        (load_simulation, "[grasp]\nshear_n_mm = -1", "grasp.shear_n_mm"),
        (load_simulation, "[tactile]\nwhite = 1", "tactile.white"),
    ],
)
def test_the_error_names_file_and_key(tmp_path, read, text, key):
    path = _write(tmp_path, text)
    with pytest.raises(InputError) as caught:
        read(path)
    assert caught.value.where == str(path)
    assert f"'{key}" in caught.value.what
    assert caught.value.fix


@pytest.mark.parametrize(
    ("text", "said", "fix"),
    [
        ("[ft]\nrate = 3", "There is no setting 'ft.rate'.", "'ft.rate_hz'"),
        ("[gelsigt.left]", "There is no setting 'gelsigt'.", "'gelsight'"),
        ("[ft]\nzzz = 3", "There is no setting 'ft.zzz'.", "Remove 'ft.zzz'."),
    ],
)
def test_a_setting_that_nobody_knows_is_called_so_with_the_nearest_one(tmp_path, text, said, fix):
    with pytest.raises(InputError) as caught:
        read_settings(HardwareSettings, _write(tmp_path, text))
    assert caught.value.what == said
    assert fix in caught.value.fix


def test_broken_toml_names_the_line(tmp_path):
    path = _write(tmp_path, "[probe]\ndepth_mm = = 1\n")
    with pytest.raises(InputError, match="line 2") as caught:
        read_settings(StackSettings, path)
    assert caught.value.where == str(path)


def test_a_missing_file_a_folder_and_wrong_bytes_are_named(tmp_path):
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe\x00\x01")
    for path in (tmp_path / "missing.toml", tmp_path, binary):
        with pytest.raises(InputError) as caught:
            read_settings(StackSettings, path)
        assert caught.value.where == str(path)


@pytest.mark.promise("D8")
def test_a_huge_file_is_refused_unread(tmp_path):
    path = tmp_path / "huge.toml"
    with path.open("wb") as file:
        file.truncate(MAX_BYTES + 1)
    with pytest.raises(InputError, match="too large"):
        read_settings(StackSettings, path)


def test_settings_cannot_be_changed_later():
    settings = parse_settings(StackSettings, {}, "test")
    with pytest.raises(ValueError, match="frozen"):
        settings.probe.depth_mm = 9.0


BENCHES = Path(str(files("touchdown.resources"))) / "benches"


def test_shipped_default_spells_out_the_defaults():
    assert load_simulation(BENCHES / "sim.toml") == SimulationSettings()


def test_every_preset_is_named_and_a_shipped_file_is_its_preset():
    for name in PRESETS:
        assert load_simulation(preset=name).preset == name
    for name, file in (("quiet", "sim-quiet"), ("hard", "sim-hard"), ("bench-v1", "bench-v1")):
        assert load_simulation(BENCHES / f"{file}.toml") == load_simulation(preset=name)


def test_off_leaves_nothing_random():
    off = load_simulation(preset="off")
    assert set(off.spread.model_dump().values()) == {0.0}
    assert off.tactile.white_px == off.wrist.white_n == off.tactile.drop_share == 0.0


def test_own_keys_win_over_the_preset():
    made = SimulationSettings.model_validate(
        {"preset": "hard", "spread": {"tilt_rad": 0.002}, "mu_grip": 0.5}
    )
    assert (made.spread.tilt_rad, made.mu_grip) == (0.002, 0.5)
    assert made.spread.grasp_offset_mm == 1.0


def test_settings_survive_a_round_trip():
    hard = load_simulation(preset="hard")
    assert SimulationSettings.model_validate_json(hard.model_dump_json()) == hard


def test_flat_faces_are_left_out_of_what_identifies_a_bench():
    assert "surface" not in load_simulation(preset="bench-v1").model_dump(mode="json")
    domed = SimulationSettings.model_validate({"surface": {"domed_share": 0.2}})
    assert SimulationSettings.model_validate_json(domed.model_dump_json()) == domed
    assert domed.surface.dome_mm == 200.0


@pytest.mark.parametrize(
    "given",
    [
        {"tilted_share": 0.6, "domed_share": 0.5},
        {"tilt_rad": 0.06},
        {"step_mm": 1.1},
        {"dome_mm": 150},
    ],
)
def test_surfaces_beyond_the_limits_are_refused(given):
    with pytest.raises(InputError):
        parse_settings(SimulationSettings, {"surface": given}, "bench.toml")


def test_a_lab_file_is_not_taken_for_a_simulated_bench(tmp_path):
    lab = tmp_path / "lab.toml"
    lab.write_text('version = 1\nkind = "hardware"\n', "utf-8")
    with pytest.raises(InputError, match="This is a lab file") as refused:
        load_simulation(lab)
    assert refused.value.where == str(lab)
