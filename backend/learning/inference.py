"""LSTM network of the paper without torch, one tick at a time.

Includes architecture (array names and shapes), modality columns of the 258 channels, and
standardisation. The state can be kept between two ticks.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import pydantic.dataclasses
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from touchdown.backend.core import CHANNELS, MARKERS, TACTILE_CHANNELS, WRENCH_CHANNELS

ARCH = "lstm-last-linear/1"
# allow-list: a checkpoint contains one of these names, never an import path
ARCHITECTURES = (ARCH,)
GATES = 4


Size = Annotated[int, Field(ge=1, le=100_000)]


@pydantic.dataclasses.dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class NetworkShape:
    """Sizes of the network: ``inputs`` channels, ``points`` outputs."""

    inputs: Size
    hidden: Annotated[int, Field(ge=1, le=4096)]
    layers: Annotated[int, Field(ge=1, le=8)]
    points: Size


def expected_arrays(shape: NetworkShape) -> Mapping[str, tuple[int, ...]]:
    """Return name and shape of every array in a checkpoint of ``shape``."""
    arrays: dict[str, tuple[int, ...]] = {"mean": (shape.inputs,), "scale": (shape.inputs,)}
    rows = GATES * shape.hidden
    for layer in range(shape.layers):
        arrays[f"lstm.weight_ih_l{layer}"] = (rows, shape.hidden if layer else shape.inputs)
        arrays[f"lstm.weight_hh_l{layer}"] = (rows, shape.hidden)
        arrays[f"lstm.bias_ih_l{layer}"] = arrays[f"lstm.bias_hh_l{layer}"] = (rows,)
    return arrays | {"head.weight": (shape.points, shape.hidden), "head.bias": (shape.points,)}


Modality = Literal["FT", "Tac", "FT+Tac"]
VECTOR_ORDER = "[sensor][axis][row][column] 2x2x7x9, then Fx Fy Fz Tx Ty Tz"
_COLUMNS: dict[Modality, slice] = {
    "FT": slice(TACTILE_CHANNELS, CHANNELS),
    "Tac": slice(0, TACTILE_CHANNELS),
    "FT+Tac": slice(0, CHANNELS),
}


def modality_columns(modality: Modality) -> slice:
    """Return the columns of ``modality`` within the 258 channels."""
    return _COLUMNS[modality]


def channel_groups() -> NDArray[np.int64]:
    """Return the group (258,) of every channel: one per finger and axis, one per wrench value."""
    tactile = np.repeat(np.arange(TACTILE_CHANNELS // MARKERS), MARKERS)
    wrench = tactile[-1] + 1 + np.arange(WRENCH_CHANNELS)
    return np.concatenate([tactile, wrench])


@dataclass(frozen=True, slots=True)
class Normaliser:
    """``(x - mean) / scale``; both (channels,) float32."""

    mean: NDArray[np.float32]
    scale: NDArray[np.float32]


def fit_normaliser_in_parts(parts: Iterable[NDArray[np.float32]], modality: Modality) -> Normaliser:
    """Fit on the episodes of all ``parts``, one part in memory at a time."""
    count, mean, squares = 0, np.zeros(CHANNELS), np.zeros(CHANNELS)
    for part in parts:
        flat = part.reshape(-1, part.shape[-1])
        added, their_mean = len(flat), flat.mean(axis=0, dtype=np.float64)
        # Merge of means and squared deviations (Chan, Golub, LeVeque 1983).
        step, total = their_mean - mean, count + added
        squares += flat.astype(np.float64).var(axis=0) * added + step**2 * (count * added / total)
        mean, count = mean + step * (added / total), total
    variance = squares / count
    groups = channel_groups()
    scale = np.sqrt(np.bincount(groups, variance) / np.bincount(groups))[groups]
    scale[scale < 1e-9] = 1.0
    seen = modality_columns(modality)
    return Normaliser(mean[seen].astype(np.float32), scale[seen].astype(np.float32))


Array = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class LstmState:
    """State of the layers after some ticks: ``hidden`` and ``cell``, (layers, hidden) each."""

    hidden: Array
    cell: Array


@dataclass(frozen=True, slots=True)
class _Layer:
    """Gates in the order in, forget, out, cell, so the three sigmoids are adjacent.

    A sigmoid is a tanh of half the argument, ``s(x) = (1 + tanh(x / 2)) / 2``. The factors 1/2 are
    in the weights (exact, a power of two), so one tanh serves all four gates.
    """

    from_input: Array
    from_hidden: Array
    bias: Array

    @classmethod
    def of(cls, arrays: Mapping[str, Array], layer: int) -> _Layer:
        bias = arrays[f"lstm.bias_ih_l{layer}"] + arrays[f"lstm.bias_hh_l{layer}"]
        return cls(
            _regrouped(arrays[f"lstm.weight_ih_l{layer}"]),
            _regrouped(arrays[f"lstm.weight_hh_l{layer}"]),
            _regrouped(bias),
        )

    def run(self, inputs: Array, hidden: Array, cell: Array) -> tuple[Array, Array]:
        """Return the hidden values of every row of ``inputs`` (k, n), and the last cell state."""
        size = len(hidden)
        drive = np.vecdot(inputs[:, None], self.from_input) + self.bias
        outputs = np.empty((len(inputs), size), np.float32)
        for row, gates in enumerate(drive):
            gates += np.vecdot(self.from_hidden, hidden)
            np.tanh(gates, out=gates)
            opening = gates[: 3 * size]
            opening *= 0.5
            opening += 0.5
            let_in, keep, let_out = opening.reshape(3, size)
            cell = keep * cell + let_in * gates[3 * size :]
            hidden = np.multiply(let_out, np.tanh(cell), out=outputs[row])
        return outputs, cell


class PatchForward:
    """Weights prepared for one episode at a time; stateless."""

    def __init__(self, arrays: Mapping[str, Array], shape: NetworkShape) -> None:
        self._mean, self._scale = arrays["mean"], arrays["scale"]
        self._layers = [_Layer.of(arrays, layer) for layer in range(shape.layers)]
        self._head, self._bias = arrays["head.weight"], arrays["head.bias"]
        start = np.zeros((shape.layers, shape.hidden), np.float32)
        self.start: LstmState = LstmState(start, start)

    def run(self, ticks: Array, after: LstmState) -> LstmState:
        """Return the state after further ``ticks`` (k, inputs) of raw channels, k >= 1.

        ``after``: state before them. The last bits depend on how a sequence is divided; equal
        divisions give equal bits.
        """
        values = np.ascontiguousarray((ticks - self._mean) / self._scale)
        hidden, cells = np.empty_like(after.hidden), np.empty_like(after.cell)
        for number, layer in enumerate(self._layers):
            values, cells[number] = layer.run(values, after.hidden[number], after.cell[number])
            hidden[number] = values[-1]
        return LstmState(hidden, cells)

    def logits(self, state: LstmState) -> Array:
        """Return one logit per face point, (points,)."""
        return np.asarray(np.vecdot(self._head, state.hidden[-1]) + self._bias, dtype=np.float32)


def _regrouped(rows: Array) -> Array:
    """Reorder rows from the gates of torch (in, forget, cell, out) to those of ``_Layer``."""
    let_in, forget, cell, out = np.split(rows, 4)
    half = np.float32(0.5)
    return np.ascontiguousarray(np.concatenate((half * let_in, half * forget, half * out, cell)))
