"""Watches the thread of a live bench: one that makes no step, and rests, stands still.

Judged by what the thread does and not by how long a step takes: one that computes, polls, or waits
for a processor or a disk is at work, however loaded the computer is.
"""

from __future__ import annotations

import os
from collections.abc import Callable

from backend.core.doing import done_by
from backend.core.faults import Fault
from backend.core.standstill import ThreadRest

LOOK_S = 0.05
STILL_S = 0.25
"""A thread that has rested so long without a step stands still: told within 500 ms (P7)."""
WORKS_S = 30.0
"""One that works so long without a step makes none any more; the longest takes about 1 s."""


class BenchWatch:
    """Looks at the thread ``number`` (of the system) every ``LOOK_S``.

    ``steps`` counts what it has done, one each ``step_s`` of the wall's seconds at least; ``tell``
    hears of its standstill at each look, as long as that lasts.
    """

    def __init__(
        self, number: int, steps: Callable[[], int], step_s: float, tell: Callable[[Fault], None]
    ) -> None:
        self._number, self._steps, self._tell = number, steps, tell
        self._rest, self._still_s = ThreadRest(os.getpid(), number), STILL_S + step_s
        self._seen, self._stepless_s = -1, 0.0

    def look(self, now_s: float) -> None:
        """Judge at ``now_s``, of ``time.monotonic``."""
        rested_s = self._rest.look(now_s)
        steps, said = self._steps(), done_by(self._number)
        if steps != self._seen or said is not None:
            self._seen, self._rest.rested_s, self._stepless_s = steps, 0.0, 0.0
            if said is not None and now_s > said.until_s:
                self._tell(bench_fault(f"It {said.what}, and that comes to no end"))
            return
        self._stepless_s += self._rest.passed_s
        if rested_s >= self._still_s:
            self._tell(bench_fault("It waits for what does not come"))
        elif self._stepless_s >= WORKS_S:
            self._tell(bench_fault("It works without an end"))


def bench_fault(why: str) -> Fault:
    """Return the fault of a thread that stands still; ``why`` is a sentence without its end."""
    return Fault(
        "BENCH-STILL",
        f"The thread of the bench stands still. {why}.",
        "Nothing is measured, and no run goes on; the gripper was not opened.",
        "Copy the details for the maintainers, then start Touchdown again.",
    )
