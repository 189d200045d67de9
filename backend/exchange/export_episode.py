"""Neutral episode that every export format writes: signals at 10 Hz, label, patch, images."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.backend import core, episodes
from touchdown.backend.annotations import CacheRow, Dataset, read_observation
from touchdown.backend.config import SAMPLES_PER_PROBE
from touchdown.backend.exchange import features
from touchdown.backend.exchange.query import SelectedEpisode
from touchdown.backend.exchange.video import HEIGHT, WIDTH


@dataclass(frozen=True, slots=True)
class ExportEpisode:
    """``values`` by feature: (20, ...), or (...) if constant. ``pictures``: 20 RGB per key."""

    chosen: SelectedEpisode
    values: Mapping[str, features.Values]
    pictures: Mapping[str, tuple[core.ImageArray, ...]]

    def per_tick(self, feature: features.Feature) -> features.Values:
        """Return ``feature`` as (20, ...), repeated if it is constant."""
        values = self.values[feature.key]
        return np.repeat(values[None], SAMPLES_PER_PROBE, axis=0) if feature.constant else values


def face_points(dataset: Dataset, chosen: Iterable[SelectedEpisode]) -> int:
    """Return the number of face points; raises ``InputError`` for episodes of several faces."""
    pairs = sorted({one.revision.geometry for one in chosen})
    faces = {name: dataset.geometry.read(name)["face"] for name in pairs}
    if len(set(faces.values())) != 1:
        pieces = sorted({one.entry.piece for one in chosen})
        what = f"The episodes belong to different grasped faces ({', '.join(pieces)})."
        fix = "Name one piece with --piece: this format has arrays of one size."
        raise core.InputError(what, str(dataset.folder), fix)
    return len(dataset.geometry.pair(pairs[0]).points_mm)


@dataclass(frozen=True, slots=True)
class ExportSignals:
    """Signals that all episodes of an export have.

    ``native``: the recorded signals, not only the observation; ``commanded``: also the commanded
    pose of the arm; ``scene``: pictures of the scene camera. ``robot``: kind of bench.
    ``state_with``: signals in the state besides the pose.
    """

    native: bool = False
    commanded: bool = False
    scene: bool = False
    robot: str = "touchdown"
    state_with: tuple[str, ...] = ()

    @property
    def cameras(self) -> tuple[str, ...]:
        """Keys of the pictures."""
        return (*features.PICTURES.values(), *([features.SCENE] if self.scene else ()))


def common_signals(dataset: Dataset, chosen: Iterable[SelectedEpisode]) -> ExportSignals:
    """Return the signals that all episodes have."""
    commanded, scene, modes = True, True, set[str]()
    for one in chosen:
        if one.entry.mode == "mass":
            return ExportSignals()
        first = episodes.read_first(dataset.folder / one.entry.path)
        if first.metadata["episode"]["recording"] != "native":
            return ExportSignals()
        commanded = commanded and episodes.COMMAND_TOPIC.name in first.messages
        scene = scene and f'"{episodes.HOMOGRAPHY_KEY}"' in first.metadata["pairs"]["items"]
        modes.add(
            str(
                core.parse_json(first.metadata["bench"].get(episodes.FACTS_KEY, "{}")).get(
                    "mode", ""
                )
            )
        )
    robot = "_".join(["touchdown", *(modes if len(modes) == 1 else ())]).rstrip("_")
    return ExportSignals(True, commanded, scene, robot)


def read_export(
    dataset: Dataset, one: SelectedEpisode, signals: ExportSignals, *, pictures: bool = False
) -> ExportEpisode:
    """Read one episode; ``pictures`` decodes the images nearest to the ticks, if any."""
    label = one.revision.label
    patch = dataset.geometry.patch(one.revision.geometry, label)
    values: dict[str, features.Values] = {
        features.OFFSET: label.offset_mm.astype(np.float32),
        features.PATCH: patch.touching.astype(np.uint8),
    }
    if one.entry.mode == "mass":
        return ExportEpisode(one, values | _observed(_packed(dataset, one)), {})
    path = dataset.folder / one.entry.path
    film = episodes.read_compressed_episode(path) if pictures else None
    # The first chunk holds everything but the images, in a twentieth of the file.
    episode = episodes.episode_of(episodes.read_first(path), path) if film is None else film.episode
    values |= _observed(episode.observation)
    if signals.native:
        assert episode.recording is not None
        values |= _recorded(episode.recording, episode.onset_s, commanded=signals.commanded)
        added = [values[key] for name, key in features.ADDED.items() if name in signals.state_with]
        if "environment_state" in signals.state_with:
            values[features.ENVIRONMENT] = np.concatenate(added, axis=1)
        else:
            values[features.STATE] = np.concatenate([values[features.STATE], *added], axis=1)
    shown = {} if film is None else _pictures(film)
    return ExportEpisode(one, values, {k: shown[k] for k in signals.cameras if k in shown})


def _packed(dataset: Dataset, one: SelectedEpisode) -> NDArray[np.float32]:
    place = dataset.database.first(
        "SELECT chunk_off, chunk_len FROM episode WHERE uuid = ?", (one.entry.uuid,)
    )
    assert place is not None
    row = CacheRow(one.entry.uuid, one.entry.sha256, one.revision.rev_uuid, one.entry.path,
                   (place[0], place[1]), 0, 0, one.revision.geometry)  # fmt: skip
    return read_observation(dataset.folder, row)


def _observed(observation: NDArray[np.float32]) -> dict[str, features.Values]:
    split = np.split(observation, [core.TACTILE_CHANNELS], axis=1)
    return {features.MARKERS: split[0].copy(), features.FT: split[1].copy()}


def _recorded(
    recording: core.Recording, onset_s: float, *, commanded: bool
) -> dict[str, features.Values]:
    """Return wrench windows and poses at the ticks, all times in integer ns since contact.

    The action is the commanded pose of the next tick; the measured pose if it is not known.
    """
    onset_ns = int(episodes.to_ns([onset_s])[0])
    ticks_ns = features.TICK_NS * np.arange(1, SAMPLES_PER_PROBE + 1)
    fine_ns = (features.TICK_NS // features.WINDOW) * np.arange(
        1, features.WINDOW * SAMPLES_PER_PROBE + 1
    )
    # Sample and hold: at 1 kHz these are the samples themselves, shifted by less than 1 ms.
    latest = (
        np.searchsorted(episodes.to_ns(recording.wrench_t_s) - onset_ns, fine_ns, side="right") - 1
    )
    wrench = recording.wrench[np.maximum(latest, 0)].astype(np.float32)
    at_ns = episodes.to_ns(recording.pose_t_s) - onset_ns
    xyz_mm = [np.interp(ticks_ns, at_ns, recording.pose_mm[:, axis]) for axis in range(3)]
    state = _poses(np.stack(xyz_mm, axis=1))
    action = np.concatenate([state[1:], state[-1:]])
    if commanded:
        told_ns = episodes.to_ns(recording.command_t_s) - onset_ns
        holds = np.searchsorted(told_ns, ticks_ns + features.TICK_NS, side="right") - 1
        action = _poses(recording.command_mm[np.maximum(holds, 0)])
    windows = wrench.reshape(SAMPLES_PER_PROBE, features.WINDOW, core.WRENCH_CHANNELS)
    return {features.FT_WINDOW: windows, features.STATE: state, features.ACTION: action}


def _poses(position_mm: core.FloatArray) -> NDArray[np.float32]:
    poses = np.zeros((len(position_mm), 7), dtype=np.float32)
    poses[:, :3] = position_mm / 1e3
    poses[:, 6] = 1.0
    return poses


def _pictures(film: episodes.CompressedEpisode) -> dict[str, tuple[core.ImageArray, ...]]:
    ticks_s = film.episode.onset_s + np.arange(1, SAMPLES_PER_PROBE + 1) / features.FPS
    found = {
        features.PICTURES[finger]: _nearest(
            film.pictures[finger].t_s, film.pictures[finger].picture, ticks_s
        )
        for finger in core.FINGERS
        if film.pictures[finger].packed
    }
    recording = film.episode.recording
    if recording is not None and recording.scene:
        scaled = (cv2.resize(one.image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
                  for one in recording.scene)  # fmt: skip
        shots = [image.astype(np.uint8) for image in scaled]
        at_s = np.array([one.t_s for one in recording.scene])
        found[features.SCENE] = _nearest(at_s, shots.__getitem__, ticks_s)
    return found


def _nearest(
    t_s: core.FloatArray, picture: Callable[[int], core.ImageArray], ticks_s: core.FloatArray
) -> tuple[core.ImageArray, ...]:
    index = np.abs(t_s[None, :] - ticks_s[:, None]).argmin(axis=1).tolist()
    decoded = {k: np.ascontiguousarray(picture(k)[:, :, ::-1]) for k in sorted(set(index))}
    return tuple(decoded[k] for k in index)
