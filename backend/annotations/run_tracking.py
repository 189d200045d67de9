"""Tracking of trainings and other runs of a dataset: parameters, metrics, artifacts, state.

One run is one folder (``runs/<uuid>/run.json``, ``metrics.jsonl``), complete after any crash; the
tables derive from the folders.
"""

from __future__ import annotations

import json
import math
import os
import platform
import sqlite3
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from hashlib import file_digest
from pathlib import Path
from typing import Any, Literal, Self, get_args

from touchdown.backend.annotations.consistency import ConsistencyProblem, DatasetParts, leftover
from touchdown.backend.annotations.database import Database
from touchdown.backend.annotations.values import uuid7
from touchdown.backend.core import (
    InputError,
    lock_file,
    make_folder,
    package_version,
    parse_json,
    program_stamp,
    sync_folder,
    write_atomically,
)


def hardware_info() -> dict[str, object]:
    """Return processor, memory and operating system of this computer."""
    return {"machine": platform.machine(), "cores": os.cpu_count(), "system": platform.system()}


def package_versions() -> dict[str, object]:
    """Return the versions of Python and of the packages that affect results."""
    versions = {name: package_version(name) for name in ("numpy", "torch")}
    return {"python": platform.python_version(), **versions}


RUNS_FOLDER = "runs"
ABOUT, METRICS_FILE, ALIVE = "run.json", "metrics.jsonl", "alive.lock"
FORMAT = 1

RunState = Literal["queued", "running", "finished", "failed", "cancelled", "interrupted"]


@dataclass(frozen=True, slots=True)
class Artifact:
    """A file made by a run; ``path`` is absolute, or relative to the dataset if it is inside."""

    name: str
    path: str
    sha256: str
    bytes: int


@dataclass(frozen=True, slots=True)
class RunInfo:
    """Content of ``run.json``.

    ``chain``: the newest label operation per site at the start. ``params``: JSON values.
    ``manifest``: hash of the data, "" if there is none. ``reason``: cause of a failure. Times are
    UTC.
    """

    uuid: str
    kind: str
    state: RunState
    started_ns: int
    seed: int
    program: str
    params: Mapping[str, Any]
    manifest: str = ""
    ended_ns: int | None = None
    reason: str = ""
    hardware: Mapping[str, Any] = field(default_factory=dict)
    environment: Mapping[str, Any] = field(default_factory=dict)
    chain: Mapping[str, Any] = field(default_factory=dict)
    artifacts: tuple[Artifact, ...] = ()


def write_run_info(folder: Path, about: RunInfo) -> None:
    """Write ``run.json`` durably."""
    content = {"format": FORMAT, **asdict(about)}
    write_atomically(folder / ABOUT, json.dumps(content, indent=1).encode("utf-8"))


def read_run_info(folder: Path) -> RunInfo:
    """Read ``run.json``; raises ``InputError`` with its path."""
    path = folder / ABOUT
    try:
        content = parse_json(path.read_bytes())
        if content.pop("format") != FORMAT or content["state"] not in get_args(RunState):
            raise ValueError("it is of another version")
        content["artifacts"] = tuple(Artifact(**made) for made in content["artifacts"])
        about = RunInfo(**content)
    except (OSError, ValueError, KeyError, TypeError) as error:
        fix = "Move the folder of this run out of the dataset."
        raise InputError(f"The run cannot be read: {error}.", str(path), fix) from error
    if about.uuid != folder.name:
        raise InputError("This run belongs to another folder.", str(path), "Move it back.")
    return about


def is_run_alive(folder: Path) -> bool:
    """Return True if a process is still working on the run in ``folder``."""
    path = folder / ALIVE
    if not path.exists():
        return False
    try:
        os.close(lock_file(path))
    except OSError:
        return True
    return False


class ActiveRun:
    """A run in progress; used as a context, it ends as cancelled or failed on an exception.

    Not thread-safe.
    """

    def __init__(self, dataset: Path, about: RunInfo) -> None:
        self._dataset = dataset
        self.about: RunInfo = about
        self.folder: Path = dataset / RUNS_FOLDER / about.uuid
        make_folder(self.folder.parent)
        self.folder.mkdir()
        # Locked before the files exist, so that a parallel check does not take it for a crash.
        self._alive: int | None = lock_file(self.folder / ALIVE)
        self._metrics = (self.folder / METRICS_FILE).open("w", encoding="utf-8")
        write_run_info(self.folder, about)
        sync_folder(self.folder.parent)

    @property
    def uuid(self) -> str:
        """Id of the run, also the name of its folder."""
        return self.about.uuid

    def metric(self, name: str, step: int, value: float) -> None:
        """Append one value; complete lines survive a crash of the process."""
        kept = value if math.isfinite(value) else None
        line = {"name": name, "step": step, "value": kept, "at_ns": time.time_ns()}
        self._metrics.write(json.dumps(line) + "\n")
        self._metrics.flush()

    def end_epoch(self) -> None:
        """Make all values so far durable."""
        os.fsync(self._metrics.fileno())

    def artifact(self, name: str, path: Path) -> None:
        """Record a file made by the run."""
        with path.open("rb") as file:
            digest = file_digest(file, "sha256").hexdigest()
        full, root = path.resolve(), self._dataset.resolve()
        place = full.relative_to(root) if full.is_relative_to(root) else full
        made = Artifact(name, place.as_posix(), digest, path.stat().st_size)
        self._write(artifacts=(*self.about.artifacts, made))

    def finish(self, manifest: str = "") -> None:
        """End the run as finished; ``manifest`` is the hash of its data."""
        self._end("finished", manifest=manifest)

    def cancel(self) -> None:
        """End the run as cancelled by a person."""
        self._end("cancelled")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        if error is None or isinstance(error, KeyboardInterrupt):
            self.cancel()
        else:
            self._end("failed", reason=str(error) or type(error).__name__)

    def _end(self, state: RunState, **more: str) -> None:
        if self._alive is None:
            return
        self.end_epoch()
        self._metrics.close()
        self._write(state=state, ended_ns=time.time_ns(), **more)
        os.close(self._alive)
        self._alive = None

    def _write(self, **changes: Any) -> None:
        self.about = replace(self.about, **changes)
        write_run_info(self.folder, self.about)


JSON_COLUMNS = ("hardware", "environment", "chain")
RUN_COLUMNS = (
    "uuid", "kind", "state", "started_ns", "seed", "program", "manifest", "ended_ns", "reason",
    *JSON_COLUMNS,
)  # fmt: skip


def sync_run_tables(folder: Path, database: Database) -> None:
    """Update the tables from the run folders; rows of a missing folder stay."""
    sql = "SELECT uuid, mark, read_bytes FROM run"
    known = {uuid: (mark, count) for uuid, mark, count in database.rows(sql)}
    for run in run_folders(folder):
        mark, size = run_file_stamp(run)
        if mark and known.get(run.name, ("", 0)) != (mark, size):
            try:
                about = read_run_info(run)
            except InputError:
                continue
            with database.transaction() as connection:
                _enter(connection, about, mark)
                _take_metrics(connection, run, known.get(run.name, ("", 0))[1])


def run_folders(folder: Path) -> list[Path]:
    """Return the run folders in the order of their start."""
    runs = folder / RUNS_FOLDER
    return sorted(path for path in runs.iterdir() if path.is_dir()) if runs.is_dir() else []


def run_file_stamp(run: Path) -> tuple[str, int]:
    """Return a stamp of ``run.json`` ("" if missing), and the size of the metrics in bytes."""
    try:
        about = (run / ABOUT).stat()
        mark = f"{about.st_mtime_ns}:{about.st_size}"
    except FileNotFoundError:
        mark = ""
    try:
        return mark, (run / METRICS_FILE).stat().st_size
    except FileNotFoundError:
        return mark, 0


def _enter(connection: sqlite3.Connection, about: RunInfo, mark: str) -> None:
    row = {name: getattr(about, name) for name in RUN_COLUMNS}
    row |= {name: json.dumps(row[name]) for name in JSON_COLUMNS} | {"mark": mark}
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
    """Copy the complete lines after byte ``start``; all lines if the file became shorter."""
    path = run / METRICS_FILE
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
        with suppress(ValueError, KeyError, TypeError):
            value = parse_json(line)
            row = (value["name"], value["step"], value["value"], value["at_ns"])
            rows.append((run.name, *row))
    connection.executemany("INSERT OR REPLACE INTO metric VALUES (?, ?, ?, ?, ?)", rows)
    sql = "UPDATE run SET read_bytes = ? WHERE uuid = ?"
    connection.execute(sql, (start + len(content), run.name))


@dataclass(frozen=True, slots=True)
class Metric:
    """One value of a run; ``value`` is NaN if it was not a number."""

    name: str
    step: int
    value: float
    at_ns: int


class RunTracker:
    """Runs of one dataset. Thread-safe.

    If the dataset is open for reading only, the tables are as the last writer left them.
    """

    def __init__(
        self, folder: Path, database: Database, heads: Callable[[], Mapping[str, Any]]
    ) -> None:
        self._folder, self._database, self._heads = folder, database, heads

    def begin(self, kind: str, *, seed: int, settings: Mapping[str, Any]) -> ActiveRun:
        """Begin a run of ``kind`` ("train", "evaluate" ...); ``settings``: JSON values.

        Writes files only, so it works while another program has the dataset open, and the run
        outlives this object.
        """
        about = RunInfo(
            uuid7(), kind, "running", time.time_ns(), seed, program_stamp(), dict(settings),
            hardware=hardware_info(), environment=package_versions(), chain=self._heads(),
        )  # fmt: skip
        return ActiveRun(self._folder, about)

    def entries(self, kind: str | None = None) -> list[RunInfo]:
        """Return the runs (of ``kind``), newest first."""
        return self._entries("kind = coalesce(?, kind) ORDER BY started_ns DESC", kind)

    def entry(self, uuid: str) -> RunInfo:
        """Return one run; raises ``InputError`` if there is no such run."""
        found = self._entries("uuid = ?", uuid)
        if not found:
            raise InputError("There is no such run.", uuid, "List the runs of the dataset.")
        return found[0]

    def metrics(self, uuid: str, name: str | None = None) -> list[Metric]:
        """Return the values of a run (of one name), ordered by name and step."""
        self._follow()
        sql = (
            "SELECT name, step, value, at_ns FROM metric WHERE run = ? AND name = coalesce(?, name)"
        )
        rows = self._database.rows(f"{sql} ORDER BY name, step", (uuid, name))
        return [Metric(n, s, math.nan if v is None else v, at_ns) for n, s, v, at_ns in rows]

    def _follow(self) -> None:
        if self._database.writable:
            sync_run_tables(self._folder, self._database)

    def _entries(self, where: str, value: str | None) -> list[RunInfo]:
        self._follow()
        sql = f"SELECT {', '.join(RUN_COLUMNS)} FROM run WHERE {where}"  # noqa: S608
        return [self._entry(row) for row in self._database.rows(sql, (value,))]

    def _entry(self, row: tuple[Any, ...]) -> RunInfo:
        values = dict(zip(RUN_COLUMNS, row, strict=True))
        values |= {name: parse_json(values[name]) for name in JSON_COLUMNS}
        uuid = values["uuid"]
        params = self._database.rows("SELECT key, value FROM param WHERE run = ?", (uuid,))
        sql = "SELECT name, path, sha256, bytes FROM artifact WHERE run = ?"
        made = tuple(Artifact(*each) for each in self._database.rows(sql, (uuid,)))
        return RunInfo(
            **values, params={key: parse_json(text) for key, text in params}, artifacts=made
        )


OPEN = ("queued", "running")


def check_runs(parts: DatasetParts) -> Iterator[ConsistencyProblem]:
    """Yield runs whose process is gone, and folders without a run."""
    for run in run_folders(parts.folder):
        if not (run / ABOUT).exists():
            if not is_run_alive(run) and not run_file_stamp(run)[1]:
                yield leftover(parts, run, "was left before its run began")
            continue
        try:
            about = read_run_info(run)
        except InputError as error:
            yield ConsistencyProblem("run-unreadable", parts.name(run), str(error))
            continue
        if about.state in OPEN and not is_run_alive(run):
            message = (
                f"The run {about.uuid} ({about.kind}) was interrupted: it can be started again."
            )
            if about.kind == "train" and "out" in about.params:
                message = (
                    f"The training of {about.params['out']} was interrupted; "
                    "its whole epochs are kept: go on with --resume."
                )
            yield ConsistencyProblem(
                "interrupted", about.uuid, message, partial(_interrupt, run, about)
            )
    for (uuid,) in parts.database.rows("SELECT uuid FROM run WHERE state IN (?, ?)", OPEN):
        if not (parts.folder / RUNS_FOLDER / uuid).is_dir():
            message = f"The folder of run {uuid} is gone; its figures so far are kept."
            yield ConsistencyProblem("interrupted", uuid, message, partial(_close, uuid))


def _close(uuid: str, connection: sqlite3.Connection) -> None:
    connection.execute("UPDATE run SET state = 'interrupted' WHERE uuid = ?", (uuid,))


def _interrupt(run: Path, about: RunInfo, _: sqlite3.Connection) -> None:
    lines = run / METRICS_FILE
    last_ns = lines.stat().st_mtime_ns if lines.exists() else about.started_ns
    write_run_info(run, replace(about, state="interrupted", ended_ns=last_ns))
