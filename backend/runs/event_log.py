"""Append-only logs in JSON lines: events of a run, changes of the limits of a bench.

Each line is durable before the next one. Arrays become ``{"shape", "dtype", "data"}`` with base64
of little-endian bytes. A float that is not finite becomes the text ``nan``, ``inf`` or ``-inf``, so
that every line is standard JSON. Signals of episodes are not repeated: the episode file is named.
"""

from __future__ import annotations

import base64
import dataclasses
import json
import math
import types
import typing
from collections.abc import Iterator
from datetime import UTC, datetime
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from touchdown.backend import core
from touchdown.backend.config import Limits

FORMAT = 1
# Events are recorded under the names of their classes.
_RECORDED = {cls.__name__: cls for cls in core.Event.__subclasses__()}
_DTYPES = {"float64", "float32", "bool", "uint8"}


def encode_event(event: core.Event) -> dict[str, Any]:
    """Return ``event`` as a JSON-ready dictionary with its kind."""
    return {"kind": type(event).__name__, **_encode_fields(event)}


def decode_event(line: dict[str, Any], where: str) -> core.Event:
    """Return the event of a dictionary made by ``encode_event``; raises ``InputError``."""
    kind = line.get("kind")
    cls = _RECORDED.get(kind) if isinstance(kind, str) else None
    if cls is None:
        raise core.InputError(
            f"Unknown event {kind!r}.", where, "Use a newer Touchdown to replay it."
        )
    said, fix = f"Damaged event {kind}", "Replay the lines before."
    with core.errors_as_input(said, where, fix, KeyError, TypeError, ValueError):
        event = _build(cls, line)
    assert isinstance(event, core.Event)
    return event


def _encode_fields(value: Any) -> dict[str, Any]:
    return {
        f.name: _encoded(getattr(value, f.name))
        for f in dataclasses.fields(value)
        if f.name != "recording"
    }


def _encoded(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        array = np.ascontiguousarray(value)
        little = array.astype(array.dtype.newbyteorder("<"))
        data = base64.b64encode(little.tobytes()).decode("ascii")
        return {"shape": list(array.shape), "dtype": array.dtype.name, "data": data}
    if isinstance(value, Enum):
        return value.name
    if dataclasses.is_dataclass(value):
        return _encode_fields(value)
    if isinstance(value, tuple):
        return [_encoded(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return repr(value)
    return value


@cache
def _hints(cls: type) -> dict[str, Any]:
    """Return the field types, cached: resolving them took half the time of a read."""
    return typing.get_type_hints(cls)


def _build(cls: type, content: dict[str, Any]) -> Any:
    hints, names = _hints(cls), (f.name for f in dataclasses.fields(cls))
    return cls(**{n: _decoded(hints[n], content[n]) for n in names if n in content})


def _decoded(hint: Any, value: Any) -> Any:
    if isinstance(value, dict) and "dtype" in value and "shape" in value:
        return _array(value)
    if hint is float:
        return float(value)
    origin = typing.get_origin(hint)
    if origin in (typing.Union, types.UnionType):
        inner = [arg for arg in typing.get_args(hint) if arg is not type(None)]
        return None if value is None else _decoded(inner[0], value)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return hint[value]
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return _build(hint, value)
    if origin is tuple:
        args = typing.get_args(hint)
        repeated = len(args) == 2 and args[1] is Ellipsis
        return tuple(
            _decoded(args[0] if repeated else args[i], item) for i, item in enumerate(value)
        )
    return value


def _array(value: dict[str, Any]) -> np.ndarray[Any, Any]:
    if value["dtype"] not in _DTYPES:
        raise ValueError(f"dtype {value['dtype']!r} is not allowed")
    dtype = np.dtype(value["dtype"]).newbyteorder("<")
    flat = np.frombuffer(base64.b64decode(value["data"], validate=True), dtype=dtype)
    return flat.reshape(value["shape"]).astype(value["dtype"])


EVENT_LOG_NAME = "journal.jsonl"
MAX_LINE_BYTES = 8_000_000
NO_LOG, NO_LOG_FIX = "This is not a Touchdown event log.", "Name the folder of a run."


class EventLog:
    """Event bus subscriber that appends every event to ``folder/journal.jsonl``."""

    def __init__(self, folder: Path) -> None:
        core.make_folder(folder.parent)
        folder.mkdir(exist_ok=False)
        self.folder = folder
        self._append({"format": FORMAT, "program": "touchdown"})
        core.sync_folder(folder.parent)

    def __call__(self, event: core.Event) -> None:
        """Append ``event``; raises ``OSError``, then nothing is appended."""
        self._append(encode_event(event))

    def _append(self, line: dict[str, object]) -> None:
        raw = json.dumps(line, separators=(",", ":"), allow_nan=False).encode()
        with core.blocking_section("waits for the disk", core.DISK_TIMEOUT_S):
            core.append_line(self.folder / EVENT_LOG_NAME, raw)


def event_log_path(run: Path) -> Path:
    """Return the event log of a run folder, or the file itself; raises ``InputError``."""
    path = run / EVENT_LOG_NAME if run.is_dir() else run
    if not path.is_file():
        raise core.InputError("There is no event log.", str(run), "Name the folder of a run.")
    return path


def read_events(run: Path) -> Iterator[core.Event]:
    """Yield the events of a run in order.

    An incomplete last line (the program was killed while writing it) ends the log without an
    error: it was never acknowledged.

    Parameters
    ----------
    run : Path
        Folder of the run, or its event log.

    Yields
    ------
    Event
        Events in order of publication; times are bench seconds.

    Raises
    ------
    InputError
        If there is no event log or a line is damaged; names file and line.

    """
    path = event_log_path(run)
    with path.open("rb") as file:
        for number, raw in enumerate(file, start=1):
            if not raw.endswith(b"\n"):
                return
            where = f"{path}, line {number}"
            if len(raw) > MAX_LINE_BYTES:
                raise core.InputError("A line is too long.", where, "The event log is damaged.")
            try:
                line = core.parse_json(raw)
            except ValueError as error:
                if number == 1:
                    raise core.InputError(NO_LOG, where, NO_LOG_FIX) from error
                fix = f"Keep the {number - 1} lines before it in a file of their own and replay it."
                raise core.InputError("A line is not valid JSON.", where, fix) from error
            if number > 1:
                yield decode_event(line, where)
            elif not isinstance(line, dict) or line.get("program") != "touchdown":
                raise core.InputError(NO_LOG, where, NO_LOG_FIX)
            elif line.get("format") != FORMAT:
                what = f"Event log format {line.get('format')} is not known."
                raise core.InputError(what, where, "Use a newer Touchdown.")


LIMIT_LOG_NAME = "limits.jsonl"


def changed_limits(before: Limits, after: Limits) -> dict[str, tuple[float, float]]:
    """Return (before, after) of each limit that differs, by name."""
    old, new = before.model_dump(), after.model_dump()
    return {name: (old[name], new[name]) for name in old if old[name] != new[name]}


def log_limit_change(folder: Path, bench: str, person: str, before: Limits, after: Limits) -> None:
    """Append the change to ``folder/limits.jsonl``; raises ``InputError`` if that fails."""
    line = {
        "at": datetime.now(UTC).isoformat(timespec="seconds"),
        "bench": bench,
        "person": person,
        "changed": {name: list(pair) for name, pair in changed_limits(before, after).items()},
    }
    path = folder / LIMIT_LOG_NAME
    fix = "Make room or name another folder (TOUCHDOWN_DATA); the former limits hold."
    with core.disk_errors("The change of limits cannot be written", path, fix):
        core.append_line(path, json.dumps(line, allow_nan=False).encode())
