"""Checkpoints: every damaged model gives one InputError with the file."""

import hashlib
import json
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import save_file

from touchdown.backend.core.faults import InputError
from touchdown.backend.learning.checkpoint import (
    ModelCard,
    NetworkSizes,
    card_path,
    load_checkpoint,
    parse_arrays,
    save_checkpoint,
    save_half_precision,
)
from touchdown.backend.learning.inference import ARCH, NetworkShape, expected_arrays
from touchdown.backend.learning.training import load_network, new_model


def save_small(path: Path) -> dict[str, np.ndarray]:
    """Save a small new model with its card; return its arrays."""
    model = new_model(NetworkShape(6, 8, 2, 5), 4)
    card = ModelCard(
        arch=ARCH, hyper=NetworkSizes(inputs=6, hidden=8, layers=2, points=5), modality="FT",
        piece="pot", geometry="ab" * 32, base_rate=0.3, seed=4, program_version="0.1.0",
        weights_sha256="",
    )  # fmt: skip
    save_checkpoint(path, model.arrays(), card)
    return model.arrays()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "pot.safetensors"
    save_small(path)
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


def test_a_flipped_bit_is_refused(path: Path) -> None:
    whole = bytearray(path.read_bytes())
    whole[-5] ^= 1
    path.write_bytes(whole)
    refused(path, "SHA-256 differs")


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
