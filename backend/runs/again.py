"""A press that a short silence of arm or wrist made void is made again: what it felt is lost."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from backend.core.faults import Fault, FaultError
from backend.devices.motion import VOID_PRESS
from backend.runs.bench import Bench
from backend.runs.motions import fresh_wrench
from backend.runs.plan import Plan

VOID_TRIES = 3
"""So many presses, while each is void because something was silent for a moment."""
TOUCH_TRIES = 6
"""So many touches: a calibration is made of dozens, a touch is short, and no label hangs on it."""
VOID = (VOID_PRESS, "FT-STALE")
"""Replies of the arm, or samples of the wrist, stayed away for less than makes a latched fault."""
T = TypeVar("T")


def again_if_void(
    bench: Bench,
    attempt: Callable[[], Plan[T]],
    after_void: Callable[[Fault], Plan[None]],
    tries: int = VOID_TRIES,
) -> Plan[T]:
    """Return what ``attempt`` came to, tried ``tries`` times in all while its press is void.

    ``after_void`` says so and draws the arm back, once the wrist is heard again. The last void
    press is raised, as is any other fault, and any that latched the interlock.
    """
    for left in reversed(range(tries)):
        try:
            return (yield from attempt())
        except FaultError as error:
            if error.fault.code not in VOID or not left:
                raise
            yield from fresh_wrench(bench)
            if bench.interlock.latched:
                raise
            yield from after_void(error.fault)
    raise AssertionError("unreachable: the loop returns or raises")
