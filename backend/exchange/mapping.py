"""What a foreign episode is here: observation, label and signals, or why it cannot be mapped."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from backend.catalogue.values import NO_LABEL, Label
from backend.config.method import SAMPLES_PER_PROBE
from backend.core.flow import (
    CHANNELS,
    FINGERS,
    TACTILE_CHANNELS,
    WRENCH_CHANNELS,
    FloatArray,
    Recording,
    TactileFrame,
)
from backend.exchange.features import (
    ACTION,
    FPS,
    FT,
    FT_WINDOW,
    MARKERS,
    OFFSET,
    PICTURES,
    STATE,
    TICK_NS,
    WINDOW,
)
from backend.exchange.foreign_episode import ForeignEpisode

FRAME_SHAPE = (240, 320, 3)
MAX_OFFSET_MM = 1000.0
MAX_NUMBER = 1 << 24


@dataclass(frozen=True, slots=True)
class Mapped:
    """A foreign episode as we keep it. ``recording``: its signals, None without a wrench."""

    foreign: ForeignEpisode
    observation: NDArray[np.float32]
    recording: Recording | None
    label: Label


def problem(foreign: ForeignEpisode) -> str:
    """Return why the episode cannot be mapped, or ""."""
    values = foreign.values
    if not 0 <= foreign.index < MAX_NUMBER:
        return "its number is out of range"
    needed = {MARKERS: TACTILE_CHANNELS, FT: WRENCH_CHANNELS}
    lacking = sorted(set(needed) - set(values))
    if lacking:
        return f"it lacks {', '.join(lacking)}"
    if foreign.fps is not None and foreign.fps != FPS:
        return f"it has {foreign.fps:g} ticks per second, not {FPS}"
    for key, width in needed.items():
        if values[key].shape != (SAMPLES_PER_PROBE, width):
            return f"{key} has shape {values[key].shape}, not ({SAMPLES_PER_PROBE}, {width})"
        if not np.isfinite(values[key].astype(np.float64)).all():
            return f"{key} holds a value that is not finite"
    return ""


def losses(foreign: ForeignEpisode) -> tuple[str, ...]:
    """Return what the file does not say, and what is taken for it."""
    said = []
    if foreign.fps is None:
        said.append(f"It names no rate: ticks are taken as {1000 // FPS} ms apart.")
    if not _has_signals(foreign.values):
        said.append("It has no wrench between the ticks and no poses: nothing is replayed there.")
    said.append("It has no marker fields at their own rate, no bench clock and no tare.")
    return tuple(said)


def mapped(foreign: ForeignEpisode, *, commanded: bool = False) -> Mapped:
    """Return what is kept of an episode without a ``problem``.

    ``commanded``: its action is known to be the commanded pose of the next tick.
    """
    observation = np.concatenate([foreign.values[MARKERS], foreign.values[FT]], axis=1)
    observation = np.ascontiguousarray(observation.astype(np.float32))
    assert observation.shape == (SAMPLES_PER_PROBE, CHANNELS)
    recording = _recording(foreign.values, commanded=commanded)
    return Mapped(foreign, observation, recording, _label(foreign.values))


def _has_signals(values: Mapping[str, NDArray[Any]]) -> bool:
    shapes = {
        FT_WINDOW: (SAMPLES_PER_PROBE, WINDOW, WRENCH_CHANNELS),
        STATE: (SAMPLES_PER_PROBE, 7),
    }
    return all(key in values and values[key].shape == shape for key, shape in shapes.items())


def _recording(values: Mapping[str, NDArray[Any]], *, commanded: bool) -> Recording | None:
    """Return the signals, times counted from the contact in whole ns."""
    if not _has_signals(values):
        return None
    fine_ns = (TICK_NS // WINDOW) * np.arange(1, WINDOW * SAMPLES_PER_PROBE + 1)
    ticks_s = np.asarray(1e-9 * TICK_NS * np.arange(1, SAMPLES_PER_PROBE + 1), dtype=np.float64)
    wrench: FloatArray = values[FT_WINDOW].reshape(-1, WRENCH_CHANNELS).astype(np.float64)
    pose_mm = _position_mm(values[STATE])
    told = commanded and ACTION in values and values[ACTION].shape == values[STATE].shape
    return Recording(
        wrench_t_s=np.asarray(fine_ns * 1e-9, dtype=np.float64),
        wrench=wrench,
        fields=(),
        frames=_frames(values, ticks_s),
        pose_t_s=ticks_s,
        pose_mm=pose_mm,
        tare=np.zeros(WRENCH_CHANNELS),
        command_t_s=np.asarray(ticks_s + 1e-9 * TICK_NS) if told else np.zeros(0),
        command_mm=_position_mm(values[ACTION]) if told else np.zeros((0, 3)),
    )


def _position_mm(poses: NDArray[Any]) -> FloatArray:
    """Return (n, 3) of poses (n, 7) in m."""
    return np.asarray(poses[:, :3].astype(np.float64) * 1e3, dtype=np.float64)


def _frames(values: Mapping[str, NDArray[Any]], ticks_s: FloatArray) -> tuple[TactileFrame, ...]:
    shape = (SAMPLES_PER_PROBE, *FRAME_SHAPE)
    fingers = [f for f in FINGERS if PICTURES[f] in values and values[PICTURES[f]].shape == shape]
    return tuple(
        TactileFrame(finger, k, float(t_s),
                     np.ascontiguousarray(values[PICTURES[finger]][k, :, :, ::-1], dtype=np.uint8))
        for k, t_s in enumerate(ticks_s)
        for finger in fingers
    )  # fmt: skip


def _label(values: Mapping[str, NDArray[Any]]) -> Label:
    """Return the offset that the file gives, in whole µm; without one, no label."""
    if OFFSET not in values or values[OFFSET].reshape(-1).size < 2:
        return NO_LABEL
    x_mm, y_mm = values[OFFSET].reshape(-1)[:2].astype(np.float64).tolist()
    if not (abs(x_mm) < MAX_OFFSET_MM and abs(y_mm) < MAX_OFFSET_MM):
        return NO_LABEL
    return Label(round(x_mm * 1e3), round(y_mm * 1e3))
