"""The sizes of the network and what its weights are called; known without torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass

ARCH = "lstm-last-linear/1"
ARCHITECTURES = (ARCH,)
"""Allow-list: a checkpoint names one of these words, never something to import."""
GATES = 4


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


def expected_arrays(shape: Shape) -> Mapping[str, tuple[int, ...]]:
    """Return name and shape of every array that a checkpoint of ``shape`` must hold."""
    arrays: dict[str, tuple[int, ...]] = {"mean": (shape.inputs,), "scale": (shape.inputs,)}
    rows = GATES * shape.hidden
    for layer in range(shape.layers):
        arrays[f"lstm.weight_ih_l{layer}"] = (rows, shape.hidden if layer else shape.inputs)
        arrays[f"lstm.weight_hh_l{layer}"] = (rows, shape.hidden)
        arrays[f"lstm.bias_ih_l{layer}"] = arrays[f"lstm.bias_hh_l{layer}"] = (rows,)
    return arrays | {"head.weight": (shape.points, shape.hidden), "head.bias": (shape.points,)}
