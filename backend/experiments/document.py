"""A report as values: what the page and the window show alike. Nothing is drawn here."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Entry:
    """One cell of a table: a value, its 95 % interval, lines below, and where it comes from.

    ``jobs``: folders below ``jobs/`` that hold what the cell was made from, none for a cell that is
    made of others; ``seed``: the first one's.
    """

    value: str
    interval: str = ""
    notes: tuple[str, ...] = ()
    jobs: tuple[str, ...] = ()
    seed: int | None = None

    @property
    def trace(self) -> str:
        """Say where the cell comes from; "" for one that is made of others."""
        if not self.jobs:
            return ""
        more = "" if len(self.jobs) == 1 else f" and {len(self.jobs) - 1} more"
        return f"job {self.jobs[0]}{more}" + ("" if self.seed is None else f", seed {self.seed}")


@dataclass(frozen=True, slots=True)
class Grid:
    """A table. ``columns``: name and what stands below it; each row: name, and an entry a column.

    ``note`` stands below the table.
    """

    title: str
    columns: tuple[tuple[str, str], ...]
    rows: tuple[tuple[str, tuple[Entry, ...]], ...]
    note: str = ""


@dataclass(frozen=True, slots=True)
class Picture:
    """``svg``: one element that needs nothing beside it; ``note`` stands below."""

    svg: str
    title: str = ""
    note: str = ""


@dataclass(frozen=True, slots=True)
class Gallery:
    """Pictures side by side, with a line below them."""

    title: str
    pictures: tuple[Picture, ...]
    text: str = ""
    end: str = ""


@dataclass(frozen=True, slots=True)
class Section:
    """One part of a report: a title, paragraphs, then tables and pictures in order."""

    title: str
    text: tuple[str, ...]
    parts: tuple[Grid | Gallery, ...]


@dataclass(frozen=True, slots=True)
class Report:
    """``banner``: what every reader must know first; ``about``: paragraphs before the sections."""

    title: str
    banner: str
    about: tuple[str, ...]
    sections: tuple[Section, ...]
