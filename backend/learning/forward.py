"""The network applied without torch: one episode at a time, resumable between two ticks.

Where a decision is due torch would cost its import, 190 MB, and 3 to 4 ms a call. The
equations are those of ``torch.nn.LSTM``; ``model.PatchNet`` is what they are tested against.

Products are row by row (``vecdot``) and not with ``@``: those of this size the BLAS of numpy shares
among threads, which on two busy cores took 20 to 90 ms instead of 4.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from backend.learning.shape import Shape

Array = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class State:
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

    def __init__(self, arrays: Mapping[str, Array], shape: Shape) -> None:
        self._mean, self._scale = arrays["mean"], arrays["scale"]
        self._layers = [_Layer.of(arrays, layer) for layer in range(shape.layers)]
        self._head, self._bias = arrays["head.weight"], arrays["head.bias"]
        start = np.zeros((shape.layers, shape.hidden), np.float32)
        self.start = State(start, start)

    def run(self, ticks: Array, after: State) -> State:
        """Return the state after ``ticks`` (k, inputs) raw channels, k >= 1, that follow ``after``.

        The last bits depend on where a sequence is cut: equal cuts give equal bits.
        """
        values = np.ascontiguousarray((ticks - self._mean) / self._scale)
        hidden, cells = np.empty_like(after.hidden), np.empty_like(after.cell)
        for number, layer in enumerate(self._layers):
            values, cells[number] = layer.run(values, after.hidden[number], after.cell[number])
            hidden[number] = values[-1]
        return State(hidden, cells)

    def logits(self, state: State) -> Array:
        """Return one logit per face point, (points,)."""
        return np.asarray(np.vecdot(self._head, state.hidden[-1]) + self._bias, dtype=np.float32)


def _regrouped(rows: Array) -> Array:
    """Bring rows from torch's order (in, forget, cell, out) into the order of ``_Layer``."""
    let_in, forget, cell, out = np.split(rows, 4)
    half = np.float32(0.5)
    return np.ascontiguousarray(np.concatenate((half * let_in, half * forget, half * out, cell)))
