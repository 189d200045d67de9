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

MOST_DESCRIBED = 50
"""So many of the newest runs say in the list what they were; older ones once a filter asks for
words, or once they are opened."""
SHOWN_ANEW = 100
"""After so many described runs the filtered list is shown anew."""
UNREAD = -1
"""Stands for the size of a journal that cannot be read."""
CANNOT = "cannot be read"
LOOKING = "Looking for recordings \N{HORIZONTAL ELLIPSIS}"
NOTHING = "No recordings yet. Every run of the Stack workspace is kept."
UNLISTED = "The recordings cannot be listed."
NO_MATCH = "No recording fits filter and kind."


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
        self._titles: list[str] = []
        self._described: dict[Path, tuple[int, str]] = {}
        """Of a run: how long its journal was when it was described, and how."""
        self._to_describe: list[Path] = []
        self._awaited = 0
        """Looks at folders and dataset that have not ended."""
        self._trouble = False
        """Whether folders or dataset could not be looked at this time."""
        self._in_hand = False
        """Whether a run is just being described."""
        self._all_wanted = False
        """Whether older runs shall say, too, what they were."""

    @property
    def describing(self) -> bool:
        """Whether recordings are looked for, or lines of runs are still being read."""
        return self._awaited > 0 or self._in_hand

    def refresh(self) -> None:
        """Look for recordings; what is chosen stays chosen."""
        self._awaited, self._trouble = self._awaited + 2, False
        self._say_what_is_there()
        known = self.folders
        self._reader.submit(
            lambda: _looked_for(self._runs, known), self._take_runs, self._could_not_look
        )
        self._reader.submit(self._read_series, self._take_series, self._could_not_look)

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
        if (words or order == "pair") and not self._all_wanted:
            self._all_wanted = True
            self._to_describe += self.folders[MOST_DESCRIBED:]
            self._describe_next()
        self._say_what_is_there()

    def describe(self, at: int) -> None:
        """Have a run say what it was; read again only if its journal has grown."""
        self._to_describe.insert(0, self.folders[at])
        self._describe_next()

    def _list(self, folders: list[Path], titles: list[str], series: list[Series]) -> None:
        chosen = self._page.runs.current
        before: list[Path | str] = [*self.folders, *(one.name for one in self.series)]
        self.folders, self._titles, self.series = folders, titles, series
        now: list[Path | str] = [*folders, *(one.name for one in series)]
        self._page.runs.take([
            *(RecordingRow(title, self._described.get(folder, (UNREAD, ""))[1])
              for folder, title in zip(folders, titles, strict=True)),
            *(RecordingRow(*one.title.split("\n")) for one in series),
        ])  # fmt: skip
        if 0 <= chosen < len(before) and before[chosen] in now:
            self._page.runs.choose(now.index(before[chosen]))
        self.show()

    def _take_runs(self, found: tuple[list[Path], list[str]]) -> None:
        self._awaited -= 1
        folders, titles = found
        # The very same list where nothing changed: thousands are not compared here.
        if folders is not self.folders:
            self._list(folders, titles, self.series)
        # One run after the other: what is chosen meanwhile does not wait for all of them.
        older = folders[MOST_DESCRIBED:] if self._all_wanted else []
        self._to_describe = folders[:MOST_DESCRIBED]
        self._to_describe += [folder for folder in older if folder not in self._described]
        self._describe_next()
        self._say_what_is_there()

    def _take_series(self, series: list[Series]) -> None:
        self._awaited -= 1
        # The library hands out the same list as long as nothing changed.
        if series is not self.series:
            self._list(self.folders, self._titles, series)
        self._say_what_is_there()

    def _could_not_look(self, error: Exception) -> None:
        self._awaited -= 1
        self._trouble = True
        self._say_what_is_there()
        self._failed(error)

    def _describe_next(self) -> None:
        if self._in_hand or not self._to_describe:
            return
        self._in_hand = True
        folder = self._to_describe.pop(0)
        known = self._described.get(folder, (UNREAD, ""))
        self._reader.submit(
            lambda: _described(folder, known),
            lambda said: self._say(folder, said),
            lambda _: self._say(folder, (UNREAD, CANNOT)),
        )

    def _say(self, folder: Path, said: tuple[int, str]) -> None:
        self._in_hand = False
        self._described[folder] = said
        if folder in self.folders:
            at = self.folders.index(folder)
            self._page.runs.show_row(at, RecordingRow(self._titles[at], said[1]))
        self._describe_next()
        if len(self._to_describe) % SHOWN_ANEW == 0:
            self.show()

    def _say_what_is_there(self) -> None:
        """Say why the list is empty, if it is, and how many runs are still to be read."""
        page, left = self._page, len(self._to_describe)
        page.runs_panel.detail.setText(f"{left:,} to read" if left > MOST_DESCRIBED else "")
        there = bool(self.folders or self.series)
        if (self._awaited and not there) or (self.describing and not page.runs.shown()):
            page.empty.setText(LOOKING)
        else:
            page.empty.setText(NO_MATCH if there else UNLISTED if self._trouble else NOTHING)
        page.empty.setVisible(not page.runs.shown())


def _looked_for(runs: Path, known: list[Path]) -> tuple[list[Path], list[str]]:
    """Return the runs of a folder, newest first, with their titles; ``known`` if it is the same."""
    found = [path.parent for path in runs.glob(f"*/{NAME}")] if runs.is_dir() else []
    found.sort(key=lambda folder: folder.name, reverse=True)
    found = known if found == known else found
    return found, [run_title(folder.name) for folder in found]


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
