"""What is kept of the run in progress: its journal and its episodes, or neither."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from backend.catalogue.diskspace import NO_ROOM, room_for
from backend.core.clock import WallWatch
from backend.core.doing import SharedLock
from backend.core.facts import Fact, Said
from backend.core.faults import Fault, InputError
from backend.core.hub import Hub
from backend.devices.interlock import Interlock
from backend.runs.journal import Journal
from backend.runs.room import CONSEQUENCE, FULL, NEXT_STEP, no_room
from backend.runs.store import RunStore

MOST_HELD = 2000
"""So many facts wait for room at most; a run pauses long before."""
CLOCK_SET = (
    "The clock of this computer was set by {:+.0f} s, or it slept: no measurement goes by it."
)


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
        self._held: list[Fact] = []
        """Facts for which the disk has no room, in order."""
        self._lock = SharedLock()
        self._wall = WallWatch()
        self.store = RunStore(None, {})
        """Takes episodes; those of no run are not kept."""
        self.folder: Path | None = None

    def open(self, run_id: str) -> None:
        """Begin run ``run_id``; raises ``InputError`` where there is no room, or no folder."""
        self.close()
        self._wall = WallWatch()
        self.folder = None if self._keep.runs is None else self._keep.runs / run_id
        episodes = None
        if self.folder is not None:
            if self._keep.episodes:
                episodes = self.folder / "episodes"
                room_for(episodes, 1)
            self._journal = _new_journal(self.folder)
            self._leave = self._hub.subscribe(self._record)
        self.store = RunStore(episodes, {"run": run_id, "mode": self._mode}, self.obstacle)

    def obstacle(self) -> Fault | None:
        """Return what keeps the run from recording another probe, None if nothing does."""
        with self._lock:
            self._try_again()
            if self._held:
                what = "The run journal cannot be written: the disk is full."
                return Fault(
                    FULL, what, f"{CONSEQUENCE} What it did is kept in memory.", NEXT_STEP, "store"
                )
        if self.folder is None or not self._keep.episodes:
            return None
        return no_room(self.folder)

    def close(self) -> None:
        """Close journal and store of the last run, if any."""
        if self._leave is not None:
            self._leave()
        with self._lock:
            self._try_again()
            if self._journal is not None and self._held:
                lost = len(self._held)
                self._give_up(f"the disk is full, the last {lost} lines are lost")
            if self._journal is not None:
                self._journal.close()
            self._leave = self._journal = None
        store, self.store = self.store, RunStore(None, {})
        store.close()

    def _record(self, fact: Fact) -> None:
        """Append ``fact`` to the journal; where the disk has no room it is held until there is.

        A disk that refuses for another reason stops the run with a fault.
        """
        with self._lock:
            if self._journal is None:
                return
            if jump_s := self._wall.jump_s():
                self._held.append(Said(fact.t_s, CLOCK_SET.format(jump_s)))
            self._held.append(fact)
            self._write(mend=len(self._held) > 1)

    def _try_again(self) -> None:
        if self._held:
            self._write(mend=True)

    def _write(self, *, mend: bool) -> None:
        """Append what is held, the oldest first; what finds no room stays held."""
        if self._journal is None:
            return
        try:
            if mend:
                self._journal.mend()
            while self._held:
                self._journal(self._held[0])
                del self._held[0]
        except OSError as error:
            if error.errno not in NO_ROOM or len(self._held) > MOST_HELD:
                self._give_up(error.strerror or str(error))

    def _give_up(self, why: str) -> None:
        assert self._journal is not None
        journal, self._journal = self._journal, None
        self._held.clear()
        journal.abandon()
        self._interlock.raise_fault(
            Fault(
                "JOURNAL-FAILED",
                f"The run journal cannot be written: {why}.",
                "The run ends; every fact before is on disk, the gripper was not opened.",
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
