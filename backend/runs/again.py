"""A press that the arm's link made void is made again: what was felt in it does not count."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from backend.core.faults import Fault, FaultError
from backend.devices.motion import VOID_PRESS
from backend.runs.plan import Plan

VOID_TRIES = 3
"""So many presses, while each is void because replies of the arm stayed away for a moment."""
T = TypeVar("T")


def again_if_void(
    attempt: Callable[[], Plan[T]], after_void: Callable[[Fault], Plan[None]]
) -> Plan[T]:
    """Return what ``attempt`` came to, tried ``VOID_TRIES`` times in all while its press is void.

    ``after_void`` says so and draws the arm back. The last void press is raised, as is any other
    fault.
    """
    for left in reversed(range(VOID_TRIES)):
        try:
            return (yield from attempt())
        except FaultError as error:
            if error.fault.code != VOID_PRESS or not left:
                raise
            yield from after_void(error.fault)
    raise AssertionError("unreachable: the loop returns or raises")
