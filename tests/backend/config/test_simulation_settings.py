"""Settings of the simulated bench: presets, overrides, shipped files, bad input."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import pytest

from touchdown.backend.config.simulation import PRESETS, SimulationSettings, load_simulation
from touchdown.backend.core.faults import InputError

BENCHES = Path(str(files("touchdown.resources"))) / "benches"


def test_shipped_default_spells_out_the_defaults() -> None:
    assert load_simulation(BENCHES / "sim.toml") == SimulationSettings()


@pytest.mark.parametrize(
    ("name", "file"), [("quiet", "sim-quiet"), ("hard", "sim-hard"), ("bench-v1", "bench-v1")]
)
def test_shipped_file_is_its_preset(name, file) -> None:
    assert load_simulation(BENCHES / f"{file}.toml") == load_simulation(preset=name)


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_every_preset_is_valid_and_named(name) -> None:
    assert load_simulation(preset=name).preset == name


def test_off_leaves_nothing_random() -> None:
    off = load_simulation(preset="off")
    assert set(off.spread.model_dump().values()) == {0.0}
    assert off.tactile.white_px == off.wrist.white_n == off.tactile.drop_share == 0.0


def test_own_keys_win_over_the_preset() -> None:
    made = SimulationSettings.model_validate(
        {"preset": "hard", "spread": {"tilt_rad": 0.002}, "mu_grip": 0.5}
    )
    assert (made.spread.tilt_rad, made.mu_grip) == (0.002, 0.5)
    assert made.spread.grasp_offset_mm == 1.0


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ('preset = "loud"', "preset"),
        ("[grasp]\nshear_n_mm = -1", "grasp.shear_n_mm"),
        ("[tactile]\nwhite = 1", "tactile.white"),
        ("mu = nan", "mu"),
    ],
)
def test_a_bad_file_is_named_with_its_key(text, key, tmp_path) -> None:
    file = tmp_path / "bench.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        load_simulation(file)
    assert caught.value.where == str(file)
    assert key in caught.value.what


def test_settings_survive_a_round_trip() -> None:
    hard = load_simulation(preset="hard")
    assert SimulationSettings.model_validate_json(hard.model_dump_json()) == hard
