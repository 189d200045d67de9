"""Editing of a lab file changes the given addresses and nothing else."""

import tomllib
from importlib.resources import files

import pytest

from touchdown.backend.config.lab import edit_toml, load_lab, save_lab
from touchdown.backend.core.faults import InputError

TEMPLATE = files("touchdown.resources").joinpath("benches", "lab.toml").read_text("utf-8")


@pytest.fixture
def path(tmp_path):
    made = tmp_path / "lab.toml"
    made.write_text(TEMPLATE, "utf-8")
    return made


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


def test_what_is_the_same_is_not_written(path):
    before = path.stat()
    assert not save_lab(path, {"ft.driver": "dynpick"})
    assert path.stat() == before


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
