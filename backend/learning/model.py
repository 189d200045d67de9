"""The network of the paper: two LSTM layers, the last time step, one logit per face point."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import cast

import torch
from torch import Tensor, nn

from backend.learning.features import Normaliser

ARCH = "lstm-last-linear/1"
ARCHITECTURES = (ARCH,)
"""Allow-list: a checkpoint names one of these words, never something to import."""


@dataclass(frozen=True, slots=True)
class Shape:
    """Sizes that define the network: ``inputs`` channels, ``points`` outputs."""

    inputs: int
    hidden: int
    layers: int
    points: int

    def as_json(self) -> dict[str, int]:
        """Return the sizes by name."""
        return asdict(self)


class PatchNet(nn.Module):
    """(B, 20, inputs) raw channels to (B, points) logits; standardises inside."""

    mean: Tensor
    scale: Tensor

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        self.shape = shape
        self.register_buffer("mean", torch.zeros(shape.inputs))
        self.register_buffer("scale", torch.ones(shape.inputs))
        self.lstm = nn.LSTM(shape.inputs, shape.hidden, shape.layers, batch_first=True)
        self.head = nn.Linear(shape.hidden, shape.points)

    def set_normaliser(self, normaliser: Normaliser) -> None:
        """Take over mean and scale."""
        self.mean.copy_(torch.from_numpy(normaliser.mean))
        self.scale.copy_(torch.from_numpy(normaliser.scale))

    def forward(self, observation: Tensor) -> Tensor:
        """Return logits (B, points)."""
        states, _ = self.lstm((observation - self.mean) / self.scale)
        return cast("Tensor", self.head(states[:, -1]))


def new_model(shape: Shape, seed: int) -> PatchNet:
    """Return a freshly initialised network, the same for the same seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return PatchNet(shape)


def expected_tensors(shape: Shape) -> Mapping[str, tuple[int, ...]]:
    """Return name and shape of every tensor that a checkpoint of ``shape`` must hold."""
    with torch.device("meta"):
        model = PatchNet(shape)
    return {name: tuple(tensor.shape) for name, tensor in model.state_dict().items()}
