"""Where a run is kept: one folder with an append-only journal and one file per episode."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from backend.catalogue.diskspace import NO_ROOM
from backend.core.doing import DISK_S, doing
from backend.core.faults import Fault, FaultError
from backend.core.files import make_folder
from backend.core.flow import Episode
from backend.dataset.episode_file import write_episode
from backend.runs.room import FULL


def data_folder() -> Path:
    """Return the folder of the operator's data: $TOUCHDOWN_DATA, else the XDG data folder."""
    chosen = os.environ.get("TOUCHDOWN_DATA")
    if chosen:
        return Path(chosen)
    base = os.environ.get("XDG_DATA_HOME") or str(Path.home() / ".local" / "share")
    return Path(base) / "touchdown"


def dataset_folder() -> Path:
    """Return the folder of the operator's usual dataset."""
    return data_folder() / "dataset"


def calibrations_folder() -> Path:
    """Return where the calibrations of a bench without a lab file are kept."""
    return data_folder() / "calibrations"


def models_folder() -> Path:
    """Return where the models in use are kept."""
    return data_folder() / "models"


class RunStore:
    """Writes episodes on one thread of its own, so that a run does not wait for the disk.

    ``settle`` returns only when the last episode is durable; a failed write raises there, and the
    episode is held for another try. ``obstacle``: what keeps the run from recording.
    """

    def __init__(
        self,
        folder: Path | None,
        metadata: Mapping[str, str],
        obstacle: Callable[[], Fault | None] = lambda: None,
    ) -> None:
        self._folder, self._metadata = folder, dict(metadata)
        self.obstacle = obstacle
        self._writer = ThreadPoolExecutor(1, thread_name_prefix="episode-writer")
        self._pending: Future[Path] | None = None
        self._newest: Episode | None = None
        """Not known to be on disk."""

    def keep(self, episode: Episode) -> None:
        """Begin to write ``episode`` (nothing is written where no folder was given)."""
        if self._folder is not None:
            self.settle()
            self._newest = episode
            self._begin(self._folder, episode)

    @property
    def written(self) -> bool:
        """Whether ``settle`` would return, or raise, at once."""
        return self._pending is None or self._pending.done()

    def settle(self) -> Path | None:
        """Wait until the last episode is on disk; return its path.

        Raises ``FaultError`` where the disk refused it; asked again it writes once more.
        """
        if self._pending is None and self._newest is not None and self._folder is not None:
            self._begin(self._folder, self._newest)
        pending, self._pending = self._pending, None
        try:
            with doing("waits for the disk", DISK_S):
                path = None if pending is None else pending.result()
        except OSError as error:
            raise FaultError(
                Fault(
                    FULL if error.errno in NO_ROOM else "EPISODE-FAILED",
                    f"The episode cannot be written: {error.strerror or error}.",
                    "The run ends; its journal and all earlier episodes are on disk.",
                    f"Make room on the disk of {self._folder}, then press Reset.",
                    "store",
                )
            ) from error
        self._newest = None
        return path

    def close(self) -> None:
        """Finish the last write and end the thread; what was refused before is let go."""
        try:
            if self._pending is not None:
                self.settle()
        finally:
            self._writer.shutdown(wait=True)

    def _begin(self, folder: Path, episode: Episode) -> None:
        self._pending = self._writer.submit(self._write, folder, episode)

    def _write(self, folder: Path, episode: Episode) -> Path:
        make_folder(folder)
        path = folder / f"{episode.episode_id}.mcap"
        write_episode(path, episode, label=None, metadata=self._metadata)
        return path
