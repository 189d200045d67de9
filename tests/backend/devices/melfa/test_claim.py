"""One program per controller, whatever came before it and whoever tries at the same time."""

import os
import signal
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import pytest

from touchdown.backend.core.faults import FaultError
from touchdown.backend.devices.melfa.sockets import ControllerLock

pytestmark = pytest.mark.skipif(os.name != "posix", reason="files stay where they are locked so")
HOLDING = """
import sys, tempfile
tempfile.tempdir = sys.argv[1]
from touchdown.backend.devices.melfa.sockets import ControllerLock
claim = ControllerLock("10.0.0.1", 10001)
print("held", flush=True)
sys.stdin.read()
"""
ROOT = Path(__file__).resolve().parents[4]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


@pytest.mark.promise("R11", "P11")
def test_a_killed_program_holds_no_arm_and_its_file_is_swept(folder):
    command = [sys.executable, "-c", HOLDING, str(folder)]
    with subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as child:
        assert child.stdout.readline() == "held\n"
        # A program at another arm takes away what nobody holds: not this one.
        (folder / "touchdown-arm-10.0.0.9-1.lock").touch()
        other = ControllerLock("10.0.0.2", 10001)
        names = {path.name for path in folder.iterdir()}
        assert names == {"touchdown-arm-10.0.0.1-10001.lock", "touchdown-arm-10.0.0.2-10001.lock"}
        with pytest.raises(FaultError, match="ARM-TAKEN"):
            ControllerLock("10.0.0.1", 10001)
        child.send_signal(signal.SIGKILL)
    mine = ControllerLock("10.0.0.1", 10001)
    mine.close()
    other.close()
    assert list(folder.iterdir()) == []


@pytest.mark.promise("R11")
def test_among_many_that_come_and_go_there_is_one_at_a_time(folder):
    holders, most, turns, pause = [], [0], [0], threading.Event()

    def come_and_go(number):
        for _ in range(60):
            try:
                claim = ControllerLock("arm", 1)
            except FaultError:
                continue
            holders.append(number)
            most[0] = max(most[0], len(holders))
            turns[0] += 1
            pause.wait(0.001)
            holders.remove(number)
            claim.close()

    threads = [threading.Thread(target=come_and_go, args=(n,)) for n in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most[0] == 1
    assert turns[0] > 60
    assert list(folder.iterdir()) == []
