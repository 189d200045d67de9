"""Clearance of a model for autonomous use on a bench, field by field."""

import hashlib
import io
import json
import os
import struct
import time
from contextlib import redirect_stderr, redirect_stdout
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import save_file

from touchdown.backend.bench.assembly import (
    BenchModels,
    SimulatedBenchChoice,
    model_in_use,
    simulated_session,
)
from touchdown.backend.cli.command_line import main
from touchdown.backend.config import BenchDescription, SimulationSettings, describe_simulation
from touchdown.backend.core.faults import InputError
from touchdown.backend.geometry import face_points, load_pieces
from touchdown.backend.learning.checkpoint import (
    ModelCard,
    card_path,
    load_card,
    load_checkpoint,
    parse_arrays,
    save_checkpoint,
    save_half_precision,
)
from touchdown.backend.learning.inference import ARCH, NetworkShape, expected_arrays
from touchdown.backend.learning.registry import (
    HARDWARE_PROBES,
    ModelRegistry,
    card_mismatches,
    check_autonomous,
)
from touchdown.backend.learning.training import load_network, new_model
from touchdown.backend.placement.estimator import Estimator
from touchdown.backend.runs import RecordingOptions, SceneChoice, StackRequest

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


def test_benches_of_the_training_fit_and_unknown_fields_are_no_difference(card: ModelCard) -> None:
    assert fields(card, HERE) == []
    other = HERE.model_copy(update={"mm_per_px": (0.07, 0.07), "sha256": "d" * 64})
    both = card.model_copy(update={"benches": (HERE, other)})
    assert fields(both, HERE) == fields(both, other) == []
    assert fields(card.model_copy(update={"benches": ()}), HERE) == []
    assert fields(card, BenchDescription(mode="simulated")) == []
    assert fields(card, HERE, piece="e" * 64) == ["piece hash"]
    assert fields(card.model_copy(update={"grid_mm": 0.5}), HERE) == ["grid"]


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


def test_simulation_alone_needs_hardware_probes(card: ModelCard) -> None:
    lab = LAB.model_copy(update={"mm_per_px": HERE.mm_per_px, "ft_frame": HERE.ft_frame})
    assert fields(card, lab, HARDWARE_PROBES - 1) == ["bench mode"]
    assert fields(card, lab, HARDWARE_PROBES) == []
    assert fields(card, LAB, HARDWARE_PROBES) == ["mm/px", "F/T frame"]
    with pytest.raises(InputError, match="49 of 50 hardware probes evaluated"):
        check_autonomous(card, card_mismatches(card, lab, card.geometry, 1.0, 49), "model")


def test_a_replaced_gel_is_named_and_evaluations_before_it_do_not_count(tmp_path, card) -> None:
    lab = LAB.model_copy(update={"gels": ("A", "R")})
    real = card.model_copy(update={"simulated": False, "benches": (LAB, lab)})
    assert fields(real, lab) == []
    found = card_mismatches(
        real, lab.model_copy(update={"gels": ("B", "R")}), card.geometry, 1.0, 0
    )
    assert [str(one) for one in found] == ["left gel: the model A, the bench B"]
    assert fields(real, LAB) == []
    registry = ModelRegistry(tmp_path)
    registry.note_hardware("f" * 64, 60, 0.8, 0.9)
    assert registry.hardware_probes("f" * 64) == 60
    assert registry.hardware_probes("f" * 64, time.time_ns() + 10**9) == 0


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


def other_arrays() -> dict[str, np.ndarray]:
    """Weights unlike those of the shipped model."""
    shipped = load_checkpoint(model_in_use("pot", None)).arrays
    return {**shipped, "head.bias": shipped["head.bias"] + 1}


def test_the_session_takes_the_model_in_use(tmp_path: Path, card: ModelCard) -> None:
    model, registry = tmp_path / "pot.safetensors", ModelRegistry(tmp_path / "models")
    mine = save_checkpoint(model, other_arrays(), card)
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
    model, registry = tmp_path / "pot.safetensors", ModelRegistry(tmp_path / "models")
    mine = save_checkpoint(model, other_arrays(), card)
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
    shipped = load_checkpoint(model_in_use("pot", None))
    other = save_checkpoint(file, shipped.arrays, card)
    os.utime(file, ns=(2, 2))
    again = models.check(choice, piece)
    assert again is not None
    assert again.card.weights_sha256 == other.weights_sha256 != mine.weights_sha256


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A small new model with its card."""
    path = tmp_path / "pot.safetensors"
    model = new_model(NetworkShape(6, 8, 2, 5), 4)
    card = ModelCard(
        arch=ARCH, hyper=NetworkShape(6, 8, 2, 5), modality="FT",
        piece="pot", geometry="ab" * 32, base_rate=0.3, seed=4, program_version="0.1.0",
        weights_sha256="",
    )  # fmt: skip
    save_checkpoint(path, model.arrays(), card)
    return path


def reseal(path: Path) -> None:
    """Give the card the hash of the present weights."""
    change_card(path, weights_sha256=hashlib.sha256(path.read_bytes()).hexdigest())


def change_card(path: Path, **changes: object) -> None:
    card = json.loads(card_path(path).read_text())
    card_path(path).write_text(json.dumps(card | changes))


def refused(path: Path, words: str) -> InputError:
    with pytest.raises(InputError, match=words) as error:
        load_checkpoint(path)
    assert error.value.where in (str(path), str(card_path(path)))
    assert error.value.fix
    return error.value


def test_a_model_comes_back_exactly(path: Path) -> None:
    loaded = load_checkpoint(path)
    expected = new_model(NetworkShape(6, 8, 2, 5), 4)
    x = torch.randn(3, 20, 6)
    model = load_network(loaded)
    assert torch.equal(model(x), expected(x))
    assert not model.training
    assert loaded.card.weights_sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.parametrize(
    "shape", [NetworkShape(6, 8, 2, 5), NetworkShape(258, 16, 1, 3), NetworkShape(252, 4, 3, 1)]
)
def test_the_expected_arrays_are_those_of_the_network(shape: NetworkShape) -> None:
    arrays = new_model(shape, 0).arrays()
    assert {name: array.shape for name, array in arrays.items()} == expected_arrays(shape)


@pytest.mark.promise("D6")
def test_a_pickled_model_is_refused_and_never_run(path: Path, tmp_path: Path) -> None:
    witness = tmp_path / "ran"

    code = f"open({str(witness)!r}, 'w')".encode()
    for protocol in range(2, 6):
        call = b"cbuiltins\nexec\n(X" + struct.pack("<I", len(code)) + code + b"tR."
        path.write_bytes(bytes([0x80, protocol]) + call)
        reseal(path)
        refused(path, "pickled")
    torch.save({"w": torch.zeros(3)}, path)
    refused(path, "pickled")
    assert not witness.exists()


@pytest.mark.promise("D6")
def test_a_truncated_file_is_refused(path: Path) -> None:
    whole = path.read_bytes()
    for size in (0, 7, 8, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        refused(path, "SHA-256 differs")
        reseal(path)
        refused(path, "not a complete safetensors")


@pytest.mark.promise("D6")
def test_a_header_of_100_mb_is_refused(path: Path) -> None:
    size = 100_000_000
    path.write_bytes(struct.pack("<Q", size) + b"{" + b" " * (size - 2) + b"}")
    reseal(path)
    refused(path, "too large")


def test_weights_of_16_bits_are_half_as_large_and_answer_alike(path: Path) -> None:
    whole = load_checkpoint(path)
    half = path.with_name("half.safetensors")
    save_half_precision(half, whole)
    loaded = load_checkpoint(half)
    assert {a.dtype for a in loaded.arrays.values()} == {np.dtype(np.float32)}
    assert half.stat().st_size < 0.7 * path.stat().st_size
    for name in ("mean", "scale"):
        assert np.array_equal(loaded.arrays[name], whole.arrays[name])
    x = torch.randn(50, 20, 6, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        first, second = (torch.sigmoid(load_network(m)(x)) for m in (whole, loaded))
    assert 0.0 < float((first - second).abs().max()) < 0.002


@pytest.mark.promise("D6")
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["lstm.weight_hh_l1", "head.bias", "mean"])
def test_weights_that_are_not_finite_are_refused(path: Path, name: str, value: float) -> None:
    tensors = parse_arrays(path.read_bytes(), path)
    tensors[name].reshape(-1)[0] = value
    save_file(tensors, path)
    reseal(path)
    refused(path, f"'{name}' holds values that are not finite")


@pytest.mark.promise("D6")
def test_other_tensors_are_refused(path: Path) -> None:
    good = parse_arrays(path.read_bytes(), path)
    cases = {
        "head.bias": ({**good, "head.bias": np.zeros(6, np.float32)}, "shape"),
        "double": ({**good, "head.bias": np.zeros(5, np.float64)}, "float64, not float32"),
        "extra": ({**good, "extra": np.zeros(1, np.float32)}, "unexpected tensors: extra"),
        "scale": ({**good, "scale": np.zeros(6, np.float32)}, "not positive"),
        "less": ({k: v for k, v in good.items() if k != "mean"}, "Missing .* mean"),
    }
    for tensors, words in cases.values():
        save_file(tensors, path)
        reseal(path)
        refused(path, words)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"arch": "os.system"}, "architecture 'os.system' is not known"),
        ({"frames": 21}, "21 frames"),
        ({"rate_hz": 25}, "25 Hz"),
        ({"vector_order": "row first"}, "ordered row first"),
        ({"modality": "FT+Tac"}, "6 inputs"),
        ({"modality": "smell"}, "modality"),
        ({"hyper": {"inputs": 6, "hidden": 10**9, "layers": 2, "points": 5}}, "hidden"),
        ({"surprise": 1}, "surprise"),
    ],
)
def test_a_card_that_does_not_fit_is_refused(path: Path, changes: dict, words: str) -> None:
    change_card(path, **changes)
    refused(path, words)


def test_missing_files_are_named(path: Path) -> None:
    card_path(path).unlink()
    assert refused(path, "No such file").where == str(card_path(path))
    path.unlink()
    assert refused(path, "No such file").where == str(path)


def test_safetensors_vector_of_the_format() -> None:
    content = (
        bytes.fromhex("5000000000000000")
        + b'{"__metadata__":{"k":"v"},"w":{"dtype":"F32","shape":[2],"data_offsets":[0,8]}} '
        + bytes.fromhex("0000803f00000040")
    )
    assert len(content) == 96
    assert parse_arrays(content, Path("vector"))["w"].tolist() == [1.0, 2.0]


def test_the_recipe_leaves_a_measured_model(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["models", "--pieces", "pot", "--out", str(tmp_path), "--episodes", "6", "--json"]
    words += ["--test-episodes", "2", "--epochs", "1", "--probes-per-grip", "2", "--workers", "1"]
    assert main(words) == 0
    answer = json.loads(capsys.readouterr().out)
    bottoms = {"short", "long", "hex20", "rect12x28", "all"}
    assert set(answer["models"]["pot"]["scores"]) == bottoms
    path = tmp_path / "pot.safetensors"
    card = load_checkpoint(path).card
    assert card.data["episodes"] == {"circle15": 6, "circle25": 6, "square15": 6}
    assert card.data["recipe"]["seed"] == 1
    assert set(card.metrics["unseen_bottoms"]) == bottoms
    assert card.metrics["unseen_bottoms"]["all"]["episodes"] == 8
    assert Estimator.load(path, load_pieces().piece("pot")).card == card
    assert sorted(p.name for p in tmp_path.iterdir()) == ["pot.json", "pot.safetensors"]


@pytest.fixture(scope="module")
def pieces(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a smaller pot of the operator's own."""
    folder = tmp_path_factory.mktemp("pieces")
    text = files("touchdown.resources").joinpath("objects", "pot.toml").read_text("utf-8")
    assert "diameter_mm = " in text
    lines = [
        "diameter_mm = 20.0" if line.startswith("diameter_mm") else line
        for line in text.splitlines()
    ]
    (folder / "own.toml").write_text("\n".join(lines), "utf-8")
    return folder


@pytest.fixture(scope="module")
def model(pieces: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("own")
    words = ["models", "--pieces", "own", "--pieces-dir", str(pieces), "--out", str(folder)]
    words += ["--episodes", "4", "--test-episodes", "2", "--epochs", "1", "--workers", "1"]
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        assert main([*words, "--json"]) == 0
    assert err.getvalue() == ""
    assert list(json.loads(out.getvalue())["models"]) == ["own"]
    return folder / "own.safetensors"


def test_models_are_made_of_the_faces_of_own_pieces(pieces: Path, model: Path) -> None:
    points = face_points(load_pieces(pieces).piece("own").face)
    assert len(points) != len(face_points(load_pieces().piece("pot").face))
    card = load_checkpoint(model).card
    assert card.piece == "own"
    assert card.metrics["unseen_bottoms"]["all"]["episodes"] == 8


def test_a_model_of_an_own_piece_is_measured_with_its_folder_only(
    pieces: Path, model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = tmp_path / "data"
    words = ["simulate", "--piece", "own", "--pieces", str(pieces), "--bottoms", "short"]
    assert main([*words, "--episodes", "3", "--seed", "5", "--out", str(data), "--json"]) == 0
    capsys.readouterr()
    assert main(["evaluate", str(model), str(data), "--pieces", str(pieces), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["piece"] == "own"
    assert answer["scores"]["all"]["episodes"] == 3
    assert main(["evaluate", str(model), str(data), "--json"]) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert "own" in json.loads(told.err)["error"]["what"]


def test_a_folder_that_is_not_there_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    missing = str(tmp_path / "none")
    words = ["models", "--pieces", "own", "--pieces-dir", missing, "--out", str(tmp_path)]
    assert main([*words, "--json"]) == 2
    assert json.loads(capsys.readouterr().err)["error"]["where"] == missing
    assert list(tmp_path.iterdir()) == []
