"""The sizes of the fusing network and what its weights are called; known without torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Final

from backend.learning.fused.summary import MODES, PIECE_INPUTS, PROBE_INPUTS

ARCH: Final = "causal-attention-inset/1"
POINT_INPUTS = 5
"""A point from the last probe and from the first one, and its distance from the last."""
OF_MIXTURE = 3
"""Weight, mean and spread of each part."""


@dataclass(frozen=True, slots=True)
class FusedShape:
    """Sizes of the network: ``layers`` of attention of ``width`` and ``heads`` over the probes,
    each followed by ``inner`` units; ``parts`` normal distributions make the answer for a point.
    """

    width: int = 96
    heads: int = 4
    layers: int = 2
    inner: int = 192
    parts: int = 3

    def as_json(self) -> dict[str, int]:
        """Return the sizes by name."""
        return asdict(self)


def expected_arrays(shape: FusedShape) -> Mapping[str, tuple[int, ...]]:
    """Return name and shape of every array of a checkpoint: the weights and three of the data."""
    return {
        "mean": (PROBE_INPUTS + PIECE_INPUTS,),
        "scale": (PROBE_INPUTS + PIECE_INPUTS,),
        "modes": (2, MODES, 126),
        **weight_shapes(shape),
    }


def weight_shapes(shape: FusedShape) -> Mapping[str, tuple[int, ...]]:
    """Return name and shape of what is trained."""
    width, inner = shape.width, shape.inner
    arrays: dict[str, tuple[int, ...]] = {}

    def linear(name: str, outputs: int, inputs: int) -> None:
        arrays[f"{name}.weight"], arrays[f"{name}.bias"] = (outputs, inputs), (outputs,)

    linear("probe", inner, PROBE_INPUTS + PIECE_INPUTS)
    linear("probe2", width, inner)
    for layer in range(shape.layers):
        linear(f"{layer}.asks", 3 * width, width)
        linear(f"{layer}.joins", width, width)
        linear(f"{layer}.up", inner, width)
        linear(f"{layer}.down", width, inner)
    linear("about", inner, width)
    linear("point", inner, POINT_INPUTS)
    linear("both", width, inner)
    linear("answer", OF_MIXTURE * shape.parts, width)
    return arrays
