"""Niceness of worker processes and of threads that raise their priority."""

from __future__ import annotations

import os
import subprocess
import sys
import threading

import pytest

from touchdown.backend.core import scheduling
from touchdown.backend.core.scheduling import NICENESS, RAISED_NICENESS, raised_priority

TWICE = """
import os
from touchdown.backend.core.scheduling import lower_priority
os.nice(5)
lower_priority()
lower_priority()
print(os.nice(0))
"""


@pytest.mark.skipif(os.name != "posix", reason="only there is a niceness")
def test_what_has_stepped_back_already_does_not_lower_priority_again() -> None:
    told = subprocess.run([sys.executable, "-c", TWICE], capture_output=True, text=True, check=True)
    assert int(told.stdout) == max(NICENESS, min(os.nice(0) + 5, 19))


def present() -> int:
    return os.getpriority(os.PRIO_PROCESS, 0)


def of_a_new_thread() -> int:
    found: list[int] = []
    thread = threading.Thread(target=lambda: found.append(present()))
    thread.start()
    thread.join()
    return found[0]


@pytest.mark.skipif(sys.platform != "linux", reason="only there each thread has its own")
def test_threads_that_are_started_meanwhile_stand_forward_as_well() -> None:
    before = present()
    with raised_priority() as given:
        if not given:
            pytest.skip("this user may not have it")
        assert of_a_new_thread() == present() == RAISED_NICENESS
    assert of_a_new_thread() == present() == before


@pytest.mark.skipif(sys.platform != "linux", reason="only there each thread has its own")
def test_who_may_not_step_forward_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> None:
        raise PermissionError("no nice for this user")

    before = present()
    monkeypatch.setattr(scheduling.os, "setpriority", refused)
    with raised_priority() as given:
        assert not given
        assert present() == before
