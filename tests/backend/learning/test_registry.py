"""Bench data of model cards, and evaluations on hardware probes."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from touchdown.backend.annotations import Dataset, EpisodeContext, Label, load_training_set
from touchdown.backend.cli.command_line import main
from touchdown.backend.config import BenchDescription, SimulationSettings, describe_simulation
from touchdown.backend.core import Episode, EpisodeQuality, InputError
from touchdown.backend.episodes.training_rows import split_rows
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.learning.checkpoint import ModelCard, load_checkpoint, save_checkpoint
from touchdown.backend.learning.fitting import hardware_rows
from touchdown.backend.learning.inference import ARCH, NetworkShape, expected_arrays
from touchdown.backend.learning.registry import (
    ENSEMBLES,
    HISTORY,
    SHIPPED_MODEL,
    ModelRegistry,
    models_below,
)
from touchdown.backend.learning.training_data import only_simulated, read_benches, training_manifest
from touchdown.backend.runs.recorder import models_folder

HERE = describe_simulation(SimulationSettings())
LAB = BenchDescription(mode="hardware", sha256="c" * 64, mm_per_px=(0.06, 0.06), ft_frame="flange")


def fill(folder: Path, benches: list[tuple[str, BenchDescription]], each: int = 3) -> Path:
    """Write a dataset with one mounting a bench, its labels waiting for review."""
    catalogue, rng = load_pieces(), np.random.default_rng(2)
    quality = EpisodeQuality(True, (), 0, 0.0, 0, 5.0, 0.01)
    with Dataset.open(folder, person="setup") as dataset:
        pair = dataset.geometry.store_pair(catalogue.piece("pot"), catalogue.piece("circle15"))
        for number, (mode, facts) in enumerate(benches):
            context = EpisodeContext(
                "series", "circle15", pair, "setup", f"g{number}", f"m{number}", mode=mode,
                bench={"facts": facts.model_dump_json()},
            )  # fmt: skip
            for _ in range(each):
                seen = rng.normal(size=(20, 258)).astype(np.float32)
                episode = Episode("e", "pot", seen, rng.normal(0, 4, 2), 1.0, quality, None)
                entry = dataset.record(
                    episode, Label(500, 0, 0, 300), source="commanded", context=context
                )
                dataset.labels.accept("setup", entry.uuid)
    return folder


def test_the_benches_of_a_dataset_are_told(tmp_path: Path) -> None:
    folder = fill(tmp_path / "data", [("stepped", HERE), ("lab", LAB), ("lab", LAB)])
    rows = load_training_set(folder, labels="submitted")
    assert set(read_benches(folder, rows)) == {HERE, LAB}
    assert not only_simulated(rows)
    real = hardware_rows(rows)
    assert real is not None
    assert len(real) == 6
    listed = json.loads(training_manifest(rows, split_rows(rows, 0.3, 0)))["episodes"]
    assert len({e["file_sha256"] for e in listed}) == len(rows) == 9
    assert all(e["revision"] for e in listed)
    one_mounting = replace(rows, mounting_id=("m",) * len(rows))
    told = [
        json.loads(training_manifest(r, split_rows(r, 0.3, 0, divide_series=True)))
        for r in (rows, one_mounting)
    ]
    assert "warnings" not in told[0]
    assert told[1]["warnings"][0].startswith("Leakage: 9 episodes share mounting and bottom")


def test_an_imported_episode_is_not_taken_for_a_simulation(tmp_path: Path) -> None:
    folder = fill(tmp_path / "data", [("imported", BenchDescription())])
    rows = load_training_set(folder, labels="submitted")
    assert not only_simulated(rows)
    assert hardware_rows(rows) is None


def test_evaluation_on_hardware_probes_is_kept(tmp_path: Path, capsys) -> None:
    from touchdown.backend.bench.assembly import shipped_model
    from touchdown.backend.learning.checkpoint import load_card

    model = shipped_model("pot")
    sha256, registry = load_card(model).weights_sha256, ModelRegistry(models_folder())
    simulated = fill(tmp_path / "simulated", [("stepped", HERE)])
    assert main(["evaluate", str(model), str(simulated), "--labels", "submitted", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["hardware_probes"] == 0
    assert registry.hardware_probes(sha256) == 0
    mixed = fill(tmp_path / "mixed", [("stepped", HERE), ("lab", LAB)], each=5)
    assert main(["evaluate", str(model), str(mixed), "--labels", "submitted", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["hardware_probes"] == 5
    assert registry.hardware_probes(sha256) == 5


Make = Callable[[str, int], Path]


@pytest.fixture
def make(tmp_path: Path) -> Make:
    def made(piece: str, seed: int) -> Path:
        shape = NetworkShape(6, 2, 1, 3)
        rng = np.random.default_rng(seed)
        arrays = {
            name: rng.uniform(0.5, 1.0, size).astype(np.float32)
            for name, size in expected_arrays(shape).items()
        }
        card = ModelCard(
            arch=ARCH, hyper=shape, modality="FT", piece=piece,
            geometry="g",
            base_rate=0.5, seed=seed, program_version="0", weights_sha256="",
        )  # fmt: skip
        path = tmp_path / f"{piece}-{seed}.safetensors"
        save_checkpoint(path, arrays, card)
        return path

    return made


def sha(path: Path | None) -> str:
    assert path is not None
    return load_checkpoint(path).card.weights_sha256


def test_the_shipped_model_is_in_use_until_another_is(tmp_path: Path, make: Make) -> None:
    registry = ModelRegistry(tmp_path / "models")
    assert (registry.in_use("pot"), registry.before("pot"), registry.history()) == (None, None, [])
    one, two = make("pot", 1), make("pot", 2)
    registry.promote(one, "Ann", "run-1")
    registry.promote(two, "Ben", "run-2")
    assert sha(registry.in_use("pot")) == sha(two)
    assert registry.before("pot") == sha(one)
    assert registry.in_use("barrel") is None
    assert registry.roll_back("pot", "Ann").weights_sha256 == sha(one)
    assert registry.roll_back("pot").weights_sha256 == SHIPPED_MODEL
    assert registry.in_use("pot") is None
    with pytest.raises(InputError, match="never changed"):
        registry.roll_back("pot")
    told = [(use.action, use.person, use.run) for use in registry.history("pot")]
    assert told == [
        ("promote", "Ann", "run-1"), ("promote", "Ben", "run-2"),
        ("roll back", "Ann", ""), ("roll back", "", ""),
    ]  # fmt: skip


def test_promoting_what_is_in_use_changes_nothing(tmp_path: Path, make: Make) -> None:
    registry, model = ModelRegistry(tmp_path / "models"), make("pot", 1)
    assert registry.promote(model) == registry.promote(model)
    assert len(registry.history()) == 1


def test_a_model_in_use_survives_its_training_folder(tmp_path: Path, make: Make) -> None:
    registry, model = ModelRegistry(tmp_path / "models"), make("pot", 1)
    wanted = sha(model)
    registry.promote(model)
    model.unlink()
    model.with_suffix(".json").unlink()
    assert sha(registry.in_use("pot")) == wanted


def test_a_damaged_model_is_never_put_in_use(tmp_path: Path, make: Make) -> None:
    registry, model = ModelRegistry(tmp_path / "models"), make("pot", 1)
    model.write_bytes(model.read_bytes()[:-4] + b"\0\0\0\0")
    with pytest.raises(InputError, match="SHA-256"):
        registry.promote(model)
    assert registry.in_use("pot") is None


def test_a_torn_line_of_the_history_is_passed_over(tmp_path: Path, make: Make) -> None:
    registry, one, two = ModelRegistry(tmp_path / "models"), make("pot", 1), make("pot", 2)
    registry.promote(one)
    file = registry.folder / HISTORY
    whole = file.read_bytes()
    file.write_bytes(whole + whole[: len(whole) // 2])
    assert sha(registry.in_use("pot")) == sha(one)
    registry.promote(two)
    assert sha(registry.in_use("pot")) == sha(two)
    assert file.read_bytes().startswith(whole)


@pytest.mark.parametrize(
    "line",
    [
        '{"piece": "../x", "action": "promote", "weights_sha256": "", "at_ns": 1}',
        '{"piece": "pot", "action": "promote", "weights_sha256": "../x", "at_ns": 1}',
        '{"piece": "pot", "action": "forget", "weights_sha256": "", "at_ns": 1}',
        '{"piece": "pot"}',
    ],
)
def test_a_history_made_by_others_names_no_foreign_file(tmp_path: Path, line: str) -> None:
    registry = ModelRegistry(tmp_path)
    (tmp_path / HISTORY).write_text(line + "\n")
    with pytest.raises(InputError, match="damaged"):
        registry.in_use("pot")


def test_hardware_probes_are_counted_per_model(tmp_path: Path) -> None:
    registry = ModelRegistry(tmp_path)
    assert registry.hardware_probes("a") == 0
    registry.note_hardware("a", 20, 0.7, 0.8)
    registry.note_hardware("a", 60, 0.7, 0.8)
    registry.note_hardware("b", 90, 0.7, 0.8)
    assert registry.hardware_probes("a") == 60


def test_several_models_pre_label_together_until_none_is_chosen(tmp_path: Path, make: Make) -> None:
    registry = ModelRegistry(tmp_path / "models")
    assert registry.ensemble("pot") == ()
    make("barrel", 1)
    make("pot", 1), make("pot", 2)
    (tmp_path / "torn.safetensors").write_bytes(b"no model")
    found = models_below(tmp_path, "pot")
    registry.choose_ensemble("pot", found, "Ann")
    chosen = registry.ensemble("pot")
    assert {sha(path) for path in chosen} == {sha(path) for path in found}
    assert len(chosen) == 2
    for path in found:
        path.unlink()
    assert len({sha(path) for path in chosen}) == 2  # copies of its own
    assert registry.in_use("pot") is None
    with pytest.raises(InputError, match="not of 'pot'"):
        registry.choose_ensemble("pot", models_below(tmp_path, "barrel"))
    registry.choose_ensemble("pot", [])
    assert registry.ensemble("pot") == ()


def test_a_list_of_models_made_by_others_names_no_foreign_file(tmp_path: Path) -> None:
    (tmp_path / ENSEMBLES).write_text('{"piece": "pot", "weights_sha256": ["../x"]}\n')
    with pytest.raises(InputError, match="damaged"):
        ModelRegistry(tmp_path).ensemble("pot")
