"""From a probe to a durable, labelled episode: the label is the displacement that was measured."""

from __future__ import annotations

import math
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from backend.catalogue.dataset import Dataset
from backend.catalogue.recording import with_uuid
from backend.catalogue.values import EpisodeContext, EpisodeEntry, Label
from backend.config.method import CollectSettings
from backend.core.doing import DISK_S, doing
from backend.core.flow import MARKERS, TACTILE_CHANNELS, Episode, FloatArray

MEASURED = "measured"


@dataclass(frozen=True, slots=True)
class Origin:
    """Where the centre of the bottom is for the arm, in mm, and its standard uncertainty."""

    x_mm: float
    y_mm: float
    sigma_mm: float


@dataclass(frozen=True, slots=True)
class Measured:
    """Displacement (2,) at contact, its standard uncertainty, and the height of contact, in mm."""

    offset_mm: FloatArray
    sigma_mm: float
    contact_mm: float

    def label(self) -> Label:
        """Return the label in whole µm."""
        x_um, y_um = np.rint(1e3 * self.offset_mm).astype(int).tolist()
        return Label(x_um, y_um, 0, round(1e3 * self.sigma_mm))


def measured(episode: Episode, origin: Origin, settings: CollectSettings) -> Measured:
    """Return where the arm really was at the contact onset, relative to ``origin``.

    The three uncertainties (arm, place of the bottom, piece in the grasp) are independent.
    """
    recording = episode.recording
    assert recording is not None
    x, y, z = (
        float(np.interp(episode.onset_s, recording.pose_t_s, recording.pose_mm[:, axis]))
        for axis in range(3)
    )
    sigma_mm = math.hypot(settings.arm_sigma_mm, origin.sigma_mm, settings.grip_sigma_mm)
    return Measured(np.array([x - origin.x_mm, y - origin.y_mm]), sigma_mm, z)


Signals = tuple[float, float, float, float, float]


def last_signals(observation: NDArray[np.float32]) -> Signals:
    """Return what the distribution is coloured by: marker shift u, v; Tx, Ty, Fz; last tick.

    ``observation`` (20, 258) as in ``Episode``.
    """
    last = np.asarray(observation[-1], dtype=np.float64)
    shifts = last[:TACTILE_CHANNELS].reshape(2, 2, MARKERS)
    u_px, v_px = (_largest(shifts[:, axis]) for axis in range(2))
    fz, tx, ty = (float(last[TACTILE_CHANNELS + channel]) for channel in (2, 3, 4))
    return u_px, v_px, tx, ty, fz


def _largest(values: FloatArray) -> float:
    """Return the value of the largest magnitude, with its sign; NaN where one is missing."""
    flat = values.ravel()
    return float(flat[np.argmax(np.abs(flat))])


class EpisodeRecorder:
    """Records into a dataset on one thread of its own, so that the bench waits for no disk."""

    def __init__(self, dataset: Dataset) -> None:
        self.dataset = dataset
        self._writer = ThreadPoolExecutor(1, thread_name_prefix="collect-writer")
        self._pending: Future[EpisodeEntry] | None = None
        self._newest: tuple[Episode, Label, EpisodeContext] | None = None

    def record(self, episode: Episode, label: Label, context: EpisodeContext) -> None:
        """Begin to record; the one before must have been settled."""
        assert self._pending is None
        # Its id is fixed here: whatever is tried again becomes the same episode, the same file.
        self._newest = with_uuid(episode), label, context
        self._pending = self._begin()

    @property
    def written(self) -> bool:
        """Whether ``settle`` would return, or raise, at once."""
        return self._pending is not None and self._pending.done()

    def settle(self) -> EpisodeEntry:
        """Return the entry of the last episode once it is durable; raises what prevented it.

        Asked again after that, it tries once more: the episode is still held.
        """
        pending, self._pending = self._pending or self._begin(), None
        with doing("waits for the disk", DISK_S):
            return pending.result()

    def _begin(self) -> Future[EpisodeEntry]:
        assert self._newest is not None
        episode, label, context = self._newest
        return self._writer.submit(
            self.dataset.record, episode, label, source=MEASURED, context=context
        )

    def close(self) -> None:
        """End the thread; an episode on its way is still written."""
        self._writer.shutdown(wait=True)
