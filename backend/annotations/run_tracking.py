"""Tracking of trainings and other runs of a dataset: parameters, metrics, artifacts, state.

One run is one folder (``runs/<uuid>/run.json``, ``metrics.jsonl``), complete after any crash.
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

from touchdown.backend import core
from touchdown.backend.annotations.consistency import ConsistencyProblem, DatasetParts, leftover
from touchdown.backend.annotations.values import uuid7

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
    core.write_atomically(folder / ABOUT, json.dumps(content, indent=1).encode("utf-8"))


def read_run_info(folder: Path) -> RunInfo:
    """Read ``run.json``; raises ``InputError`` with its path."""
    path = folder / ABOUT
    fix = "Move the folder of this run out of the dataset."
    kinds = (OSError, ValueError, KeyError, TypeError)
    with core.errors_as_input("The run cannot be read", path, fix, *kinds):
        content = core.parse_json(path.read_bytes())
        if content.pop("format") != FORMAT or content["state"] not in get_args(RunState):
            raise ValueError("it is of another version")
        content["artifacts"] = tuple(Artifact(**made) for made in content["artifacts"])
        about = RunInfo(**content)
    if about.uuid != folder.name:
        raise core.InputError("This run belongs to another folder.", str(path), "Move it back.")
    return about


def is_run_alive(folder: Path) -> bool:
    """Return True if a process is still working on the run in ``folder``."""
    path = folder / ALIVE
    if not path.exists():
        return False
    try:
        os.close(core.lock_file(path))
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
        core.make_folder(self.folder.parent)
        self.folder.mkdir()
        # Locked before the files exist, so that a parallel check does not take it for a crash.
        self._alive: int | None = core.lock_file(self.folder / ALIVE)
        self._metrics = (self.folder / METRICS_FILE).open("w", encoding="utf-8")
        write_run_info(self.folder, about)
        core.sync_folder(self.folder.parent)

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


def run_folders(folder: Path) -> list[Path]:
    """Return the run folders in the order of their start."""
    runs = folder / RUNS_FOLDER
    return sorted(path for path in runs.iterdir() if path.is_dir()) if runs.is_dir() else []


@dataclass(frozen=True, slots=True)
class Metric:
    """One value of a run; ``value`` is NaN if it was not a number."""

    name: str
    step: int
    value: float
    at_ns: int


def read_metrics(run: Path) -> list[Metric]:
    """Return the values of a run, ordered by name and step; of one step the last is kept."""
    found: dict[tuple[str, int], Metric] = {}
    for line in core.read_json_lines(run / METRICS_FILE):
        with suppress(ValueError, KeyError, TypeError):
            value = math.nan if line["value"] is None else float(line["value"])
            metric = Metric(str(line["name"]), int(line["step"]), value, int(line["at_ns"]))
            found[metric.name, metric.step] = metric
    return [found[key] for key in sorted(found)]


class RunTracker:
    """Runs of one dataset. Thread-safe; reads the files of the runs at each call."""

    def __init__(self, folder: Path, heads: Callable[[], Mapping[str, Any]]) -> None:
        self._folder, self._heads = folder, heads

    def begin(self, kind: str, *, seed: int, settings: Mapping[str, Any]) -> ActiveRun:
        """Begin a run of ``kind`` ("train", "evaluate" ...); ``settings``: JSON values.

        Writes files only, so it works while another program has the dataset open, and the run
        outlives this object.
        """
        hardware = {
            "machine": platform.machine(), "cores": os.cpu_count(), "system": platform.system(),
        }  # fmt: skip
        packages = {name: core.package_version(name) for name in ("numpy", "torch")}
        about = RunInfo(
            uuid7(), kind, "running", time.time_ns(), seed, core.program_stamp(), dict(settings),
            hardware=hardware, environment={"python": platform.python_version(), **packages},
            chain=self._heads(),
        )  # fmt: skip
        return ActiveRun(self._folder, about)

    def entries(self, kind: str | None = None) -> list[RunInfo]:
        """Return the runs (of ``kind``), newest first; unreadable ones are left out."""
        found = []
        for run in run_folders(self._folder):
            with suppress(core.InputError):
                about = read_run_info(run)
                found += [about] if kind in (None, about.kind) else []
        return sorted(found, key=lambda about: about.started_ns, reverse=True)

    def entry(self, uuid: str) -> RunInfo:
        """Return one run; raises ``InputError`` if there is no such run."""
        found = [about for about in self.entries() if about.uuid == uuid]
        if not found:
            raise core.InputError("There is no such run.", uuid, "List the runs of the dataset.")
        return found[0]

    def metrics(self, uuid: str, name: str | None = None) -> list[Metric]:
        """Return the values of a run (of one name), ordered by name and step."""
        found = read_metrics(self._folder / RUNS_FOLDER / uuid)
        return [metric for metric in found if name in (None, metric.name)]


def check_runs(parts: DatasetParts) -> Iterator[ConsistencyProblem]:
    """Yield runs whose process is gone, and folders without a run."""
    for run in run_folders(parts.folder):
        if not (run / ABOUT).exists():
            lines = run / METRICS_FILE
            if not is_run_alive(run) and not (lines.exists() and lines.stat().st_size):
                yield leftover(parts, run, "was left before its run began")
            continue
        try:
            about = read_run_info(run)
        except core.InputError as error:
            yield ConsistencyProblem("run-unreadable", parts.name(run), str(error))
            continue
        if about.state in ("queued", "running") and not is_run_alive(run):
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


def _interrupt(run: Path, about: RunInfo, _: sqlite3.Connection) -> None:
    lines = run / METRICS_FILE
    last_ns = lines.stat().st_mtime_ns if lines.exists() else about.started_ns
    write_run_info(run, replace(about, state="interrupted", ended_ns=last_ns))
