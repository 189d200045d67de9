"""Settings of real devices: documented with their defaults, and bad ones are refused."""

import json
import re
from pathlib import Path

import pytest

from touchdown.backend.config.hardware import PLACEHOLDERS, HardwareSettings
from touchdown.backend.config.method import Settings
from touchdown.backend.config.toml_file import parse_settings
from touchdown.backend.core.faults import InputError

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
        ({"melfa": {"flags": [4, 4, 1]}}, "melfa.flags"),
        ({"melfa": {"force_variable_text": "("}}, "melfa.force_variable_text"),
        ({"melfa": {"force_variable_text": "(a)(b)"}}, "melfa.force_variable_text"),
        ({"melfa": {"override_start": 0}}, "melfa.override_start"),
        ({"ft": {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]}}, "ft.rotation"),
        ({"ft": {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}}, "ft.rotation"),
        ({"ft": {"rotation": [[float("nan"), 0, 0], [0, 1, 0], [0, 0, 1]]}}, "ft.rotation"),
        ({"ft": {"sign": 0}}, "ft.sign"),
        ({"wsg": {"grasp_force_parameter": True}}, "wsg.grasp_force_parameter"),
        ({"optoforce": {"counts": [1, 2, 3, 4, 5, 0]}}, "optoforce.counts.5"),
        ({"wsg": {"strok_mm": 60}}, "wsg.strok_mm"),
    ],
)
def test_a_bad_value_names_its_key(content, key):
    with pytest.raises(InputError, match=re.escape(f"'{key}'")):
        parse_settings(HardwareSettings, content, "lab.toml")


def test_a_turned_sensor_is_accepted():
    content = {"ft": {"rotation": [[0, -1, 0], [1, 0, 0], [0, 0, 1]], "sign": -1}}
    assert parse_settings(HardwareSettings, content, "lab.toml").ft.rotation[0] == (0.0, -1.0, 0.0)
