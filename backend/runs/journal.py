"""The append-only record of a run's facts: one JSON line each, durable before the next one."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import IO

from backend.core.doing import DISK_S, doing
from backend.core.facts import Fact
from backend.core.faults import InputError
from backend.core.files import make_folder, sync_folder
from backend.runs.fact_codec import FORMAT, decode, encode

NAME = "journal.jsonl"
MAX_LINE_BYTES = 8_000_000


class Journal:
    """Subscribes to a hub and appends every fact to ``folder/journal.jsonl``."""

    def __init__(self, folder: Path) -> None:
        make_folder(folder.parent)
        folder.mkdir(exist_ok=False)
        self.folder = folder
        self._file: IO[bytes] = (folder / NAME).open("xb")
        self._durable_bytes = 0
        self._append({"format": FORMAT, "program": "touchdown"})
        sync_folder(folder)
        sync_folder(folder.parent)

    def __call__(self, fact: Fact) -> None:
        """Append ``fact``."""
        if not self._file.closed:
            self._append(encode(fact))

    def close(self) -> None:
        """Close the file; closing twice is allowed."""
        self._file.close()

    def mend(self) -> None:
        """Open the file anew after a failed write, without the part of a line it may have left.

        Raises ``OSError`` where that fails too. What was synced before stays untouched.
        """
        self.abandon()
        self._file = (self.folder / NAME).open("r+b")
        self._file.truncate(self._durable_bytes)
        self._file.seek(self._durable_bytes)

    def abandon(self) -> None:
        """Close after a failed write without writing again."""
        with suppress(OSError):
            self._file.close()

    def _append(self, line: dict[str, object]) -> None:
        raw = json.dumps(line, separators=(",", ":"), allow_nan=False).encode() + b"\n"
        self._file.write(raw)
        self._file.flush()
        with doing("waits for the disk", DISK_S):
            os.fsync(self._file.fileno())
        self._durable_bytes += len(raw)


def journal_path(run: Path) -> Path:
    """Return the journal of a run folder (or the file itself); raises ``InputError``."""
    path = run / NAME if run.is_dir() else run
    if not path.is_file():
        raise InputError("There is no run journal.", str(run), "Name the folder of a run.")
    return path


def read_journal(run: Path) -> Iterator[Fact]:
    """Yield the facts of a run in order.

    A torn last line (the program was killed while writing it) ends the journal quietly: it was
    never acknowledged. Any other damage raises ``InputError`` naming file and line.
    """
    path = journal_path(run)
    with path.open("rb") as file:
        for number, raw in enumerate(file, start=1):
            if not raw.endswith(b"\n"):
                return
            where = f"{path}, line {number}"
            if len(raw) > MAX_LINE_BYTES:
                raise InputError("A line is too long.", where, "The journal is damaged.")
            try:
                line = json.loads(raw)
            except ValueError as error:
                if number == 1:
                    raise _no_journal(where) from error
                raise InputError(
                    "A line is not valid JSON.",
                    where,
                    f"Keep the {number - 1} lines before it in a file of their own, and replay it.",
                ) from error
            if number == 1:
                _check_head(line, where)
            else:
                yield decode(line, where)


def _check_head(line: object, where: str) -> None:
    if not isinstance(line, dict) or line.get("program") != "touchdown":
        raise _no_journal(where)
    if line.get("format") != FORMAT:
        raise InputError(
            f"Journal format {line.get('format')} is not known.", where, "Use a newer Touchdown."
        )


def _no_journal(where: str) -> InputError:
    return InputError("This is not a Touchdown journal.", where, "Name the folder of a run.")
