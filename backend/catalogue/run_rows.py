"""The tables of runs follow the folders of runs."""

from __future__ import annotations

import json
import sqlite3
from dataclasses import asdict
from pathlib import Path

from backend.catalogue.database import Database
from backend.catalogue.run_folder import ABOUT, METRICS, RUNS, About, read_about
from backend.core.faults import InputError

COLUMNS = (
    "uuid", "kind", "state", "started_ns", "seed", "program", "manifest", "ended_ns", "reason",
    "hardware", "environment", "chain",
)  # fmt: skip


def follow(folder: Path, database: Database) -> None:
    """Bring the tables up to what the folders of the runs say.

    The rows of a folder that is gone stay.
    """
    sql = "SELECT uuid, mark, read_bytes FROM run"
    known = {uuid: (mark, count) for uuid, mark, count in database.rows(sql)}
    for run in run_folders(folder):
        mark, size = mark_of(run)
        if mark and known.get(run.name, ("", 0)) != (mark, size):
            try:
                about = read_about(run)
            except InputError:
                continue
            with database.transaction() as connection:
                _enter(connection, about, mark)
                _take_metrics(connection, run, known.get(run.name, ("", 0))[1])


def run_folders(folder: Path) -> list[Path]:
    """Return the folders of runs, in the order in which they were begun."""
    runs = folder / RUNS
    return sorted(path for path in runs.iterdir() if path.is_dir()) if runs.is_dir() else []


def mark_of(run: Path) -> tuple[str, int]:
    """Return what tells one state of ``run.json`` from another ("" without it).

    And how many bytes of metrics there are.
    """
    try:
        about = (run / ABOUT).stat()
        mark = f"{about.st_mtime_ns}:{about.st_size}"
    except FileNotFoundError:
        mark = ""
    try:
        return mark, (run / METRICS).stat().st_size
    except FileNotFoundError:
        return mark, 0


def _enter(connection: sqlite3.Connection, about: About, mark: str) -> None:
    row = {name: getattr(about, name) for name in COLUMNS}
    for name in ("hardware", "environment", "chain"):
        row[name] = json.dumps(row[name])
    row["mark"] = mark
    names = ", ".join(row)
    values = ", ".join(f":{name}" for name in row)
    changes = ", ".join(f"{name} = excluded.{name}" for name in row if name != "uuid")
    connection.execute(
        f"INSERT INTO run ({names}, read_bytes) VALUES ({values}, 0)"  # noqa: S608
        f" ON CONFLICT (uuid) DO UPDATE SET {changes}",
        row,
    )
    params = [(about.uuid, key, json.dumps(value)) for key, value in about.params.items()]
    connection.executemany("INSERT OR REPLACE INTO param VALUES (?, ?, ?)", params)
    made = [(about.uuid, *asdict(each).values()) for each in about.artifacts]
    connection.executemany("INSERT OR REPLACE INTO artifact VALUES (?, ?, ?, ?, ?)", made)


def _take_metrics(connection: sqlite3.Connection, run: Path, start: int) -> None:
    """Copy the whole lines after byte ``start``; all of them if there are fewer bytes by now."""
    path = run / METRICS
    if not path.exists():
        return
    if path.stat().st_size < start:
        connection.execute("DELETE FROM metric WHERE run = ?", (run.name,))
        start = 0
    with path.open("rb") as file:
        file.seek(start)
        content = file.read()
    content = content[: content.rfind(b"\n") + 1]
    rows = []
    for line in content.splitlines():
        try:
            said = json.loads(line)
            row = (said["name"], said["step"], said["value"], said["at_ns"])
        except (ValueError, KeyError, TypeError):
            continue
        rows.append((run.name, *row))
    connection.executemany("INSERT OR REPLACE INTO metric VALUES (?, ?, ?, ?, ?)", rows)
    sql = "UPDATE run SET read_bytes = ? WHERE uuid = ?"
    connection.execute(sql, (start + len(content), run.name))
