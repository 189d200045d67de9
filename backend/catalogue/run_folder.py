"""One run on disk: ``runs/<uuid>/run.json`` and ``metrics.jsonl``, complete after any crash.

Whoever does the work writes these files, without the catalogue: a training started from the
command line does not wait for the window that has the dataset open. The catalogue's tables follow.
A locked file says that the run lives; the system frees it at any death.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from hashlib import sha256
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self, get_args

from backend.core.faults import InputError
from backend.core.files import make_folder, sync_folder, write_atomically
from backend.core.locks import lock_file

RUNS = "runs"
ABOUT, METRICS, ALIVE = "run.json", "metrics.jsonl", "alive.lock"
FORMAT = 1

RunState = Literal["queued", "running", "finished", "failed", "cancelled", "interrupted"]


@dataclass(frozen=True, slots=True)
class Artifact:
    """A file that a run made; ``path`` is absolute, or relative to the dataset within it."""

    name: str
    path: str
    sha256: str
    bytes: int


@dataclass(frozen=True, slots=True)
class About:
    """What ``run.json`` says. ``chain``: the newest label operation per site when it began.

    ``params``: JSON values. ``manifest``: hash of what it worked on, "" if it has none.
    ``reason``: why it failed. Times are UTC.
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


def write_about(folder: Path, about: About) -> None:
    """Write ``run.json`` durably."""
    content = {"format": FORMAT, **asdict(about)}
    write_atomically(folder / ABOUT, json.dumps(content, indent=1).encode("utf-8"))


def read_about(folder: Path) -> About:
    """Read ``run.json``; raises ``InputError`` naming it."""
    path = folder / ABOUT
    try:
        content = json.loads(path.read_text("utf-8"))
        if content.pop("format") != FORMAT or content["state"] not in get_args(RunState):
            raise ValueError("it is of another version")
        content["artifacts"] = tuple(Artifact(**made) for made in content["artifacts"])
        about = About(**content)
    except (OSError, ValueError, KeyError, TypeError) as error:
        fix = "Move the folder of this run out of the dataset."
        raise InputError(f"The run cannot be read: {error}.", str(path), fix) from error
    if about.uuid != folder.name:
        raise InputError("This run belongs to another folder.", str(path), "Move it back.")
    return about


def is_alive(folder: Path) -> bool:
    """Whether a process still works on the run in ``folder``."""
    path = folder / ALIVE
    if not path.exists():
        return False
    try:
        os.close(lock_file(path))
    except OSError:
        return True
    return False


class LiveRun:
    """A run while it goes on; as a context it ends as cancelled or failed where nothing else did.

    Not for several threads at once.
    """

    def __init__(self, dataset: Path, about: About) -> None:
        self._dataset, self.about = dataset, about
        self.folder = dataset / RUNS / about.uuid
        make_folder(self.folder.parent)
        self.folder.mkdir()
        # Alive before there is anything to find: a check beside us must not take it for a crash.
        self._alive: int | None = lock_file(self.folder / ALIVE)
        self._metrics = (self.folder / METRICS).open("w", encoding="utf-8")
        write_about(self.folder, about)
        sync_folder(self.folder.parent)

    @property
    def uuid(self) -> str:
        """Id of the run, and name of its folder."""
        return self.about.uuid

    def metric(self, name: str, step: int, value: float) -> None:
        """Append one value; whole lines survive the death of this process."""
        kept = value if math.isfinite(value) else None
        line = {"name": name, "step": step, "value": kept, "at_ns": time.time_ns()}
        self._metrics.write(json.dumps(line) + "\n")
        self._metrics.flush()

    def end_epoch(self) -> None:
        """Make all values so far survive a loss of power."""
        os.fsync(self._metrics.fileno())

    def artifact(self, name: str, path: Path) -> None:
        """Note a file that the run made."""
        with path.open("rb") as file:
            digest = sha256()
            while block := file.read(1 << 20):
                digest.update(block)
        full, root = path.resolve(), self._dataset.resolve()
        place = full.relative_to(root) if full.is_relative_to(root) else full
        made = Artifact(name, place.as_posix(), digest.hexdigest(), path.stat().st_size)
        self._write(artifacts=(*self.about.artifacts, made))

    def name_data(self, manifest: str) -> None:
        """Note the hash of what it works on, where that is known only now."""
        self._write(manifest=manifest)

    def finish(self) -> None:
        """End it: it did what it was asked for."""
        self._end("finished")

    def fail(self, reason: str) -> None:
        """End it: it could not go on; ``reason`` is a sentence."""
        self._end("failed", reason)

    def cancel(self) -> None:
        """End it: a person asked for that."""
        self._end("cancelled")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        if error is None or isinstance(error, KeyboardInterrupt):
            self.cancel()
        else:
            self.fail(str(error) or type(error).__name__)

    def _end(self, state: RunState, reason: str = "") -> None:
        if self._alive is None:
            return
        self.end_epoch()
        self._metrics.close()
        self._write(state=state, reason=reason, ended_ns=time.time_ns())
        os.close(self._alive)
        self._alive = None

    def _write(self, **changes: Any) -> None:
        self.about = replace(self.about, **changes)
        write_about(self.folder, self.about)
