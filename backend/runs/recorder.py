"""Recording of a run: event log, episode files, operator photos, wait for disk space.

Each run has a folder with an append-only log and one file per episode. When the disk fills up, the
run pauses before the next probe.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Generic, TypeVar

from touchdown.backend import core
from touchdown.backend.annotations import DISK_FULL_ERRNOS, check_free_space, free_bytes_if_low
from touchdown.backend.core import ClockJumpDetector
from touchdown.backend.devices import Interlock
from touchdown.backend.episodes import FACTS_KEY, START_KEY, write_episode
from touchdown.backend.runs.event_log import EventLog
from touchdown.backend.runs.plan import PausePoint, Plan

DISK_FULL = "DISK-FULL"
CONSEQUENCE = "The run is paused, the arm stands lifted; every probe so far is safe."
NEXT_STEP = "Make room on this disk, then resume (P)."
NOT_KEPT = "The run cannot be stored"
NOT_KEPT_FIX = "Name a folder that can be written (TOUCHDOWN_DATA; without the window also --runs)."


def wait_for_space(obstacle: Callable[[], core.Fault | None]) -> Plan[None]:
    """Pause until nothing prevents the run from recording."""
    while (fault := obstacle()) is not None:
        yield PausePoint(fault)


def no_space_fault(folder: Path) -> core.Fault | None:
    """Return the fault if there is too little space for another episode, else None."""
    short_bytes = free_bytes_if_low(folder)
    if short_bytes is None:
        return None
    what = f"Only {short_bytes / 1e9:.2f} GB are free on the disk of {folder}."
    return core.Fault(DISK_FULL, what, CONSEQUENCE, NEXT_STEP)


def refused_episode_fault(fault: core.Fault) -> core.Fault:
    """Return the fault of a probe that is kept in memory after a refused write."""
    return replace(fault, consequence=f"{CONSEQUENCE} The last one is kept in memory.",
                   next_step=NEXT_STEP)  # fmt: skip


def save_or_wait(save: Callable[[], None]) -> Plan[bool]:
    """Call ``save`` and return True; a full disk pauses the run until it succeeds.

    Raises ``FaultError`` or ``OSError`` for other errors of the disk.
    """
    while True:
        try:
            with core.blocking_section("waits for the disk", core.DISK_TIMEOUT_S):
                save()
        except core.FaultError as error:
            if error.fault.code != DISK_FULL:
                raise
            fault = error.fault
        except OSError as error:
            if error.errno not in DISK_FULL_ERRNOS:
                raise
            fault = core.Fault(DISK_FULL, "The disk is full.", "", "")
        else:
            return True
        yield PausePoint(replace(fault, consequence=CONSEQUENCE, next_step=NEXT_STEP))


def not_saved_fault(folder: Path, what: str, consequence: str, next_step: str) -> core.Fault:
    """Return the fault of a run that ended on a full disk without saving ``what``."""
    what = f"The disk of {folder} is full: {what} could not be saved."
    return core.Fault(DISK_FULL, what, consequence, f"Make room on this disk, {next_step}", "store")


def dataset_folder() -> Path:
    """Return the folder of the operator's default dataset."""
    return core.data_folder() / "dataset"


def calibrations_folder() -> Path:
    """Return the folder of the calibrations of a bench without a lab file."""
    return core.data_folder() / "calibrations"


def models_folder() -> Path:
    """Return the folder of the models in use."""
    return core.data_folder() / "models"


T = TypeVar("T")


class DiskWriter(Generic[T]):
    """Writes on its own thread, so that a run never waits for the disk; one write at a time.

    A failed write raises in ``settle`` and is kept for another attempt.
    """

    def __init__(self, name: str) -> None:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix=name)
        self._write: Callable[[], T] | None = None  # the last write until it is durable
        self._pending: Future[T] | None = None

    def begin(self, write: Callable[[], T]) -> None:
        """Start ``write``; the previous one must be settled."""
        self._write, self._pending = write, self._thread.submit(write)

    @property
    def pending(self) -> bool:
        """True if a write was begun whose result was not asked for."""
        return self._pending is not None

    @property
    def written(self) -> bool:
        """True if no write is in progress, so that ``settle`` returns or raises at once."""
        return self._pending is None or self._pending.done()

    def settle(self) -> T | None:
        """Return the result of the last write once it is durable; raises its error.

        The next call after an error writes again. Returns None if nothing is to be written.
        """
        if self._write is None:
            return None
        pending, self._pending = self._pending or self._thread.submit(self._write), None
        with core.blocking_section("waits for the disk", core.DISK_TIMEOUT_S):
            result = pending.result()
        self._write = None
        return result

    def close(self) -> None:
        """End the thread after the write in progress."""
        self._thread.shutdown(wait=True)


class RunStore(DiskWriter[Path]):
    """Writes the episodes of a run."""

    def __init__(
        self,
        folder: Path | None,
        metadata: Mapping[str, str],
        obstacle: Callable[[], core.Fault | None] = lambda: None,
    ) -> None:
        super().__init__("episode-writer")
        self._folder, self._metadata = folder, dict(metadata)
        self.started_ns = 0  # wall clock at bench time zero of the present scene
        self.obstacle = obstacle

    def keep(self, episode: core.Episode) -> None:
        """Start to write ``episode``; nothing is written without a folder."""
        if self._folder is not None:
            self.settle()
            self.begin(partial(self._write_file, self._folder, episode))

    def settle(self) -> Path | None:
        """Wait until the last episode is durable; return its path.

        Raises ``FaultError`` if the disk refused it; the next call writes it again.
        """
        try:
            return super().settle()
        except OSError as error:
            raise core.FaultError(
                core.Fault(
                    DISK_FULL if error.errno in DISK_FULL_ERRNOS else "EPISODE-FAILED",
                    f"The episode cannot be written: {error.strerror or error}.",
                    "The run ends; its event log and all earlier episodes are on disk.",
                    f"Make room on the disk of {self._folder}, then press Reset.",
                    "store",
                )
            ) from error

    def close(self) -> None:
        """Finish the last write and end the thread; a refused episode is dropped."""
        try:
            if self.pending:
                self.settle()
        finally:
            super().close()

    def _write_file(self, folder: Path, episode: core.Episode) -> Path:
        core.make_folder(folder)
        path = folder / f"{episode.episode_id}.mcap"
        metadata = {**self._metadata, START_KEY: str(self.started_ns)}
        write_episode(path, episode, label=None, metadata=metadata)
        return path


FOLDER = "photos"
PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png")
MAX_BYTES = 30_000_000
_BEGINS = (b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n")


def keep_photo(run: Path, trial: int, source: Path) -> Path:
    """Copy ``source`` into a run folder as a picture of ``trial``; return its path.

    Photos are numbered and never overwritten. Raises ``InputError`` naming the file.
    """
    fix = "Choose a JPEG or PNG picture below 30 MB."
    with core.disk_errors(
        "The picture cannot be kept", source, "Look at the file and at the disk."
    ):
        content = core.read_limited(source, MAX_BYTES, fix)
        if source.suffix.lower() not in PHOTO_SUFFIXES or not content.startswith(_BEGINS):
            raise core.InputError("This is no picture.", str(source), fix)
        name = f"trial-{trial:03d}-"
        taken = [p.stem.removeprefix(name) for p in (run / FOLDER).glob(f"{name}*")]
        number = max((int(word) for word in taken if word.isdecimal()), default=0) + 1
        path = run / FOLDER / f"{name}{number}{source.suffix.lower()}"
        core.write_atomically(path, content)
    return path


BOOKMARKS_NAME = "bookmarks.json"


@dataclass(frozen=True, slots=True, order=True)
class Bookmark:
    """Note on the time line of a trial; ``t_s`` is a time of the bench clock."""

    trial: int
    t_s: float
    note: str = ""


def read_bookmarks(path: Path) -> list[Bookmark]:
    """Return the bookmarks in a file in order, none without a file; raises ``InputError``."""
    try:
        found = core.parse_json(path.read_bytes())["bookmarks"] if path.is_file() else ()
        marks = [Bookmark(int(m["trial"]), float(m["t_s"]), str(m["note"])) for m in found]
        if not all(math.isfinite(mark.t_s) for mark in marks):
            raise ValueError("a time is not finite")
    except (OSError, ValueError, TypeError, KeyError, OverflowError) as error:
        fix = "Move the file away; the recording itself is not affected."
        raise core.InputError(
            f"The bookmarks cannot be read: {error!r}.", str(path), fix
        ) from error
    return sorted(marks)


def keep_bookmark(path: Path, mark: Bookmark) -> list[Bookmark]:
    """Store a bookmark in place of that at the same time; without a note only remove that.

    Return all bookmarks of the file, which is replaced as a whole. Raises ``InputError``.
    """
    place = mark.trial, mark.t_s
    marks = [one for one in read_bookmarks(path) if (one.trial, one.t_s) != place]
    marks = sorted([*marks, mark] if mark.note else marks)
    with core.disk_errors("The bookmark cannot be stored", path, "Make room on this disk."):
        core.write_atomically(path, json.dumps({"bookmarks": list(map(asdict, marks))}).encode())
    return marks


MOST_HELD = 2000  # most events kept in memory; a run pauses long before
CLOCK_SET = (
    "The clock of this computer was set by {:+.0f} s, or it slept: no measurement goes by it."
)


@dataclass(frozen=True, slots=True)
class RecordingOptions:
    """Folder of the runs (None: nothing is kept), and whether episode files are written."""

    runs: Path | None = None
    episodes: bool = True


class RunRecorder:
    """Opens and closes event log and episode store of a run; one run at a time."""

    def __init__(self, keep: RecordingOptions, hub: core.EventBus, interlock: Interlock) -> None:
        self._keep, self._hub, self._interlock = keep, hub, interlock
        self._log: EventLog | None = None
        self._leave: Callable[[], None] | None = None
        self._held: list[core.Event] = []  # events that did not fit on the disk, in order
        self._lock = core.SharedLock()
        self._wall = ClockJumpDetector()
        self.store = RunStore(None, {})  # discards episodes outside a run
        self._open = False
        self.folder: Path | None = None

    def check(self) -> None:
        """Raise ``InputError`` if the next run could not be kept."""
        if self._keep.runs is None:
            return
        with core.disk_errors(NOT_KEPT, self._keep.runs, NOT_KEPT_FIX):
            core.check_writable(self._keep.runs)
        if self._keep.episodes:
            check_free_space(self._keep.runs)

    def open(self, run_id: str, mode: str, facts: str) -> None:
        """Begin a run in ``mode``; ``facts``: the description of the bench as JSON.

        Raises ``InputError`` without space or a writable folder.
        """
        self.close()
        self._wall = ClockJumpDetector()
        self.folder = None if self._keep.runs is None else self._keep.runs / run_id
        episodes = None
        if self.folder is not None:
            if self._keep.episodes:
                episodes = self.folder / "episodes"
                check_free_space(episodes)
            with core.disk_errors(NOT_KEPT, self.folder.parent, NOT_KEPT_FIX):
                self._log = EventLog(self.folder)
            self._leave = self._hub.subscribe(self._record)
        metadata = {"run": run_id, "mode": mode, FACTS_KEY: facts}
        self.store, self._open = RunStore(episodes, metadata, self.obstacle), True

    def obstacle(self) -> core.Fault | None:
        """Return the fault that prevents recording another probe, None if there is none."""
        with self._lock:
            self._write()
            if self._held:
                what = "The event log cannot be written: the disk is full."
                kept = f"{CONSEQUENCE} What it did is kept in memory."
                return core.Fault(DISK_FULL, what, kept, NEXT_STEP, "store")
        if self.folder is None or not self._keep.episodes:
            return None
        return no_space_fault(self.folder)

    def close(self) -> None:
        """Close event log and store of the last run; an idle bench calls this at every step."""
        if not self._open:
            return
        if self._leave is not None:
            self._leave()
        with self._lock:
            self._write()
            if self._log is not None and self._held:
                lost = len(self._held)
                self._give_up(f"the disk is full, the last {lost} lines are lost")
            self._leave = self._log = None
        store, self.store, self._open = self.store, RunStore(None, {}), False
        store.close()

    def _record(self, event: core.Event) -> None:
        """Append ``event`` to the log; without disk space it is kept in memory.

        Other errors of the disk stop the run with a fault.
        """
        with self._lock:
            if self._log is None:
                return
            if jump_s := self._wall.jump_s():
                self._held.append(core.Said(event.t_s, CLOCK_SET.format(jump_s)))
            self._held.append(event)
            self._write()

    def _write(self) -> None:
        """Append the events in memory, the oldest first; the rest stays in memory."""
        if self._log is None or not self._held:
            return
        try:
            while self._held:
                self._log(self._held[0])
                del self._held[0]
        except OSError as error:
            if error.errno not in DISK_FULL_ERRNOS or len(self._held) > MOST_HELD:
                self._give_up(error.strerror or str(error))

    def _give_up(self, why: str) -> None:
        assert self._log is not None
        log, self._log = self._log, None
        self._held.clear()
        self._interlock.raise_fault(
            core.Fault(
                "JOURNAL-FAILED",
                f"The event log cannot be written: {why}.",
                "The run ends; every event before is on disk, the gripper was not opened.",
                f"Make room on the disk of {log.folder}, then press Reset.",
                "store",
            )
        )
