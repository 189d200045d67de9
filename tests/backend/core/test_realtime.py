"""A raised priority is inherited by threads and restored; nothing changes without permission.

Short slices are inherited too.
"""

from __future__ import annotations

import os
import re
import sys
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from touchdown.backend.core import (
    raised_priority,
    request_short_slices,
    round_robin_priority,
    scheduling,
)
from touchdown.backend.core.scheduling import RAISED_NICENESS, SLICE_NS

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only Linux gives it to threads")
Raise = Callable[[], AbstractContextManager[bool]]


def present() -> tuple[int, int, int]:
    priority = os.sched_getparam(0).sched_priority
    return os.sched_getscheduler(0), priority, os.getpriority(os.PRIO_PROCESS, 0)


def of_a_new_thread() -> tuple[int, int, int]:
    found: list[tuple[int, int, int]] = []
    thread = threading.Thread(target=lambda: found.append(present()))
    thread.start()
    thread.join()
    return found[0]


@pytest.mark.parametrize("raise_it", [lambda: round_robin_priority(3), raised_priority])
def test_threads_inherit_it_and_the_caller_has_its_own_again(raise_it):
    before = present()
    with raise_it() as given:
        if not given:
            pytest.skip("this user may not have it")
        niceness = RAISED_NICENESS if raise_it is raised_priority else before[2]
        policy = before[:2] if raise_it is raised_priority else (os.SCHED_RR, 3)
        assert of_a_new_thread() == present() == (*policy, niceness)
    assert of_a_new_thread() == present() == before


@pytest.mark.parametrize(
    "raise_it", [lambda: round_robin_priority(0), lambda: round_robin_priority(3), raised_priority]
)
def test_without_permission_nothing_changes(raise_it, monkeypatch):
    def refused(*_: object) -> None:
        raise PermissionError("not for this user")

    before = present()
    monkeypatch.setattr(scheduling.os, "sched_setscheduler", refused)
    monkeypatch.setattr(scheduling.os, "setpriority", refused)
    with raise_it() as given:
        assert not given
        assert present() == before


def test_short_slices_need_no_permission_and_are_inherited() -> None:
    found: list[str] = []
    before = present()

    def request() -> None:
        if request_short_slices():
            assert present() == before
            later = threading.Thread(target=lambda: found.append(slices()))
            later.start()
            later.join()

    def slices() -> str:
        folder = Path(f"/proc/self/task/{threading.get_native_id()}/sched")
        shown = re.search(r"se\.slice\s*:\s*(\d+)", folder.read_text())
        return "" if shown is None else shown[1]

    thread = threading.Thread(target=request)
    thread.start()
    thread.join()
    if os.sched_getscheduler(0) == os.SCHED_OTHER and scheduling.platform.machine() == "x86_64":
        assert found == [str(SLICE_NS)]
