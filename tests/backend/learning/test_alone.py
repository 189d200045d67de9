"""Clearance of a model for autonomous use on a bench, field by field."""

import os
from pathlib import Path

import pytest

from touchdown.backend.bench.assembly import (
    BenchModels,
    SimulatedBenchChoice,
    model_in_use,
    simulated_session,
)
from touchdown.backend.config.bench_description import BenchDescription, describe_simulation
from touchdown.backend.config.simulation import SimulationSettings
from touchdown.backend.core.faults import InputError
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.learning.checkpoint import (
    ModelCard,
    load_card,
    load_checkpoint,
    save_checkpoint,
)
from touchdown.backend.learning.registry import (
    HARDWARE_PROBES,
    ModelRegistry,
    card_mismatches,
    check_autonomous,
)
from touchdown.backend.runs.recorder import RecordingOptions
from touchdown.backend.runs.requests import SceneChoice, StackRequest

HERE = describe_simulation(SimulationSettings())
LAB = BenchDescription(
    mode="hardware", sha256="c" * 64, mm_per_px=(0.0581, 0.0581), ft_frame="flange"
)


@pytest.fixture
def card() -> ModelCard:
    shipped = load_card(model_in_use("pot", None))
    return shipped.model_copy(update={"benches": (HERE,)})


def fields(card: ModelCard, bench: BenchDescription, probes: int = 0, piece: str = "") -> list[str]:
    found = card_mismatches(card, bench, piece or card.geometry, 1.0, probes)
    return [one.field for one in found]


def test_the_bench_it_was_trained_on_fits(card: ModelCard) -> None:
    assert fields(card, HERE) == []


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"mm_per_px": (0.058, 0.066)}, ["mm/px"]),
        ({"ft_frame": "flange"}, ["F/T frame"]),
        ({"sha256": "d" * 64}, ["bench hash"]),
    ],
)
def test_a_difference_is_named(
    card: ModelCard, change: dict[str, object], named: list[str]
) -> None:
    assert fields(card, HERE.model_copy(update=change)) == named


def test_piece_and_grid_are_named(card: ModelCard) -> None:
    assert fields(card, HERE, piece="e" * 64) == ["piece hash"]
    assert fields(card.model_copy(update={"grid_mm": 0.5}), HERE) == ["grid"]


def test_what_nobody_told_is_no_difference(card: ModelCard) -> None:
    assert fields(card.model_copy(update={"benches": ()}), HERE) == []
    assert fields(card, BenchDescription(mode="simulated")) == []


def test_any_bench_of_the_training_data_fits(card: ModelCard) -> None:
    other = HERE.model_copy(update={"mm_per_px": (0.07, 0.07), "sha256": "d" * 64})
    both = card.model_copy(update={"benches": (HERE, other)})
    assert fields(both, HERE) == fields(both, other) == []


def test_simulation_alone_needs_hardware_probes(card: ModelCard) -> None:
    lab = LAB.model_copy(update={"mm_per_px": HERE.mm_per_px, "ft_frame": HERE.ft_frame})
    assert fields(card, lab, HARDWARE_PROBES - 1) == ["bench mode"]
    assert fields(card, lab, HARDWARE_PROBES) == []
    assert fields(card, LAB, HARDWARE_PROBES) == ["mm/px", "F/T frame"]
    with pytest.raises(InputError, match="49 of 50 hardware probes evaluated"):
        check_autonomous(card, card_mismatches(card, lab, card.geometry, 1.0, 49), "model")


def test_a_model_of_real_probes_is_no_model_of_the_simulation(card: ModelCard) -> None:
    real = card.model_copy(update={"simulated": False, "benches": (LAB,)})
    assert fields(real, HERE)[0] == "bench mode"


def test_noise_is_no_part_of_the_bench_hash() -> None:
    quiet = describe_simulation(SimulationSettings.model_validate({"preset": "quiet"}))
    assert quiet == HERE
    turned = SimulationSettings.model_validate({"wrist": {"yaw_rad": 0.1}})
    assert describe_simulation(turned).sha256 != HERE.sha256


def test_auto_is_refused_and_step_is_not(tmp_path: Path, card: ModelCard) -> None:
    checkpoint = load_checkpoint(model_in_use("pot", None))
    other = card.model_copy(update={"benches": (HERE.model_copy(update={"ft_frame": "flange"}),)})
    model = tmp_path / "pot.safetensors"
    save_checkpoint(model, checkpoint.arrays, other)
    piece, request = load_pieces().piece("pot"), StackRequest(model=str(model))
    models = BenchModels(None, HERE, 1.0)
    with pytest.raises(InputError, match="auto mode here: F/T frame"):
        models.check(request.scene(), piece)
    assert models.check(StackRequest(model=str(model), mode="step").scene(), piece) is not None
    session = simulated_session(SimulatedBenchChoice(preset="off"), keep=RecordingOptions(None))
    with pytest.raises(InputError, match="F/T frame"):
        session.run(request)
    session.close()


def test_the_session_takes_the_model_in_use(tmp_path: Path, card: ModelCard) -> None:
    checkpoint = load_checkpoint(model_in_use("pot", None))
    arrays = {**checkpoint.arrays, "head.bias": checkpoint.arrays["head.bias"] + 1}
    model = tmp_path / "pot.safetensors"
    mine = save_checkpoint(model, arrays, card)
    registry = ModelRegistry(tmp_path / "models")
    models, piece = BenchModels(registry, HERE, 1.0), load_pieces().piece("pot")

    def in_use() -> str:
        loaded = models.of(SceneChoice(), piece)
        assert loaded is not None
        return loaded.card.weights_sha256

    assert in_use() == card.weights_sha256
    registry.promote(model)
    assert in_use() == mine.weights_sha256
    registry.roll_back("pot")
    assert in_use() == card.weights_sha256
    # A run that began keeps the model it was checked and is recorded with.
    models.check(SceneChoice(), piece)
    registry.promote(model)
    assert in_use() == card.weights_sha256
    models.check(SceneChoice(), piece)
    assert in_use() == mine.weights_sha256


@pytest.mark.parametrize("named", [False, True], ids=["promoted", "named"])
def test_a_run_keeps_its_model_though_the_file_is_damaged_and_the_next_is_refused(
    named: bool, tmp_path: Path, card: ModelCard
) -> None:
    checkpoint = load_checkpoint(model_in_use("pot", None))
    arrays = {**checkpoint.arrays, "head.bias": checkpoint.arrays["head.bias"] + 1}
    model, registry = tmp_path / "pot.safetensors", ModelRegistry(tmp_path / "models")
    mine = save_checkpoint(model, arrays, card)
    registry.promote(model)
    file = model if named else registry.in_use("pot")
    assert file is not None
    choice = SceneChoice(model=str(model) if named else None)
    models, piece = BenchModels(registry, HERE, 1.0), load_pieces().piece("pot")
    checked = models.check(choice, piece)
    assert checked is not None
    good = file.read_bytes()
    file.write_bytes(good[:-8] + bytes(8))
    os.utime(file, ns=(1, 1))
    assert models.of(choice, piece) is checked, "the trials of the run that goes on"
    with pytest.raises(InputError, match="damaged or not those of their card") as refused:
        models.check(choice, piece)
    assert (refused.value.where, bool(refused.value.fix)) == (str(file), True)
    if not named:
        registry.roll_back("pot")
        shipped = models.check(choice, piece)
        assert shipped is not None
        assert shipped.card.weights_sha256 == card.weights_sha256
        return
    # Another model that was put in its place is read, and not the one in memory.
    other = save_checkpoint(file, checkpoint.arrays, card)
    os.utime(file, ns=(2, 2))
    again = models.check(choice, piece)
    assert again is not None
    assert again.card.weights_sha256 == other.weights_sha256 != mine.weights_sha256
