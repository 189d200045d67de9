"""The network of the paper: two LSTM layers, the last time step, one logit per face point."""

from __future__ import annotations

from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from backend.learning.checkpoint import Checkpoint
from backend.learning.features import Normaliser
from backend.learning.shape import Shape


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

    def arrays(self) -> dict[str, NDArray[np.float32]]:
        """Return the weights by name, as a checkpoint keeps them."""
        return {name: tensor.numpy(force=True) for name, tensor in self.state_dict().items()}

    def forward(self, observation: Tensor) -> Tensor:
        """Return logits (B, points)."""
        states, _ = self.lstm((observation - self.mean) / self.scale)
        return cast("Tensor", self.head(states[:, -1]))


def new_model(shape: Shape, seed: int) -> PatchNet:
    """Return a freshly initialised network, the same for the same seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return PatchNet(shape)


def network(checkpoint: Checkpoint) -> PatchNet:
    """Return the network of a loaded model, ready to use (evaluation mode)."""
    with torch.device("meta"):
        model = PatchNet(Shape(**checkpoint.card.hyper.model_dump()))
    tensors = {name: torch.from_numpy(array.copy()) for name, array in checkpoint.arrays.items()}
    model.load_state_dict(tensors, strict=True, assign=True)
    model.requires_grad_(False)
    return model.eval()
