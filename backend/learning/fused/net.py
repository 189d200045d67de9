"""The fusing network in torch, for training; ``forward`` applies the same weights without it."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import linear, relu, rms_norm

from backend.learning.fused.shape import FusedShape, weight_shapes

SQUARE_ROOT_OF_TWO_PI = math.sqrt(2.0 * math.pi)
LEAST_LOG_SD, MOST_LOG_SD = -4.0, 2.0
WB = ("weight", "bias")


class FusedNet(nn.Module):
    """From the probes of one gripping to a distribution of how far a point lies in the support.

    ``alone``: attention adds zero, for good, so that each probe is read by itself.
    """

    def __init__(self, shape: FusedShape, seed: int, *, alone: bool = False) -> None:
        super().__init__()
        self.shape = shape
        generator = torch.Generator().manual_seed(seed)
        self.weights = nn.ParameterDict()
        for name, size in weight_shapes(shape).items():
            drawn = torch.randn(size, generator=generator) / math.sqrt(size[-1])
            self.weights[_key(name)] = drawn if len(size) > 1 else torch.zeros(size)
        if alone:
            for name in (f"{layer}.joins.{what}" for layer in range(shape.layers) for what in WB):
                self.weights[_key(name)].data.zero_()
                self.weights[_key(name)].requires_grad_(False)

    def fused(self, probes: Tensor) -> Tensor:
        """Return (b, P, width): what is known after each of the probes (b, P, inputs), scaled."""
        count = probes.shape[1]
        never = torch.full((count, count), -torch.inf, device=probes.device)
        later = torch.triu(never, diagonal=1)
        x = self._linear("probe2", relu(self._linear("probe", probes)))
        for layer in range(self.shape.layers):
            x = x + self._attended(layer, rms_norm(x, x.shape[-1:]), later)
            inner = relu(self._linear(f"{layer}.up", rms_norm(x, x.shape[-1:])))
            x = x + self._linear(f"{layer}.down", inner)
        return rms_norm(x, x.shape[-1:])

    def forward(self, probes: Tensor, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return log weight, mean and log sd (b, P, q, parts) of the inset of ``points``.

        ``points`` (b, P, q, 5) about the state after each probe. Lengths in units of 10 mm.
        """
        about = self._linear("about", self.fused(probes))[:, :, None]
        both = relu(self._linear("both", relu(about + self._linear("point", points))))
        weight, mean, log_sd = self._linear("answer", both).chunk(3, dim=-1)
        return (
            weight.log_softmax(dim=-1),
            mean,
            log_sd.clamp(LEAST_LOG_SD, MOST_LOG_SD),
        )

    def _attended(self, layer: int, x: Tensor, later: Tensor) -> Tensor:
        b, count, width = x.shape
        heads = self.shape.heads
        asked = self._linear(f"{layer}.asks", x).view(b, count, 3, heads, width // heads)
        query, key, value = asked.permute(2, 0, 3, 1, 4)
        share = (query @ key.mT / math.sqrt(width // heads) + later).softmax(dim=-1)
        joined = (share @ value).transpose(1, 2).reshape(b, count, width)
        return self._linear(f"{layer}.joins", joined)

    def _linear(self, name: str, x: Tensor) -> Tensor:
        return linear(x, self.weights[_key(f"{name}.weight")], self.weights[_key(f"{name}.bias")])


def surprise(answer: tuple[Tensor, Tensor, Tensor], inset: Tensor) -> Tensor:
    """Return the negative log likelihood (b, P, q) of the true ``inset``."""
    weight, mean, log_sd = answer
    z = (inset[..., None] - mean) * torch.exp(-log_sd)
    log_p = weight - 0.5 * z**2 - log_sd - math.log(SQUARE_ROOT_OF_TWO_PI)
    return -log_p.logsumexp(dim=-1)


def _key(name: str) -> str:
    """Return a name that torch allows: no dots."""
    return name.replace(".", "/")


def arrays_of(net: FusedNet) -> dict[str, Tensor]:
    """Return the weights by the names of a checkpoint."""
    return {key.replace("/", "."): value.detach().cpu() for key, value in net.weights.items()}
