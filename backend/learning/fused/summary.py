"""What the learned fusion reads of a probe: about two hundred numbers in place of 20 x 258.

The wrench at eight ticks; where the growth of the wrench acts (what the tare left does not reach
it); for each finger how much of a few typical marker fields there is beside a uniform shift, which
only says where the reference was taken; where the face was; the face and its centre of mass.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from backend.core.flow import GRID_COLS, GRID_ROWS, FloatArray

Array = NDArray[np.float32]
TICKS = (0, 1, 2, 4, 7, 10, 14, 19)
"""Of the 20; the force grows over the first 15."""
MODES = 4
"""Typical marker fields of a finger."""
SENSOR_MM = 120.0
"""Force sensor above the grasp pivot."""
GROWN = (3, 4, 5, 6, 7)
"""Of the eight: where the growth since the first one acts."""
LEAST_N, FARTHEST_MM = 1.0, 30.0
DIRECTIONS = 16
LENGTH_MM = 10.0
"""Unit of lengths in the network."""
PIECE_INPUTS = DIRECTIONS + 3
PROBE_INPUTS = len(TICKS) * (6 + 2 * MODES) + 2 * len(GROWN) + 4


@dataclass(frozen=True, slots=True)
class Face:
    """The grasped piece. ``reach_mm`` (..., 16): how far the face reaches from its centre of mass,
    from +x on counter-clockwise; ``com_mm`` (..., 2) in ``F``; ``grip_height_mm`` (...).
    """

    reach_mm: FloatArray
    com_mm: FloatArray
    grip_height_mm: FloatArray

    @classmethod
    def of(cls, points_mm: FloatArray, com_mm: FloatArray, grip_height_mm: FloatArray) -> Face:
        """Return the face that its lattice ``points_mm`` (..., k, 2) spans."""
        from_com = points_mm - com_mm[..., None, :]
        reach = (from_com @ directions().T).max(axis=-2)
        return cls(reach, com_mm, np.asarray(grip_height_mm))

    def mirrored(self, *, across_x: bool, across_y: bool) -> Face:
        """Return the face with x, y or both of the other sign."""
        at = np.arange(DIRECTIONS)
        at = DIRECTIONS // 2 - at if across_x else at
        at = -at if across_y else at
        signs = np.array([-1.0 if across_x else 1.0, -1.0 if across_y else 1.0])
        reach = self.reach_mm[..., at % DIRECTIONS]
        return Face(reach, self.com_mm * signs, self.grip_height_mm)

    def inputs(self) -> FloatArray:
        """Return (..., 19), lengths in ``LENGTH_MM``."""
        height = (self.grip_height_mm - 35.0)[..., None]
        joined = np.concatenate([self.reach_mm - LENGTH_MM, self.com_mm, height], axis=-1)
        return np.asarray(joined / LENGTH_MM, dtype=np.float64)


def directions() -> FloatArray:
    """Return (16, 2) unit vectors."""
    angle = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def probe_inputs(
    wrench: Array, field: Array, offset_mm: FloatArray, face: Face, modes: Array
) -> FloatArray:
    """Return (..., P, inputs) of P probes of one gripping in order.

    ``wrench`` (..., P, 8, 6) in N and N·m and ``field`` (..., P, 8, 252) in px at ``TICKS``,
    ``offset_mm`` (..., P, 2), ``modes`` (2, MODES, 126).
    """
    shapes = wrench.shape[:-2]
    seen = centred(field) @ modes.swapaxes(-1, -2).astype(np.float64)
    lever = (face.grip_height_mm + SENSOR_MM)[..., None, None]
    growth = np.asarray(wrench[..., GROWN, :] - wrench[..., :1, :], dtype=np.float64)
    acts = acting_mm(growth, lever) / LENGTH_MM
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


def acting_mm(growth: FloatArray, lever_mm: FloatArray) -> FloatArray:
    """Return (..., 2) where the growth (..., 6) of a wrench acts, in ``F``; 0 if there is none."""
    fx, fy, fz, tx, ty = np.moveaxis(growth[..., :5], -1, 0)
    press = np.maximum(fz, LEAST_N)
    at = np.stack([-(1e3 * ty + lever_mm * fx), 1e3 * tx - lever_mm * fy], axis=-1)
    at = np.where((fz >= LEAST_N)[..., None], at / press[..., None], 0.0)
    return np.asarray(np.clip(at, -FARTHEST_MM, FARTHEST_MM))


def felt_at(wrench: Array, sensor_mm: float) -> Array:
    """Return the wrench (..., 6) as a sensor ``SENSOR_MM`` above the pivot feels it, from one that
    is ``sensor_mm`` above: the lateral force turns about another lever.
    """
    moved = wrench.copy()
    lever_m = np.float32(1e-3 * (SENSOR_MM - sensor_mm))
    moved[..., 3] += lever_m * wrench[..., 1]
    moved[..., 4] -= lever_m * wrench[..., 0]
    return moved


def centred(field: Array) -> FloatArray:
    """Return marker fields (..., 8, 252) as (..., 2, 8, 126), their uniform shift taken out."""
    shapes = field.shape[:-2]
    split = field.astype(np.float64).reshape(*shapes, len(TICKS), 2, 2, GRID_ROWS * GRID_COLS)
    split = split - split.mean(axis=-1, keepdims=True)
    flat = split.reshape(*shapes, len(TICKS), 2, 2 * GRID_ROWS * GRID_COLS)
    return np.asarray(np.moveaxis(flat, -2, -3))


def typical_fields(field: Array) -> Array:
    """Return (2, MODES, 126): principal components of the marker fields (..., 8, 252) by finger."""
    fingers = np.moveaxis(centred(field), -3, 0).reshape(2, -1, 2 * GRID_ROWS * GRID_COLS)
    found = [np.linalg.eigh(finger.T @ finger)[1][:, ::-1][:, :MODES].T for finger in fingers]
    return np.stack(found).astype(np.float32)


def mirrored(wrench: Array, field: Array, *, across_x: bool, across_y: bool) -> tuple[Array, Array]:
    """Return what would be felt if x, y or both changed sign; the fingers close along y."""
    sx, sy = (-1.0 if across else 1.0 for across in (across_x, across_y))
    signs = np.array([sx, sy, 1.0, sy, sx, sx * sy], np.float32)
    split = field.reshape(*field.shape[:-1], 2, 2, GRID_ROWS, GRID_COLS)
    if across_y:
        split = split[..., ::-1, :, :, :]
    if across_x != across_y:
        split = split[..., ::-1] * np.array([-1.0, 1.0], field.dtype)[:, None, None]
    return wrench * signs, np.ascontiguousarray(split).reshape(field.shape)
