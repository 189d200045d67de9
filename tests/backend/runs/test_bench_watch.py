"""Watchdog of the bench thread: deadlocks are reported, busy and declared sections are not."""

import os
import threading
import time
from pathlib import Path

import pytest

from tests.backend.bench.brisk import brisk_bench, on
from tests.backend.devices.waiting import until
from touchdown.backend.bench.assembly import simulated_session
from touchdown.backend.core import scheduling as doings
from touchdown.backend.core.events import FaultRaised
from touchdown.backend.core.scheduling import SharedLock, blocking_section, blocking_section_of
from touchdown.backend.core.stalled_processes import MAX_LOOK_STEP_S, ThreadStallDetector
from touchdown.backend.runs.engine import STILL_S, WATCH_PERIOD_S, WORKS_S, ThreadWatchdog
from touchdown.backend.runs.requests import SceneChoice

pytestmark = pytest.mark.skipif(
    not Path("/proc/self/task").is_dir(), reason="threads are seen on Linux only"
)
STEP_S = 0.02
# So many looks tell a standstill: within 500 ms at one each 50 ms.
LOOKS = round((STILL_S + STEP_S) / WATCH_PERIOD_S) + 2


class Watched:
    """Controlled thread, its steps, and a watchdog with a manual clock."""

    def __init__(self, act):
        self.told, self.steps, self.over = [], 0, threading.Event()
        self.thread = threading.Thread(target=act, args=(self.over,), daemon=True)
        self.thread.start()
        number = self.thread.native_id
        self.rest = ThreadStallDetector(os.getpid(), number)
        self.watch = ThreadWatchdog(number, lambda: self.steps, STEP_S, self.told.append)
        self.now_s = time.monotonic()

    def rests(self):
        """True if the thread sleeps."""
        return self.rest.look(time.monotonic()) > 0.0

    def look(self, times, every_s=WATCH_PERIOD_S):
        for _ in range(times):
            self.now_s += every_s
            self.watch.look(self.now_s)
        return [fault.what for fault in self.told]

    def settled(self):
        """Wait until the thread sleeps."""
        until(self.rests)
        return self

    def ran(self):
        """Wait until the thread has run."""
        self.rests()
        until(lambda: not self.rests())

    def close(self):
        self.over.set()
        self.thread.join()


@pytest.fixture
def watched():
    made = []

    def make(act):
        made.append(Watched(act))
        return made[-1]

    yield make
    for one in made:
        one.close()


def waits(over):
    over.wait()


def polls(over):
    while not over.wait(0.001):
        pass


def test_a_thread_rests_while_it_is_not_runnable_and_is_not_switched(tmp_path):
    rest = ThreadStallDetector(os.getpid(), threading.get_native_id())
    rest._status = tmp_path / "status"
    looks = [("S", 5, 1), ("S", 5, 1), ("S", 6, 1), ("S", 6, 1), ("S", 6, 2), ("R", 6, 2),
             ("D", 6, 2), ("S", 6, 2)]  # fmt: skip
    rested_s = []
    for at, (state, given, taken) in enumerate(looks):
        rest._status.write_text(
            f"Name:\tState:\nUmask:\t0022\nState:\t{state} (any)\nPid:\t1\n"
            f"voluntary_ctxt_switches:\t{given}\nnonvoluntary_ctxt_switches:\t{taken}\n"
        )
        rested_s.append(rest.look(0.05 * at))
    assert rested_s == pytest.approx([0.0, 0.05, 0.0, 0.05, 0.0, 0.0, 0.0, 0.05])


@pytest.mark.promise("P7", "P10")
def test_a_thread_that_waits_without_a_word_is_told_within_ten_looks(watched):
    one = watched(waits).settled()
    assert LOOKS * WATCH_PERIOD_S < 0.5
    (what, *_) = one.look(LOOKS)
    assert what.endswith("It waits without end.")
    assert one.told[0].code == "BENCH-STILL"
    one.told.clear()
    one.steps += 1
    assert one.look(LOOKS // 2) == [], "it went on"


@pytest.mark.promise("P7", "P10")
def test_a_watch_that_comes_late_itself_knows_nothing_by_it(watched):
    one = watched(waits).settled()
    looks = int(STILL_S / MAX_LOOK_STEP_S)
    assert one.look(looks, every_s=1e4) == [], "as if the whole computer had slept in between"


@pytest.mark.promise("P7", "P10")
def test_one_that_polls_is_told_only_after_long(watched):
    one = watched(polls)
    for _ in range(2 * LOOKS):
        one.ran()
        assert one.look(1) == []
    one.watch._stepless_s = WORKS_S
    one.ran()
    assert one.look(1)[0].endswith("It is busy without end.")


@pytest.mark.promise("P7", "P10")
def test_one_that_says_what_it_does_has_as_long_as_it_said(watched):
    def sets(over):
        with (
            blocking_section("sets the scene", 60.0),
            blocking_section("waits for the devices", 1.0),
        ):
            over.wait()

    one = watched(sets).settled()
    said = blocking_section_of(one.thread.native_id)
    assert said.what == "sets the scene"
    assert one.look(3 * LOOKS) == []
    one.now_s = said.until_s
    assert one.look(1)[0].endswith("It sets the scene, and that comes to no end.")
    one.close()
    assert blocking_section_of(one.thread.native_id) is None


def test_who_waits_for_a_lock_that_others_hold_over_a_disk_says_so():
    lock, number, through = SharedLock(), [], threading.Event()

    def waiter():
        number.append(threading.get_native_id())
        with lock, lock:
            through.set()

    with lock:
        other = threading.Thread(target=waiter)
        other.start()
        until(lambda: number and blocking_section_of(number[0]))
        assert not through.is_set()
    other.join()
    assert through.is_set()
    assert number[0] not in doings._SECTIONS


@pytest.mark.promise("P7", "P10")
def test_a_deadlock_of_the_thread_of_the_bench_is_a_fault_and_told_again_after_a_reset():
    session, facts, over = simulated_session(brisk_bench("quiet")), [], threading.Event()
    session.prepare(SceneChoice())
    on(session, FaultRaised, facts.append)
    session.advance = over.wait
    session.open()
    until(lambda: facts)
    assert [fact.fault.code for fact in facts] == ["BENCH-STILL"]
    assert session.interlock.latched
    session.reset()
    until(lambda: len(facts) == 2)
    session.close()
    assert not over.is_set(), "closing waits for no thread that stands still"
    over.set()
