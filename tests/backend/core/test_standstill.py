"""A stalled process is distinguished from one that waits for the processor."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from touchdown.backend.core.watchdog import STALLED_AFTER_S, ProcessStallDetector

BUSY = "print(flush=True)\nwhile True: sum(range(1000))"
WAITS = (
    "import threading\nprint(flush=True)\nlock = threading.Lock()\nlock.acquire()\nlock.acquire()"
)


@pytest.fixture
def child(request):
    with subprocess.Popen([sys.executable, "-c", request.param], stdout=subprocess.PIPE) as made:
        assert made.stdout.readline() == b"\n"
        yield made
        made.kill()


def looks(watch, until):
    """Look for as long as the outcome may still change; the clock of the looks is wound by hand."""
    now_s = 0.0
    for _ in range(10_000):
        now_s += STALLED_AFTER_S
        if watch.look(now_s) is until:
            return True
    return False


@pytest.mark.promise("P7", "P10")
@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="threads are seen on Linux only")
@pytest.mark.parametrize("child", [WAITS], indirect=True)
def test_one_that_waits_for_ever_stands_still_and_a_gone_one_does_not(child):
    watch = ProcessStallDetector(child.pid)
    assert not watch.look(0.0), "a first look knows nothing"
    assert looks(watch, True)
    assert not watch.look(1e8), "who has not looked for long knows nothing either"
    child.kill()
    child.wait()
    assert not watch.look(1e9)


@pytest.mark.promise("P7", "P10")
@pytest.mark.parametrize("child", [BUSY], indirect=True)
def test_one_that_is_stopped_stands_still_until_it_goes_on(child):
    watch = ProcessStallDetector(child.pid)
    assert not any(watch.look(k * STALLED_AFTER_S) for k in range(50)), "it wants to run"
    os.kill(child.pid, signal.SIGSTOP)
    assert looks(watch, True)
    os.kill(child.pid, signal.SIGCONT)
    assert looks(watch, False)
