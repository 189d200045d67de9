"""LSTM network of the paper applied without torch, one tick at a time.

Includes architecture (array names and shapes), modality columns of the 258 channels, and
standardisation. Resumable between two ticks.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.core import CHANNELS, MARKERS, TACTILE_CHANNELS, WRENCH_CHANNELS

ARCH = "lstm-last-linear/1"
# Allow-list: a checkpoint names one of these words, never something to import.
ARCHITECTURES = (ARCH,)
GATES = 4


@dataclass(frozen=True, slots=True)
class NetworkShape:
    """Sizes that define the network: ``inputs`` channels, ``points`` outputs."""

    inputs: int
    hidden: int
    layers: int
    points: int

    def as_json(self) -> dict[str, int]:
        """Return the sizes by name."""
        return asdict(self)


def expected_arrays(shape: NetworkShape) -> Mapping[str, tuple[int, ...]]:
    """Return name and shape of every array that a checkpoint of ``shape`` must hold."""
    arrays: dict[str, tuple[int, ...]] = {"mean": (shape.inputs,), "scale": (shape.inputs,)}
    rows = GATES * shape.hidden
    for layer in range(shape.layers):
        arrays[f"lstm.weight_ih_l{layer}"] = (rows, shape.hidden if layer else shape.inputs)
        arrays[f"lstm.weight_hh_l{layer}"] = (rows, shape.hidden)
        arrays[f"lstm.bias_ih_l{layer}"] = arrays[f"lstm.bias_hh_l{layer}"] = (rows,)
    return arrays | {"head.weight": (shape.points, shape.hidden), "head.bias": (shape.points,)}


Modality = Literal["FT", "Tac", "FT+Tac"]
MODALITIES: tuple[Modality, ...] = ("FT", "Tac", "FT+Tac")
VECTOR_ORDER = "[sensor][axis][row][column] 2x2x7x9, then Fx Fy Fz Tx Ty Tz"
_COLUMNS: dict[Modality, slice] = {
    "FT": slice(TACTILE_CHANNELS, CHANNELS),
    "Tac": slice(0, TACTILE_CHANNELS),
    "FT+Tac": slice(0, CHANNELS),
}


def modality_columns(modality: Modality) -> slice:
    """Return the channels of ``modality`` within the 258."""
    return _COLUMNS[modality]


def channel_groups() -> NDArray[np.int64]:
    """(258,) group of every channel: each finger and axis is one, each wrench value is one."""
    tactile = np.repeat(np.arange(TACTILE_CHANNELS // MARKERS), MARKERS)
    wrench = tactile[-1] + 1 + np.arange(WRENCH_CHANNELS)
    return np.concatenate([tactile, wrench])


@dataclass(frozen=True, slots=True)
class Normaliser:
    """``(x - mean) / scale``; both (channels,) float32."""

    mean: NDArray[np.float32]
    scale: NDArray[np.float32]


def fit_normaliser_in_parts(parts: Iterable[NDArray[np.float32]], modality: Modality) -> Normaliser:
    """Fit on the episodes of all ``parts`` without holding them at once."""
    count, mean, squares = 0, np.zeros(CHANNELS), np.zeros(CHANNELS)
    for part in parts:
        flat = part.reshape(-1, part.shape[-1])
        added, their_mean = len(flat), flat.mean(axis=0, dtype=np.float64)
        # Means and squared deviations of two samples as of one (Chan, Golub, LeVeque 1983).
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
    """What the layers remember after some ticks: ``hidden`` and ``cell`` are (layers, hidden)."""

    hidden: Array
    cell: Array


@dataclass(frozen=True, slots=True)
class _Layer:
    """Gates in the order in, forget, out, cell: the three sigmoids lie side by side.

    A sigmoid is a tanh of half the argument, ``s(x) = (1 + tanh(x / 2)) / 2``. The halves are in
    the weights (exact: a power of two), so that one tanh serves all four gates.
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
        """Return the hidden values of every row of ``inputs`` (k, n), and the last cell."""
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
    """Weights laid out for one episode at a time; holds nothing between two calls."""

    def __init__(self, arrays: Mapping[str, Array], shape: NetworkShape) -> None:
        self._mean, self._scale = arrays["mean"], arrays["scale"]
        self._layers = [_Layer.of(arrays, layer) for layer in range(shape.layers)]
        self._head, self._bias = arrays["head.weight"], arrays["head.bias"]
        start = np.zeros((shape.layers, shape.hidden), np.float32)
        self.start = LstmState(start, start)

    def run(self, ticks: Array, after: LstmState) -> LstmState:
        """Return the state after ``ticks`` (k, inputs) raw channels, k >= 1, that follow ``after``.

        The last bits depend on where a sequence is cut: equal cuts give equal bits.
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
    """Bring rows from torch's order (in, forget, cell, out) into the order of ``_Layer``."""
    let_in, forget, cell, out = np.split(rows, 4)
    half = np.float32(0.5)
    return np.ascontiguousarray(np.concatenate((half * let_in, half * forget, half * out, cell)))
