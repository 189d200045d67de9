"""Whether the process that started the rig lives on, as the system tells it."""

import os
import signal
import subprocess
import sys

import pytest

from touchdown.backend.rig.messages import ParentProcess, is_dying

# proc(5): pid, name, state, five numbers, flags, ...; the 31st field holds the waiting signals.
ALIVE = (
    b"14714 (%b) %b 14713 14714 597 0 -1 %d 240 890 0 10 0 0 0 1 20 0 1 0 2435368 4861952 569 "
    b"18446744073709551615 94098241773568 94098242562973 140724841936160 0 0 %d 0 65536 0 81922 "
    b"1 0 0 17 0 0 0 0 0 0 94098242796272 94098242844516 94098707435520 140724841937790 "
    b"140724841937805 140724841937805 140724841938922 0\n"
)
NORMAL, EXITING = 0x400100, 0x400104
KILL, TERM = 1 << 8, 1 << 14


@pytest.mark.promise("P9")
@pytest.mark.parametrize(
    ("state", "flags", "signals", "found"),
    [
        (b"S", NORMAL, 0, False),
        (b"R", NORMAL, TERM, False),  # it may have a handler for that one
        (b"R", NORMAL, KILL, True),
        (b"D", EXITING, 0, True),
        (b"Z", EXITING, 0, True),
    ],
)
@pytest.mark.parametrize("name", [b"python", b"a) Z 4 (b", b") ) S"])
def test_a_killed_process_is_known_before_it_gets_a_processor_to_die_on(
    name, state, flags, signals, found
):
    assert is_dying(ALIVE % (name, state, flags, signals)) is found


@pytest.mark.parametrize("line", [b"", b"14714 (python", b"14714 (python) S 1 2"])
def test_half_a_line_says_nothing(line):
    assert is_dying(line) is False


# A grandchild that only tells how its parent is; the parent waits to be killed.
CHILD = """
import subprocess, sys
subprocess.Popen([sys.executable, "-c", sys.argv[1]])
sys.stdin.read()
"""
GRANDCHILD = """
import sys, time
from touchdown.backend.rig.messages import ParentProcess
parent = ParentProcess()
print(parent.gone(), flush=True)
while not parent.gone():
    time.sleep(0.001)
print("gone", flush=True)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="asks the files of Linux")
def test_the_death_of_a_parent_is_seen_and_its_life_too():
    mine = ParentProcess()
    assert not mine.gone()
    mine.close()
    command = [sys.executable, "-c", CHILD, GRANDCHILD]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as child:
        assert child.stdout.readline() == "False\n"
        os.kill(child.pid, signal.SIGKILL)
        # Nobody has taken note of its end yet: for its child it has the same number all the while.
        assert child.stdout.readline() == "gone\n"
