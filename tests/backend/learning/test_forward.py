"""Forward pass without torch compared with torch."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from touchdown.backend.bench.assembly import shipped_model
from touchdown.backend.learning.checkpoint import Checkpoint, load_checkpoint
from touchdown.backend.learning.inference import (
    NetworkShape,
    Normaliser,
    PatchForward,
    modality_columns,
)
from touchdown.backend.learning.training import PatchNet, load_network, new_model

CLOSE = 2e-5
"""Float32 over 20 ticks, sums in another order; logits are of size 1 to 20."""


def forward_of(checkpoint: Checkpoint) -> PatchForward:
    return PatchForward(checkpoint.arrays, NetworkShape(**checkpoint.card.hyper.model_dump()))


def torch_logits(model: PatchNet, rows: np.ndarray) -> np.ndarray:
    with torch.no_grad():
        return model(torch.from_numpy(rows[None].copy()))[0].numpy()


@pytest.mark.parametrize(
    "shape", [NetworkShape(258, 256, 2, 177), NetworkShape(6, 5, 1, 3), NetworkShape(252, 33, 3, 7)]
)
def test_equals_torch_on_random_weights_and_inputs(shape: NetworkShape) -> None:
    rng = np.random.default_rng(shape.hidden)
    model = new_model(shape, 3).eval()
    mean, scale = rng.normal(size=(2, shape.inputs)).astype(np.float32)
    model.set_normaliser(Normaliser(mean, np.abs(scale) + 0.1))
    forward = PatchForward(model.arrays(), shape)
    for _ in range(20):
        rows = rng.normal(scale=3.0, size=(20, shape.inputs)).astype(np.float32)
        ours = forward.logits(forward.run(rows, forward.start))
        assert np.abs(ours - torch_logits(model, rows)).max() < CLOSE


@pytest.mark.parametrize("piece", ["pot", "mushroom", "barrel"])
def test_equals_torch_on_the_shipped_models(piece: str) -> None:
    checkpoint = load_checkpoint(shipped_model(piece))
    forward, model = forward_of(checkpoint), load_network(checkpoint)
    rng = np.random.default_rng(5)
    mean, scale = checkpoint.arrays["mean"], checkpoint.arrays["scale"]
    for size in (0.3, 1.0, 3.0):
        # Walks that grow from zero, as a press does, in the units of the channels.
        walk = np.cumsum(rng.normal(scale=size / 4, size=(20, 258)), axis=0)
        rows = (mean + scale * walk).astype(np.float32)[
            :, modality_columns(checkpoint.card.modality)
        ]
        ours = forward.logits(forward.run(rows, forward.start))
        theirs = torch_logits(model, rows)
        assert np.abs(ours - theirs).max() < CLOSE * max(1.0, np.abs(theirs).max())


@pytest.mark.parametrize("cut", [1, 10, 19])
def test_a_sequence_can_be_cut_anywhere(cut: int) -> None:
    shape = NetworkShape(12, 16, 2, 4)
    forward = PatchForward(new_model(shape, 1).arrays(), shape)
    rows = np.random.default_rng(2).normal(size=(20, 12)).astype(np.float32)
    begun = forward.run(rows[:cut], forward.start)
    kept = begun.hidden.copy()
    in_two = forward.logits(forward.run(rows[cut:], begun))
    assert np.allclose(in_two, forward.logits(forward.run(rows, forward.start)), atol=1e-6)
    assert np.array_equal(begun.hidden, kept)
    assert not forward.start.hidden.any()


def test_an_estimator_needs_no_torch() -> None:
    code = (
        "import sys\n"
        "from touchdown.backend.bench.assembly import shipped_model\n"
        "from touchdown.backend.geometry.pieces import load_pieces\n"
        "from touchdown.backend.placement.estimator import Estimator\n"
        "Estimator.load(shipped_model('pot'), load_pieces().piece('pot'))\n"
        "sys.exit('torch' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], check=False, cwd=Path(__file__).resolve().parents[3]
    )
    assert done.returncode == 0
