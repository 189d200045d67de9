"""Estimator compared with the network; NaN and foreign models are refused."""

import hashlib
from pathlib import Path

import numpy as np
import pytest
import torch

from touchdown.backend.core.faults import InputError
from touchdown.backend.core.values import Episode, EpisodeQuality
from touchdown.backend.geometry.outlines import face_points
from touchdown.backend.geometry.pieces import Piece, load_pieces
from touchdown.backend.learning.checkpoint import ModelCard, NetworkSizes, save_checkpoint
from touchdown.backend.learning.inference import ARCH, Modality, NetworkShape, modality_columns
from touchdown.backend.learning.training import new_model
from touchdown.backend.placement.estimator import Estimator


def episode(observation: np.ndarray, piece: str = "pot") -> Episode:
    quality = EpisodeQuality(True, (), 0, 0.0, 0, 1.0, 0.0)
    return Episode("e1", piece, observation.astype(np.float32), np.zeros(2), 0.3, quality)


def write_model(path: Path, of: Piece, modality: Modality = "FT+Tac", **card: object) -> Path:
    inputs = modality_columns(modality).stop - modality_columns(modality).start
    points = len(face_points(of.face))
    model = new_model(NetworkShape(inputs, 256, 2, points), 9)
    fields = {
        "arch": ARCH, "modality": modality, "piece": of.name, "geometry": of.sha256,
        "hyper": NetworkSizes(inputs=inputs, hidden=256, layers=2, points=points), "base_rate": 0.3,
        "seed": 9, "program_version": "0", "weights_sha256": "",
    }  # fmt: skip
    save_checkpoint(path, model.arrays(), ModelCard.model_validate(fields | card))
    return path


@pytest.mark.parametrize("modality", ["FT", "Tac", "FT+Tac"])
def test_equals_the_network_on_the_channels_of_its_modality(
    tmp_path: Path, pot: Piece, modality: Modality
) -> None:
    estimator = Estimator.load(write_model(tmp_path / "m.safetensors", pot, modality), pot)
    observation = np.random.default_rng(1).normal(size=(20, 258)).astype(np.float32)
    patch = estimator.estimate(episode(observation))
    inputs = modality_columns(modality).stop - modality_columns(modality).start
    model = new_model(NetworkShape(inputs, 256, 2, 177), 9).eval()
    x = {"FT": observation[:, 252:], "Tac": observation[:, :252]}.get(modality, observation)
    with torch.no_grad():
        expected = torch.sigmoid(model(torch.from_numpy(x.copy())[None]))[0].numpy()
    assert np.allclose(patch.probability, expected, atol=1e-6)
    assert np.array_equal(patch.points_mm, face_points(pot.face))
    assert estimator.estimate(episode(observation)).probability.tolist() == (
        patch.probability.tolist()
    )


def test_preparing_never_changes_an_estimate(tmp_path: Path, pot: Piece) -> None:
    path = write_model(tmp_path / "m.safetensors", pot)
    probes = np.random.default_rng(4).normal(size=(3, 20, 258)).astype(np.float32)
    plain = [Estimator.load(path, pot).estimate(episode(rows)).probability for rows in probes]
    estimator = Estimator.load(path, pot)
    estimator.prepare(probes[0][:19])
    for rows, expected in zip(probes, plain, strict=True):
        # Bit for bit, prepared for this probe, for another, or with one value corrected since.
        assert np.array_equal(estimator.estimate(episode(rows)).probability, expected)
        estimator.prepare(rows[:19])
        assert np.array_equal(estimator.estimate(episode(rows)).probability, expected)
    corrected = probes[2].copy()
    corrected[18, 257] += 1.0
    changed = estimator.estimate(episode(corrected)).probability
    assert not np.array_equal(changed, plain[2])
    assert np.array_equal(
        changed, Estimator.load(path, pot).estimate(episode(corrected)).probability
    )


def test_early_ticks_that_are_missing_do_no_harm(tmp_path: Path, pot: Piece) -> None:
    estimator = Estimator.load(write_model(tmp_path / "m.safetensors", pot), pot)
    rows = np.zeros((20, 258), np.float32)
    expected = estimator.estimate(episode(rows)).probability
    estimator.prepare(np.full((19, 258), np.nan, np.float32))
    assert np.array_equal(estimator.estimate(episode(rows)).probability, expected)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("channel", [0, 251, 257])
def test_a_value_that_is_not_finite_is_refused(
    tmp_path: Path, pot: Piece, value: float, channel: int
) -> None:
    estimator = Estimator.load(write_model(tmp_path / "m.safetensors", pot), pot)
    observation = np.zeros((20, 258))
    observation[11, channel] = value
    with pytest.raises(InputError, match=f"not finite .channel {channel} first"):
        estimator.estimate(episode(observation))


def test_episodes_that_do_not_belong_are_refused(tmp_path: Path, pot: Piece) -> None:
    estimator = Estimator.load(write_model(tmp_path / "m.safetensors", pot), pot)
    with pytest.raises(InputError, match="'barrel'"):
        estimator.estimate(episode(np.zeros((20, 258)), "barrel"))
    with pytest.raises(InputError, match="shape"):
        estimator.estimate(episode(np.zeros((19, 258))))


def test_models_that_do_not_belong_are_refused_by_name(tmp_path: Path, pot: Piece) -> None:
    barrel = load_pieces().piece("barrel")
    path = tmp_path / "m.safetensors"
    other = hashlib.sha256(b"other").hexdigest()
    cases = [
        (barrel, {}, "of 'barrel', not of 'pot'"),
        (pot, {"geometry": other}, "another version"),
        (barrel, {"piece": "pot"}, "349 face points, 'pot' has 177"),
    ]
    for piece, card, words in cases:
        write_model(path, piece, **card)
        with pytest.raises(InputError, match=words) as error:
            Estimator.load(path, pot)
        assert error.value.where == str(path)
