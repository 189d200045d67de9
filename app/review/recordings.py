"""The list of recordings: runs and series of the dataset, filtered, sorted, said in a line each."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime
from pathlib import Path

from app.label.commits import Commits
from app.review.page import ReviewPage
from app.review.run_lines import read_run_line
from app.review.stored import Series
from backend.core.faults import InputError
from backend.runs.journal import NAME
from widgets.recording_list import RecordingRow

MOST_RUNS = 200
MOST_DESCRIBED = 50
"""So many of the newest runs say in the list what they were; older ones once they are opened."""
UNREAD = -1
"""Stands for the size of a journal that cannot be read."""
CANNOT = "cannot be read"


class Recordings:
    """Runs have the numbers from 0, newest first; the series of the dataset follow them.

    Everything is read on the thread of ``reader``; ``failed`` gets what went wrong there.
    """

    def __init__(
        self,
        page: ReviewPage,
        runs: Path,
        reader: Commits,
        series: Callable[[], list[Series]],
        failed: Callable[[Exception], None],
    ) -> None:
        self._page, self._runs, self._reader = page, runs, reader
        self._read_series, self._failed = series, failed
        self.folders: list[Path] = []
        self.series: list[Series] = []
        self._described: dict[Path, tuple[int, str]] = {}
        """Of a run: how long its journal was when it was described, and how."""
        self._to_describe: list[Path] = []
        self.describing = False
        """Whether lines of runs are still being read."""

    def refresh(self) -> None:
        """Look for recordings; what is chosen stays chosen."""
        self._page.empty.setText("No recordings yet. Every run of the Stack workspace is kept.")
        found = [p.parent for p in self._runs.glob(f"*/{NAME}")] if self._runs.is_dir() else []
        found = sorted(found, key=lambda p: p.name, reverse=True)[:MOST_RUNS]
        if found != self.folders:
            self._list(found, self.series)
        self._page.empty.setVisible(not found and not self.series)
        # One run after the other: what is chosen meanwhile does not wait for all of them.
        self._to_describe = found[:MOST_DESCRIBED]
        if not self.describing:
            self._describe_next()
        self._reader.submit(self._read_series, self._take_series, self._failed)

    def show(self) -> None:
        """Show what fits kind and filter, in the chosen order."""
        words, kind = self._page.filter.text().lower().split(), self._page.kind.currentData()
        order, rows = self._page.order.currentData(), self._page.runs.rows()
        found = [
            at
            for at, row in enumerate(rows)
            if (kind == "all" or (kind == "runs") == (at < len(self.folders)))
            and all(word in row.text.lower() for word in words)
        ]
        if order == "pair":
            found.sort(key=lambda at: rows[at].detail.removeprefix("series: "))
        elif order != "kind":
            found.sort(key=lambda at: rows[at].text, reverse=order == "newest")
        self._page.runs.show_order(found)

    def describe(self, at: int) -> None:
        """Have a run say what it was; read again only if its journal has grown."""
        self._to_describe.insert(0, self.folders[at])
        if not self.describing:
            self._describe_next()

    def _list(self, folders: list[Path], series: list[Series]) -> None:
        chosen = self._page.runs.current
        before: list[Path | str] = [*self.folders, *(one.name for one in self.series)]
        self.folders, self.series = folders, series
        now: list[Path | str] = [*folders, *(one.name for one in series)]
        self._page.runs.take([
            *(RecordingRow(run_title(f.name), self._described.get(f, (UNREAD, ""))[1])
              for f in folders),
            *(RecordingRow(*one.title.split("\n")) for one in series),
        ])  # fmt: skip
        if 0 <= chosen < len(before) and before[chosen] in now:
            self._page.runs.choose(now.index(before[chosen]))
        self.show()

    def _take_series(self, series: list[Series]) -> None:
        # The library hands out the same list as long as nothing changed.
        if series is not self.series:
            self._list(self.folders, series)
            self._page.empty.setVisible(not self.folders and not series)

    def _describe_next(self) -> None:
        self.describing = bool(self._to_describe)
        if not self._to_describe:
            self.show()
            return
        folder = self._to_describe.pop(0)
        known = self._described.get(folder, (UNREAD, ""))
        self._reader.submit(
            lambda: _described(folder, known),
            lambda said: self._say(folder, said),
            lambda _: self._say(folder, (UNREAD, CANNOT)),
        )

    def _say(self, folder: Path, said: tuple[int, str]) -> None:
        self._described[folder] = said
        if folder in self.folders:
            row = RecordingRow(run_title(folder.name), said[1])
            self._page.runs.show_row(self.folders.index(folder), row)
        self._describe_next()


def run_title(name: str) -> str:
    """Write a run's name as date and time where it is one."""
    try:
        when = datetime.strptime(name[:15], "%Y%m%d-%H%M%S")
    except ValueError:
        return name
    return f"{when:%Y-%m-%d  %H:%M:%S} UTC"


def _described(folder: Path, known: tuple[int, str]) -> tuple[int, str]:
    """Return length of a journal and what its run was; ``known`` if it is as long as then."""
    try:
        size = (folder / NAME).stat().st_size
        return known if size == known[0] else (size, read_run_line(folder).text())
    except (InputError, OSError):
        return UNREAD, CANNOT
