"""Flight recorder: the last 5 s of the real-time process, written after a fault.

The rig records in shared memory and writes no files; the backend writes them, also after the rig
has died. During a run, disk space for one file is reserved as an unnamed file (Linux), because the
fault may be a full disk.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

from touchdown.backend import core
from touchdown.backend.devices import TRACE_NAMES
from touchdown.backend.rig.memory import SharedMemory


class ReservedFile:
    """Reserves disk space for one file; not thread-safe."""

    def __init__(self) -> None:
        self._descriptor: int | None = None
        self._folder: Path | None = None

    def take(self, folder: Path, size: int) -> bool:
        """Reserve ``size`` bytes in ``folder``, releasing the former; return True on success."""
        self.give_back()
        if not hasattr(os, "O_TMPFILE"):
            return False
        try:
            descriptor = os.open(folder, os.O_TMPFILE | os.O_RDWR, 0o644)
        except OSError:
            return False
        try:
            os.posix_fallocate(descriptor, 0, size)
        except OSError:
            os.close(descriptor)
            return False
        self._descriptor, self._folder = descriptor, folder
        return True

    def give_back(self) -> None:
        """Release the reservation."""
        descriptor, self._descriptor = self._descriptor, None
        if descriptor is not None:
            os.close(descriptor)

    def write(self, path: Path, content: bytes) -> None:
        """Write ``content`` to the new file ``path``, in the reserved space if it is in the same
        folder. Uses up the reservation. Raises ``OSError``.
        """
        if self._descriptor is None or self._folder != path.parent:
            core.write_atomically(path, content)
            return
        try:
            _fill(self._descriptor, content)
            _link_file(self._descriptor, path)
        finally:
            self.give_back()
        core.sync_folder(path.parent)

    def __del__(self) -> None:
        with suppress(OSError):
            self.give_back()


def _fill(descriptor: int, content: bytes) -> None:
    left = memoryview(content)
    while left:
        left = left[os.write(descriptor, left) :]
    os.ftruncate(descriptor, len(content))
    os.fsync(descriptor)


def _link_file(descriptor: int, path: Path) -> None:
    """Give the unnamed file its name; raises ``FileExistsError`` if it is taken."""
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        # With a directory descriptor, linkat follows the link to the file itself.
        os.link(f"/proc/self/fd/{descriptor}", path.name, dst_dir_fd=folder, follow_symlinks=True)
    finally:
        os.close(folder)


KEPT_S = 5.0
RESERVED_BYTES = 4 << 20  # larger than any recording
MOST_FILES = 8  # recordings per run; the first ones are kept
NAMES = ("fx_n", "fy_n", "fz_n", "tx_nm", "ty_nm", "tz_nm")


class FlightRecorder:
    """Subscribe ``note`` to an event bus. ``memory`` and ``folder`` are called at each fault."""

    def __init__(
        self, memory: Callable[[], SharedMemory | None], folder: Callable[[], Path | None]
    ) -> None:
        self._memory, self._folder = memory, folder
        self._reserve = ReservedFile()

    def note(self, fact: core.Event) -> None:
        """Write the last seconds if ``fact`` is a fault and a run is recorded."""
        memory, folder = self._memory(), self._folder()
        if isinstance(fact, core.RunFinished):
            self._reserve.give_back()
        if memory is None or folder is None or not folder.is_dir():
            return
        if isinstance(fact, core.RunStarted):
            self._reserve.take(folder, RESERVED_BYTES)
        elif isinstance(fact, core.FaultRaised):
            self._write(memory, folder, fact)

    def _write(self, memory: SharedMemory, folder: Path, fact: core.FaultRaised) -> None:
        number = sum(1 for _ in folder.glob("flight-*.jsonl")) + 1
        if number > MOST_FILES:
            return
        content = "".join(recording_lines(memory, fact.t_s, fact.fault)).encode()
        try:
            self._reserve.write(folder / f"flight-{number}.jsonl", content)
        except OSError:
            # The fault is reported in the event log and on a card; a full disk is reported
            # elsewhere.
            return
        self._reserve.take(folder, RESERVED_BYTES)


def recording_lines(memory: SharedMemory, t_s: float, fault: core.Fault) -> Iterator[str]:
    """Yield the lines of a recording: a header, then all records in order of time."""
    head = {"fault": asdict(fault), "t_s": t_s, "round": TRACE_NAMES, "wrench": NAMES}
    yield json.dumps(head, ensure_ascii=False) + "\n"
    found: list[tuple[float, str, object]] = []
    for name, ring in (("round", memory.rounds), ("wrench", memory.wrench)):
        stamps, values, _ = ring.since(0)
        rows = ([v if math.isfinite(v) else None for v in row] for row in values.tolist())
        found += [(t, name, row) for t, row in zip(stamps.tolist(), rows, strict=True)]
    found += [(t, "note", text) for t, text in memory.notes()]
    for at_s, name, content in sorted(found, key=lambda line: line[0]):
        if at_s >= t_s - KEPT_S:
            yield json.dumps({"t_s": round(at_s, 6), name: content}, ensure_ascii=False) + "\n"
