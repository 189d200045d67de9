"""What a start finds out of order among the runs: those that nobody works on any more."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

from backend.catalogue.findings import Finding, Store
from backend.catalogue.run_folder import (
    ABOUT,
    METRICS,
    RUNS,
    About,
    is_alive,
    read_about,
    write_about,
)
from backend.catalogue.run_rows import mark_of, run_folders
from backend.core.faults import InputError

OPEN = ("queued", "running")


def check_runs(where: Store) -> Iterator[Finding]:
    """Yield the runs that nobody works on any more, and folders that hold none."""
    for run in run_folders(where.folder):
        if not (run / ABOUT).exists():
            if not is_alive(run) and not mark_of(run)[1]:
                said = f"{where.name(run)} was left before its run began: deleted."
                yield Finding("left-over", where.name(run), said, partial(_remove, run))
            continue
        try:
            about = read_about(run)
        except InputError as error:
            yield Finding("run-unreadable", where.name(run), str(error))
            continue
        if about.state in OPEN and not is_alive(run):
            said = f"The run {about.uuid} ({about.kind}) was interrupted: it can be begun again."
            if about.kind == "train" and "out" in about.params:
                said = (
                    f"The training of {about.params['out']} was interrupted; "
                    "its whole epochs are kept: go on with --resume."
                )
            yield Finding("interrupted", about.uuid, said, partial(_interrupt, run, about))
    yield from _gone(where)


def _gone(where: Store) -> Iterator[Finding]:
    """Yield the rows of runs that never ended and have no folder any more."""
    for (uuid,) in where.database.rows("SELECT uuid FROM run WHERE state IN (?, ?)", OPEN):
        if not (where.folder / RUNS / uuid).is_dir():
            said = f"The folder of run {uuid} is gone; its figures so far are kept."
            yield Finding("interrupted", uuid, said, partial(_close, uuid))


def _close(uuid: str, connection: sqlite3.Connection) -> None:
    connection.execute("UPDATE run SET state = 'interrupted' WHERE uuid = ?", (uuid,))


def _interrupt(run: Path, about: About, _: sqlite3.Connection) -> None:
    lines = run / METRICS
    last_ns = lines.stat().st_mtime_ns if lines.exists() else about.started_ns
    write_about(run, replace(about, state="interrupted", ended_ns=last_ns))


def _remove(run: Path, _: sqlite3.Connection) -> None:
    for path in run.iterdir():
        path.unlink()
    run.rmdir()
