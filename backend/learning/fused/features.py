"""Inputs and array shapes of the fusion network.

Each probe is summarised in about 200 numbers instead of 20 x 258.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
import pydantic.dataclasses
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from touchdown.backend.core import GRID_COLS, GRID_ROWS, FloatArray

Array = NDArray[np.float32]
TICKS = (0, 1, 2, 4, 7, 10, 14, 19)  # ticks used, out of 20; the force rises over the first 15
MODES = 4  # principal components of the marker field, per finger
SENSOR_MM = 120.0  # height of the force sensor above the grasp pivot
GROWN = (3, 4, 5, 6, 7)  # ticks, out of the eight, with the centre of pressure of the increase
LEAST_N, FARTHEST_MM = 1.0, 30.0
DIRECTIONS = 16
LENGTH_MM = 10.0  # unit of lengths in the network
PIECE_INPUTS = DIRECTIONS + 3
PROBE_INPUTS = len(TICKS) * (6 + 2 * MODES) + 2 * len(GROWN) + 4
WAY = slice(PROBE_INPUTS - 4, PROBE_INPUTS)  # inputs from the first probe and from the last one
FIELDS = slice(6 * len(TICKS), (6 + 2 * MODES) * len(TICKS))  # inputs of the marker fields
UNREAD_SCALE = 1e9  # of inputs that a network does not read: they are 0 after the scaling


@dataclass(frozen=True, slots=True)
class GraspedFace:
    """Geometry of the grasped piece.

    ``reach_mm`` (..., 16): extent of the face from its centre of mass, counter-clockwise from +x;
    ``com_mm`` (..., 2) in ``F``; ``grip_height_mm`` (...).
    """

    reach_mm: FloatArray
    com_mm: FloatArray
    grip_height_mm: FloatArray

    @classmethod
    def of(
        cls, points_mm: FloatArray, com_mm: FloatArray, grip_height_mm: FloatArray
    ) -> GraspedFace:
        """Return the face spanned by the lattice ``points_mm`` (..., k, 2)."""
        from_com = points_mm - com_mm[..., None, :]
        reach = (from_com @ directions().T).max(axis=-2)
        return cls(reach, com_mm, np.asarray(grip_height_mm))

    def mirrored(self, *, across_x: bool, across_y: bool) -> GraspedFace:
        """Return the face mirrored in x, y or both."""
        at = np.arange(DIRECTIONS)
        at = DIRECTIONS // 2 - at if across_x else at
        at = -at if across_y else at
        signs = np.array([-1.0 if across_x else 1.0, -1.0 if across_y else 1.0])
        reach = self.reach_mm[..., at % DIRECTIONS]
        return GraspedFace(reach, self.com_mm * signs, self.grip_height_mm)

    def inputs(self) -> FloatArray:
        """Return the network inputs (..., 19), lengths in ``LENGTH_MM``."""
        height = (self.grip_height_mm - 35.0)[..., None]
        joined = np.concatenate([self.reach_mm - LENGTH_MM, self.com_mm, height], axis=-1)
        return np.asarray(joined / LENGTH_MM, dtype=np.float64)


def directions() -> FloatArray:
    """Return (16, 2) unit vectors."""
    angle = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def probe_inputs(
    wrench: Array, field: Array, offset_mm: FloatArray, face: GraspedFace, modes: Array
) -> FloatArray:
    """Return the inputs (..., P, inputs) of P consecutive probes of one grasp.

    ``wrench`` (..., P, 8, 6) in N and N·m and ``field`` (..., P, 8, 252) in px at ``TICKS``,
    ``offset_mm`` (..., P, 2), ``modes`` (2, MODES, 126).
    """
    shapes = wrench.shape[:-2]
    seen = centre_fields(field) @ modes.swapaxes(-1, -2).astype(np.float64)
    lever = (face.grip_height_mm + SENSOR_MM)[..., None, None]
    growth = np.asarray(wrench[..., GROWN, :] - wrench[..., :1, :], dtype=np.float64)
    acts = acting_point_mm(growth, lever) / LENGTH_MM
    from_first = (offset_mm - offset_mm[..., :1, :]) / LENGTH_MM
    before = np.concatenate([offset_mm[..., :1, :], offset_mm[..., :-1, :]], axis=-2)
    parts = [
        wrench.reshape(*shapes, -1),
        seen.reshape(*shapes, -1),
        acts.reshape(*shapes, -1),
        from_first,
        (offset_mm - before) / LENGTH_MM,
    ]
    return np.asarray(np.concatenate(parts, axis=-1), dtype=np.float64)


def acting_point_mm(growth: FloatArray, lever_mm: FloatArray) -> FloatArray:
    """Return the centre of pressure (..., 2) of a wrench increase (..., 6), in ``F``; 0 if none."""
    fx, fy, fz, tx, ty = np.moveaxis(growth[..., :5], -1, 0)
    press = np.maximum(fz, LEAST_N)
    at = np.stack([-(1e3 * ty + lever_mm * fx), 1e3 * tx - lever_mm * fy], axis=-1)
    at = np.where((fz >= LEAST_N)[..., None], at / press[..., None], 0.0)
    return np.asarray(np.clip(at, -FARTHEST_MM, FARTHEST_MM))


def wrench_at_sensor(wrench: Array, sensor_mm: float) -> Array:
    """Return the wrench (..., 6) at a sensor ``SENSOR_MM`` above the pivot.

    The input is measured ``sensor_mm`` above the pivot, where the lateral force has another lever.
    """
    moved = wrench.copy()
    lever_m = np.float32(1e-3 * (SENSOR_MM - sensor_mm))
    moved[..., 3] += lever_m * wrench[..., 1]
    moved[..., 4] -= lever_m * wrench[..., 0]
    return moved


def centre_fields(field: Array) -> FloatArray:
    """Return marker fields (..., 8, 252) as (..., 2, 8, 126) without their mean shift."""
    shapes = field.shape[:-2]
    split = field.astype(np.float64).reshape(*shapes, len(TICKS), 2, 2, GRID_ROWS * GRID_COLS)
    split = split - split.mean(axis=-1, keepdims=True)
    flat = split.reshape(*shapes, len(TICKS), 2, 2 * GRID_ROWS * GRID_COLS)
    return np.asarray(np.moveaxis(flat, -2, -3))


def field_components(field: Array) -> Array:
    """Return the principal components (2, MODES, 126) of the marker fields, per finger."""
    fingers = np.moveaxis(centre_fields(field), -3, 0).reshape(2, -1, 2 * GRID_ROWS * GRID_COLS)
    found = [np.linalg.eigh(finger.T @ finger)[1][:, ::-1][:, :MODES].T for finger in fingers]
    return np.stack(found).astype(np.float32)


# in x and y; the signals of a piece and its mirror image are equally likely
MIRRORS = ((False, False), (True, False), (False, True), (True, True))
MIRROR_SIGNS = tuple((-1.0 if x else 1.0, -1.0 if y else 1.0) for x, y in MIRRORS)


def mirror_signals(
    wrench: Array, field: Array, *, across_x: bool, across_y: bool
) -> tuple[Array, Array]:
    """Return the signals mirrored in x, y or both; the fingers close along y."""
    sx, sy = (-1.0 if across else 1.0 for across in (across_x, across_y))
    signs = np.array([sx, sy, 1.0, sy, sx, sx * sy], np.float32)
    split = field.reshape(*field.shape[:-1], 2, 2, GRID_ROWS, GRID_COLS)
    if across_y:
        split = split[..., ::-1, :, :, :]
    if across_x != across_y:
        split = split[..., ::-1] * np.array([-1.0, 1.0], field.dtype)[:, None, None]
    return wrench * signs, np.ascontiguousarray(split).reshape(field.shape)


ARCH: Final = "causal-attention-inset/1"
# point relative to the last probe and to the first one, and its distance
POINT_INPUTS = 5
OF_MIXTURE = 3  # weight, mean and standard deviation of each component


Size = Annotated[int, Field(ge=1, le=1024)]


@pydantic.dataclasses.dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class FusedShape:
    """Sizes of the network.

    ``layers`` of attention of ``width`` and ``heads`` over the probes, each followed by ``inner``
    units; the answer for a point is a mixture of ``parts`` normal distributions. ``networks`` of
    these sizes form an ensemble.
    """

    width: Size = 96
    heads: Size = 4
    layers: Annotated[int, Field(ge=1, le=8)] = 2
    inner: Size = 192
    parts: Annotated[int, Field(ge=1, le=16)] = 3
    networks: Annotated[int, Field(ge=1, le=8)] = 1


def expected_fused_arrays(shape: FusedShape) -> Mapping[str, tuple[int, ...]]:
    """Return name and shape of every array in a checkpoint: weights and three of the data.

    The weights of an ensemble have a first axis of networks.
    """
    first = (shape.networks,) if shape.networks > 1 else ()
    weights = {name: (*first, *size) for name, size in weight_shapes(shape).items()}
    return {**shared_arrays(), **weights}


def shared_arrays() -> dict[str, tuple[int, ...]]:
    """Return name and shape of the arrays of the data, which all networks share."""
    inputs = PROBE_INPUTS + PIECE_INPUTS
    return {"mean": (inputs,), "scale": (inputs,), "modes": (2, MODES, 126)}


def weight_shapes(shape: FusedShape) -> Mapping[str, tuple[int, ...]]:
    """Return name and shape of the trained weights of one network."""
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
