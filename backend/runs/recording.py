"""What is kept of the run in progress: its journal and its episodes, or neither."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from backend.core.facts import Fact
from backend.core.faults import Fault, InputError
from backend.core.hub import Hub
from backend.devices.interlock import Interlock
from backend.runs.journal import Journal
from backend.runs.store import RunStore


@dataclass(frozen=True, slots=True)
class Keep:
    """Where runs are kept (None: nowhere), and whether episodes are kept beside the journal."""

    runs: Path | None = None
    episodes: bool = True


class Recorder:
    """Opens journal and store of a run and closes them; one run at a time."""

    def __init__(self, keep: Keep, hub: Hub, interlock: Interlock, mode: str) -> None:
        self._keep, self._hub, self._interlock, self._mode = keep, hub, interlock, mode
        self._journal: Journal | None = None
        self._leave: Callable[[], None] | None = None
        self.store = RunStore(None, {})
        """Takes episodes; those of no run are not kept."""
        self.folder: Path | None = None

    def open(self, run_id: str) -> None:
        """Begin run ``run_id``; raises ``InputError`` where its folder cannot be written."""
        self.close()
        self.folder = None if self._keep.runs is None else self._keep.runs / run_id
        episodes = None
        if self.folder is not None:
            self._journal = _new_journal(self.folder)
            self._leave = self._hub.subscribe(self._record)
            episodes = self.folder / "episodes" if self._keep.episodes else None
        self.store = RunStore(episodes, {"run": run_id, "mode": self._mode})

    def close(self) -> None:
        """Close journal and store of the last run, if any."""
        if self._leave is not None:
            self._leave()
        if self._journal is not None:
            self._journal.close()
        self._leave = self._journal = None
        store, self.store = self.store, RunStore(None, {})
        store.close()

    def _record(self, fact: Fact) -> None:
        """Append ``fact`` to the journal; a disk that refuses stops the run with a fault."""
        if self._journal is None:
            return
        try:
            self._journal(fact)
        except OSError as error:
            journal, self._journal = self._journal, None
            journal.abandon()
            self._interlock.raise_fault(
                Fault(
                    "JOURNAL-FAILED",
                    f"The run journal cannot be written: {error.strerror or error}.",
                    "The run ends; every fact up to here is on disk, the gripper was not opened.",
                    f"Make room on the disk of {journal.folder}, then press Reset.",
                    "store",
                )
            )


def _new_journal(folder: Path) -> Journal:
    """Begin the journal of a run; raises ``InputError`` where the folder cannot be written."""
    try:
        return Journal(folder)
    except OSError as error:
        raise InputError(
            f"The run cannot be kept: {error.strerror or error}.",
            str(folder.parent),
            "Name a folder that can be written (--runs, or TOUCHDOWN_DATA).",
        ) from error
