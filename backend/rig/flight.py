"""The flight recorder: the last 5 s of the rig beside the run journal, once there was a fault.

The rig keeps them in shared memory and writes no files; the backend does, also after its death.
Room for one is reserved while a run lasts: the fault may be that the disk is full.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path

from backend.core.facts import Fact, FaultRaised, RunFinished, RunStarted
from backend.core.faults import Fault
from backend.devices.traced import TRACE
from backend.rig.memory import SharedMemory
from backend.rig.reserve import Reserve

KEPT_S = 5.0
RESERVED_BYTES = 4 << 20
"""More than one recording takes."""
MOST_FILES = 8
"""A run that raises one fault after the other keeps its first ones."""
NAMES = ("fx_n", "fy_n", "fz_n", "tx_nm", "ty_nm", "tz_nm")


class FlightRecorder:
    """Subscribe ``note`` to a hub. ``memory`` and ``folder`` are asked at each fault."""

    def __init__(
        self, memory: Callable[[], SharedMemory | None], folder: Callable[[], Path | None]
    ) -> None:
        self._memory, self._folder = memory, folder
        self._reserve = Reserve()

    def note(self, fact: Fact) -> None:
        """Write the last seconds if ``fact`` is a fault and a run is kept."""
        memory, folder = self._memory(), self._folder()
        if isinstance(fact, RunFinished):
            self._reserve.give_back()
        if memory is None or folder is None or not folder.is_dir():
            return
        if isinstance(fact, RunStarted):
            self._reserve.take(folder, RESERVED_BYTES)
        elif isinstance(fact, FaultRaised):
            self._write(memory, folder, fact)

    def _write(self, memory: SharedMemory, folder: Path, fact: FaultRaised) -> None:
        number = sum(1 for _ in folder.glob("flight-*.jsonl")) + 1
        if number > MOST_FILES:
            return
        content = "".join(lines(memory, fact.t_s, fact.fault)).encode()
        try:
            self._reserve.write(folder / f"flight-{number}.jsonl", content)
        except OSError:
            # The fault itself stands in the journal and on a card; a full disk says so elsewhere.
            return
        self._reserve.take(folder, RESERVED_BYTES)


def lines(memory: SharedMemory, t_s: float, fault: Fault) -> Iterator[str]:
    """Yield the lines of a recording: what it is of, then all that was kept in order of time."""
    head = {"fault": asdict(fault), "t_s": t_s, "round": TRACE, "wrench": NAMES}
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
