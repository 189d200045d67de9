"""Bench data of model cards, and evaluations on hardware probes."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.training_set import load_training_set
from touchdown.backend.annotations.values import EpisodeContext, Label
from touchdown.backend.cli.command_line import main
from touchdown.backend.config.bench_description import BenchDescription, describe_simulation
from touchdown.backend.config.simulation import SimulationSettings
from touchdown.backend.core.values import Episode, EpisodeQuality
from touchdown.backend.episodes.training_rows import split_rows
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.learning.fitting import hardware_rows
from touchdown.backend.learning.registry import ModelRegistry
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
