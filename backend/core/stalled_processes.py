"""Detection of processes and threads that have stalled.

A process is stalled if a signal stopped it or if all of its threads wait. A process that lacks
processor time or waits for a disk is not stalled; the scheduler reports this for each thread.
Without ``/proc`` only a stopped process is detected.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import psutil

STALLED_AFTER_S = 0.3  # A process is stalled when none of its threads was runnable for this long
MAX_LOOK_GAP_S = 1.0  # after a longer gap between two looks the observer itself was suspended
RUNNABLE_STATES = frozenset("RDW")
MAX_LOOK_STEP_S = 0.1  # longest time that one look adds; looks are 50 ms apart


class ProcessStallDetector:
    """Observes the process ``number``; call ``look`` a few times in ``STALLED_AFTER_S``."""

    def __init__(self, number: int) -> None:
        self._folder = Path("/proc") / str(number) / "task"
        self._process = psutil.Process(number)
        self._used_s, self._since_s, self._looked_s = -1.0, 0.0, 0.0

    def look(self, now_s: float) -> bool:
        """Return True if it is stalled at ``now_s`` (monotonic); False once it has ended."""
        try:
            used = self._process.cpu_times()
            states = self._states()
        except psutil.Error:
            return False
        used_s = used.user + used.system
        away, self._looked_s = now_s - self._looked_s > MAX_LOOK_GAP_S, now_s
        if away or used_s != self._used_s or not states or states & RUNNABLE_STATES:
            self._used_s, self._since_s = used_s, now_s
            return False
        return now_s - self._since_s >= STALLED_AFTER_S

    def _states(self) -> set[str]:
        """Return the scheduler states of its threads; empty if unknown."""
        found = set[str]()
        with suppress(FileNotFoundError):
            for task in self._folder.iterdir():
                with suppress(FileNotFoundError, ProcessLookupError):
                    # The process name before the state may contain brackets.
                    found.add((task / "stat").read_bytes().rpartition(b")")[2].split()[0].decode())
        if "Z" in found:
            return set()
        if not found and self._process.status() == psutil.STATUS_STOPPED:
            return {"T"}
        return found


class ThreadStallDetector:
    """Measures the time for which a thread was not runnable.

    A thread that polls, or waits for the interpreter, a processor or a disk, counts as running.
    Without ``/proc`` the time is 0. Delays between two looks are not counted, so that a suspended
    computer or a stopped program has no effect.
    """

    def __init__(self, process: int, thread: int) -> None:
        self._status = Path("/proc") / str(process) / "task" / str(thread) / "status"
        self._switches = b""
        self._looked_s = 0.0
        self.passed_s: float = 0.0  # time between the last two looks, at most MAX_LOOK_STEP_S
        self.rested_s: float = 0.0

    def look(self, now_s: float) -> float:
        """Return the idle time in s at ``now_s``; 0 at first and after its end."""
        self.passed_s, self._looked_s = min(now_s - self._looked_s, MAX_LOOK_STEP_S), now_s
        self.rested_s = self.rested_s + self.passed_s if self._rests() else 0.0
        return self.rested_s

    def _rests(self) -> bool:
        """Return True if it was idle since the last look."""
        before, self._switches, state = self._switches, b"", b"R"
        with suppress(OSError):
            text = self._status.read_bytes()
            state = text.partition(b"\nState:\t")[2][:1]
            # Both counts, voluntary and not, from the end of the file.
            self._switches = text.rpartition(b"\nvoluntary_ctxt_switches:")[2]
        return bool(before) and before == self._switches and state.decode() not in RUNNABLE_STATES
