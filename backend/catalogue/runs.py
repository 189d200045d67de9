"""Trainings and other runs of one dataset: their folders, and the tables that follow these.

Rows are brought up to date by whoever has the dataset open for writing: at a start, and at each
look at the runs.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from backend.catalogue.database import Database
from backend.catalogue.program import environment, hardware
from backend.catalogue.run_folder import About, Artifact, LiveRun
from backend.catalogue.run_rows import COLUMNS, follow
from backend.catalogue.uuid7 import uuid7
from backend.core.faults import InputError
from backend.core.program import program

_ALL = ", ".join(COLUMNS)


@dataclass(frozen=True, slots=True)
class Metric:
    """One value of a run; ``value`` is NaN where it was no number."""

    name: str
    step: int
    value: float
    at_ns: int


class RunBook:
    """The runs of one dataset; every call may come from any thread.

    Where the dataset is open for reading only, what is told is as its last writer left it.
    """

    def __init__(
        self, folder: Path, database: Database, heads: Callable[[], Mapping[str, Any]]
    ) -> None:
        self._folder, self._database, self._heads = folder, database, heads

    def begin(
        self, kind: str, *, seed: int, settings: Mapping[str, Any], manifest: str = ""
    ) -> LiveRun:
        """Begin a run of ``kind`` ("train", "evaluate" ...); ``settings``: JSON values.

        ``manifest``: hash of the exact data it works on. Writes files only, so that it may be
        called where another program has the dataset open, and used after this one is closed.
        """
        about = About(
            uuid7(), kind, "running", time.time_ns(), seed, program(), dict(settings), manifest,
            hardware=hardware(), environment=environment(), chain=self._heads(),
        )  # fmt: skip
        return LiveRun(self._folder, about)

    def entries(self, kind: str | None = None) -> list[About]:
        """Return the runs (of ``kind``), the newest first."""
        self._follow()
        sql = f"SELECT {_ALL} FROM run WHERE kind = coalesce(?, kind) ORDER BY started_ns DESC"  # noqa: S608
        return [self._entry(row) for row in self._database.rows(sql, (kind,))]

    def entry(self, uuid: str) -> About:
        """Return one run; raises ``InputError`` if there is none of that id."""
        self._follow()
        sql = f"SELECT {_ALL} FROM run WHERE uuid = ?"  # noqa: S608
        row = self._database.first(sql, (uuid,))
        if row is None:
            raise InputError("There is no such run.", uuid, "List the runs of the dataset.")
        return self._entry(row)

    def metrics(self, uuid: str, name: str | None = None) -> list[Metric]:
        """Return the values of a run (of one name), by name and step."""
        self._follow()
        sql = (
            "SELECT name, step, value, at_ns FROM metric WHERE run = ? AND name = coalesce(?, name)"
        )
        rows = self._database.rows(f"{sql} ORDER BY name, step", (uuid, name))
        return [Metric(n, s, math.nan if v is None else v, at_ns) for n, s, v, at_ns in rows]

    def _follow(self) -> None:
        """Bring the tables up to date."""
        if self._database.writable:
            follow(self._folder, self._database)

    def _entry(self, row: tuple[Any, ...]) -> About:
        values = dict(zip(COLUMNS, row, strict=True))
        for name in ("hardware", "environment", "chain"):
            values[name] = json.loads(values[name])
        uuid = values["uuid"]
        params = self._database.rows("SELECT key, value FROM param WHERE run = ?", (uuid,))
        sql = "SELECT name, path, sha256, bytes FROM artifact WHERE run = ?"
        made = tuple(Artifact(*each) for each in self._database.rows(sql, (uuid,)))
        return About(
            **values, params={key: json.loads(text) for key, text in params}, artifacts=made
        )
