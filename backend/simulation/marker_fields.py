"""Simulated marker fields: displacement on both pads, sampled by the finger cameras.

Markers follow the elastic strain of the gel. Marker order is row-major, row 0 on top and column 0
on the left of the image; the right camera faces the opposite way, so that its u axis points along
-X. The field at a tick is interpolated between the last frame before and the first frame after it
(each with its own noise and lost markers), as in the assembly of an episode.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.config import SAMPLES_PER_PROBE, SimulationSettings, TactileSettings
from touchdown.backend.core import GRID_COLS, GRID_ROWS, MARKERS, FloatArray, fill_unseen_markers
from touchdown.backend.simulation.pressing import Timeline


@dataclass(frozen=True, slots=True)
class Gel:
    """Linear map from pad motion to image: ``map`` (2 fingers, 4, 63 * 2) in px.

    Its four inputs are e_x (mm), e_z (mm), e_θ (rad) and N / F_g - 1. With another number of inputs
    a timeline holds these, left finger first, in place of strains and pad forces. ``rest_px``
    (2, 63, 2): the straight rest grid in the 320x240 image.
    """

    map: FloatArray
    rest_px: FloatArray

    def displacement_px(
        self, strain: FloatArray, normal_n: FloatArray, grip_force_n: FloatArray
    ) -> FloatArray:
        """Return (..., 2, 63, 2) px. ``strain`` (..., 2, 3), ``normal_n`` (..., 2).

        ``grip_force_n`` must broadcast against ``normal_n[..., 0]``.
        """
        inputs = np.concatenate(
            [strain, (normal_n / np.asarray(grip_force_n)[..., None] - 1.0)[..., None]], axis=-1
        )
        field = (inputs[..., None, :] @ self.map)[..., 0, :]
        return np.asarray(field.reshape(*strain.shape[:-1], MARKERS, 2), dtype=np.float64)


def build_gel(
    mm_per_px: tuple[float, float],
    pitch_mm: float = 1.9,
    roll_off_mm: tuple[float, float] = (7.0, 6.0),
    dilation: float = 0.01,
) -> Gel:
    """Return the gel of two sensors with image scales ``mm_per_px`` (left, right)."""
    row, column = np.divmod(np.arange(MARKERS), GRID_COLS)
    z = (GRID_ROWS // 2 - row) * pitch_mm
    maps, rests = [], []
    for scale, facing in zip(mm_per_px, (1.0, -1.0), strict=True):
        x = facing * (column - GRID_COLS // 2) * pitch_mm
        phi = np.exp(-((x / roll_off_mm[0]) ** 4) - (z / roll_off_mm[1]) ** 4)
        nothing = np.zeros(MARKERS)
        d_x = np.stack([phi, nothing, z * phi, dilation * x])
        d_z = np.stack([nothing, phi, -x * phi, dilation * z])
        maps.append(np.stack([facing * d_x, -d_z], axis=-1).reshape(4, 2 * MARKERS) / scale)
        rests.append(np.stack([160.0 + facing * x / scale, 120.0 - z / scale], axis=-1))
    return Gel(np.stack(maps), np.stack(rests))


def gel_from_settings(settings: SimulationSettings) -> Gel:
    """Return the gel of the settings."""
    tactile = settings.tactile
    return build_gel(tactile.mm_per_px, tactile.pitch_mm, tactile.roll_off_mm, tactile.dilation)


FRAMES_PER_PRESS = 72  # frames per camera that cover any press at 25 Hz
LEAD_TIME_S = 0.25  # the first frame comes this long before first touch
IMAGE_PX = (320.0, 240.0)
# Duration of the drift up to each tick: from the reference, about 1.5 s before the press.
SINCE_REFERENCE_S = np.array([1.6] + (SAMPLES_PER_PROBE - 1) * [0.1])


@dataclass(frozen=True, slots=True)
class CameraDraw:
    """Random numbers of both cameras in one press.

    ``t_s`` (2, 72) frame times, inf where dropped; ``lost`` (2, 72, 63) bool; ``white_px``
    (20, 2, 2, 63, 2) tick, finger, frame before/after, marker, axis; ``drift_px`` (20, 2, 2).
    """

    t_s: FloatArray
    lost: NDArray[np.bool_]
    white_px: NDArray[np.float32]
    drift_px: FloatArray


def draw_camera(settings: TactileSettings, rng: np.random.Generator) -> CameraDraw:
    """Draw phases, jitter, drops, losses, noise and drift of one press."""
    period = 1.0 / settings.rate_hz
    phase = period * rng.random((2, 1))
    jitter = settings.jitter_s * (2.0 * rng.random((2, FRAMES_PER_PRESS)) - 1.0)
    dropped = rng.random((2, FRAMES_PER_PRESS)) < settings.drop_share
    t_s = phase + period * np.arange(FRAMES_PER_PRESS) - LEAD_TIME_S + jitter
    white = rng.standard_normal((SAMPLES_PER_PROBE, 2, 2, MARKERS, 2), dtype=np.float32)
    white *= np.float32(settings.white_px)
    steps = rng.standard_normal((SAMPLES_PER_PROBE, 2, 2))
    steps *= settings.drift_px_sqrt_s * np.sqrt(SINCE_REFERENCE_S)[:, None, None]
    return CameraDraw(
        np.where(dropped, np.inf, t_s), _draw_lost(settings, rng), white, np.cumsum(steps, axis=0)
    )


def _draw_lost(settings: TactileSettings, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return (2, 72, 63) markers lost in bursts of 1 to ``lost_frames`` frames."""
    lost = np.zeros((2, FRAMES_PER_PRESS, MARKERS), dtype=bool)
    mean_length = 0.5 * (1 + settings.lost_frames)
    bursts = int(rng.poisson(settings.lost_share / mean_length * lost.size))
    where = rng.integers(0, (2, FRAMES_PER_PRESS, MARKERS, settings.lost_frames), (bursts, 4))
    for finger, frame, marker, extra in where:
        lost[finger, frame : frame + extra + 1, marker] = True
    return lost


def frames_around_ticks(
    t_s: FloatArray, ticks_s: FloatArray
) -> tuple[NDArray[np.intp], FloatArray]:
    """Return frame indices (B, 2, 20, 2) before and after each tick, and weights of the same shape.

    ``t_s`` (B, 2, 72), inf where dropped; ``ticks_s`` (B, 20).
    """
    frames = np.arange(t_s.shape[-1])
    real = np.isfinite(t_s)
    past = t_s[:, :, None, :] <= ticks_s[:, None, :, None]
    before = np.where(past, frames, -1).max(axis=-1)
    after = np.where(real[:, :, None, :] & ~past, frames, t_s.shape[-1]).min(axis=-1)
    before = np.where(before < 0, after, before)
    after = np.where(after >= t_s.shape[-1], before, after)
    index = np.stack([before, after], axis=-1)
    rows = np.arange(len(t_s))[:, None, None, None]
    times = t_s[rows, np.arange(2)[:, None, None], index]
    gap = times[..., 1] - times[..., 0]
    late = ticks_s[:, None, :] - times[..., 0]
    share = np.where(gap > 0.0, late / np.where(gap > 0.0, gap, 1.0), 0.0)
    return index, np.stack([1.0 - share, share], axis=-1)


@dataclass(frozen=True, slots=True)
class PadImaging:
    """Imaging of B pads: ``gain`` (B, 2), ``bias_px`` (B, 2, 2), ``grip_force_n`` (B,).

    A marker nearer than ``border_px`` to the image border is not seen and filled in.
    """

    gel: Gel
    gain: FloatArray
    bias_px: FloatArray
    grip_force_n: FloatArray
    border_px: float


def fields_at_ticks(
    timeline: Timeline,
    air: FloatArray,
    ticks_s: FloatArray,
    draws: list[CameraDraw],
    sight: PadImaging,
) -> FloatArray:
    """Return (B, 20, 2, 63, 2) marker displacements in px, as in the model input.

    ``air`` (B, 14): values with the piece held in air (the reference).
    """
    t_s = np.stack([draw.t_s for draw in draws])
    index, weight = frames_around_ticks(t_s, ticks_s)
    count = len(draws)
    rows = np.arange(count)[:, None, None, None]
    fingers = np.arange(2)[None, :, None, None]
    frame_t = t_s[rows, fingers, index]
    values = timeline.at(frame_t.reshape(count, -1)).reshape(*index.shape, -1)
    moved = _inputs(values, sight) - _inputs(air[:, None, None, None, :], sight)
    moved = moved.reshape(count, 2, -1, sight.gel.map.shape[1])
    at_ticks = np.empty((count, SAMPLES_PER_PROBE, 2, MARKERS, 2))
    for k, draw in enumerate(draws):  # the fields of one probe stay in the cache
        at_frames = (moved[k] @ sight.gel.map).reshape(*index.shape[1:], MARKERS, 2)
        _image(at_frames, draw.lost[fingers[0], index[k]], draw, sight, sight.gain[k])
        at_frames *= weight[k, ..., None, None]
        np.add(at_frames[:, :, 0], at_frames[:, :, 1], out=at_ticks[k].swapaxes(0, 1))
        at_ticks[k] += sight.bias_px[k, None, :, None, :]
        at_ticks[k] += draw.drift_px[:, :, None, :]
    return at_ticks


def _image(
    field: FloatArray,
    lost: NDArray[np.bool_],
    draw: CameraDraw,
    sight: PadImaging,
    gain: FloatArray,
) -> None:
    """Image the ``field`` (2, 20, 2, 63, 2) of one probe in place; unseen markers are filled in."""
    at_px = sight.gel.rest_px[:, None, None] + field
    outside = at_px < sight.border_px
    outside |= at_px > np.array(IMAGE_PX) - sight.border_px
    lost |= outside[..., 0] | outside[..., 1]
    field *= gain[:, None, None, None, None]
    field += draw.white_px.swapaxes(0, 1)
    hurt = lost.any(axis=-1)
    if hurt.any():
        field[hurt] = fill_unseen_markers(field[hurt], ~lost[hurt])


def _inputs(values: FloatArray, sight: PadImaging) -> FloatArray:
    """Return (B, 2, ..., k) inputs of the gel map for each finger, from (B, 2, ..., 6 + 2 k)."""
    if sight.gel.map.shape[1] == 4:
        strain = values[..., 6:12].reshape(*values.shape[:-1], 2, 3)
        normal = values[..., 12:14] / sight.grip_force_n[:, None, None, None, None] - 1.0
        both = np.concatenate([strain, normal[..., None]], axis=-1)
    else:
        both = values[..., 6:].reshape(*values.shape[:-1], 2, -1)
    if values.shape[1] == 1:
        return np.asarray(both[:, 0].transpose(0, 3, 1, 2, 4), dtype=np.float64)
    return np.stack([both[:, 0, ..., 0, :], both[:, 1, ..., 1, :]], axis=1)
