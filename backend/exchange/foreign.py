"""Open foreign files in a process of their own, with a deadline: a bad file may hang or crash it.

(HDFGroup/hdf5 #1707: reading a corrupt file can take for ever.)
"""

from __future__ import annotations

import json
import queue
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import IO

from backend.core.faults import InputError
from backend.core.standstill import Standstill
from backend.exchange.foreign_episode import ForeignEpisode, load

DEADLINE_S = 60.0
"""So long may one episode take; the first one includes opening the file."""
LOOK_S = 0.05


def read_foreign(
    kind: str, source: Path, deadline_s: float = DEADLINE_S
) -> Iterator[ForeignEpisode]:
    """Yield the episodes of ``source`` as the reader ``kind`` finds them, one in memory at a time.

    Raises ``InputError`` for a file that is damaged, foreign, or not read within the deadline.
    """
    command = [sys.executable, "-m", "backend.exchange.foreign_child", kind, str(source.resolve())]
    with (
        tempfile.TemporaryDirectory(prefix="touchdown-import-") as folder,
        tempfile.TemporaryFile() as said,
    ):
        child = subprocess.Popen(
            [*command, folder], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=said,
        )  # fmt: skip
        assert child.stdout is not None
        lines: queue.Queue[bytes] = queue.Queue()
        listener = threading.Thread(target=_listen, args=(child.stdout, lines), daemon=True)
        listener.start()
        try:
            if not (yield from _episodes(lines, source, Waiting(child.pid, source, deadline_s))):
                raise _crashed(source, said)
        finally:
            child.kill()
            child.wait()
            listener.join()
            child.stdout.close()


def _listen(stream: IO[bytes], lines: queue.Queue[bytes]) -> None:
    for line in stream:
        lines.put(line)
    lines.put(b"")


class Waiting:
    """Waits for a line of the reader ``number``, as long as it does something."""

    def __init__(self, number: int, source: Path, deadline_s: float) -> None:
        self._watch, self._source, self._deadline_s = Standstill(number), source, deadline_s

    def line(self, lines: queue.Queue[bytes]) -> bytes:
        """Return the next one; raises ``InputError``."""
        end_s = time.monotonic() + self._deadline_s
        while True:
            left_s = end_s - time.monotonic()
            try:
                return lines.get(timeout=max(min(LOOK_S, left_s), 0.0))
            except queue.Empty:
                if left_s <= 0.0:
                    what = f"was not read within {self._deadline_s:g} s and was given up"
                elif self._watch.look(time.monotonic()):
                    what = "was given up: its reader stands still, nothing in it wants to run"
                else:
                    continue
            raise InputError(
                f"The file {what}.",
                str(self._source),
                "It is damaged or far too large; use another copy.",
            )


def _episodes(
    lines: queue.Queue[bytes], source: Path, waiting: Waiting
) -> Generator[ForeignEpisode, None, bool]:
    """Yield the episodes; return whether the reader came to the end."""
    while True:
        line = waiting.line(lines)
        answer: dict[str, str] = json.loads(line) if line.endswith(b"\n") else {}
        if "episode" in answer:
            path = Path(answer["episode"])
            yield load(path)
            path.unlink()
        elif "error" in answer:
            raise InputError(answer["error"], answer["where"] or str(source), answer["fix"])
        else:
            return "done" in answer


def _crashed(source: Path, said: IO[bytes]) -> InputError:
    said.seek(0)
    lines = said.read()[-2000:].decode("utf-8", "replace").splitlines()
    last = f" ({lines[-1]})" if lines else ""
    return InputError(
        f"The reader crashed on this file{last}.", str(source), "It is damaged; use another copy."
    )
