"""Real-time priority is inherited by threads and restored; nothing changes without permission."""

from __future__ import annotations

import os
import threading

import pytest

from touchdown.backend.core import scheduling
from touchdown.backend.core.scheduling import round_robin_priority

pytestmark = pytest.mark.skipif(
    not hasattr(os, "sched_setscheduler"), reason="only Linux gives it to threads"
)


def present() -> tuple[int, int]:
    return os.sched_getscheduler(0), os.sched_getparam(0).sched_priority


def of_a_new_thread() -> tuple[int, int]:
    found: list[tuple[int, int]] = []
    thread = threading.Thread(target=lambda: found.append(present()))
    thread.start()
    thread.join()
    return found[0]


def test_threads_inherit_it_and_the_caller_has_its_own_again() -> None:
    before = present()
    with round_robin_priority(3) as given:
        if not given:
            pytest.skip("this user may not have it")
        assert of_a_new_thread() == present() == (os.SCHED_RR, 3)
    assert of_a_new_thread() == present() == before


@pytest.mark.parametrize("priority", [0, 3])
def test_without_it_nothing_changes(priority: int, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> None:
        raise PermissionError("no rtprio for this user")

    before = present()
    monkeypatch.setattr(scheduling.os, "sched_setscheduler", refused)
    with round_robin_priority(priority) as given:
        assert not given
        assert present() == before
