"""The flight recorder against a disk that is full and a death while it writes."""

import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from touchdown.backend.core.events import FaultRaised, RunFinished, RunStarted
from touchdown.backend.rig.flight_recorder import RESERVED_BYTES, FlightRecorder, ReservedFile
from touchdown.backend.rig.link import GONE
from touchdown.backend.rig.memory import drop, make

ROOT = Path(__file__).resolve().parents[3]
RUN = RunStarted(0.0, "run", "pot", "short", "touch", 7, 1, False, "{}")
SAMPLES = 5000
"""Of a wrist sensor of 1 kHz in the time that is kept."""

RECORDING = """
import os, signal, sys
from pathlib import Path
from touchdown.backend.core.events import FaultRaised
from touchdown.backend.rig.link import GONE
from tests.backend.rig.test_flight import RUN, recorder

folder, moment = Path(sys.argv[1]), sys.argv[2]
made = recorder(folder)
made.note(RUN)

def full():
    # What else is on this disk takes all that is left.
    with (folder / "other").open("wb", buffering=0) as file:
        while file.write(bytes(4096)) == 4096:
            pass

def die(*args, **kinds):
    os.kill(os.getpid(), signal.SIGKILL)

if moment == "full":
    try:
        full()
    except OSError as error:
        assert os.strerror(error.errno) == "No space left on device", error
elif moment != "never":
    setattr(os, moment, die)
made.note(FaultRaised(6.0, GONE))
for name in sorted(p.name for p in folder.iterdir()):
    print(name, (folder / name).stat().st_size)
print((folder / "flight-1.jsonl").read_text().splitlines()[0])
"""


def recorder(folder):
    """A recorder of a rig that has felt the wrist for five seconds."""
    memory, path = make()
    drop(path)
    t_s = np.linspace(1.0, 6.0, SAMPLES)
    memory.wrench.put(t_s, np.sin(t_s[:, None] * np.arange(1, 7)))
    return FlightRecorder(lambda: memory, lambda: folder)


def child(folder, moment):
    return [sys.executable, "-c", RECORDING, str(folder), moment]


def reserves(folder):
    """Whether this file system keeps room for files without a name."""
    reserve = ReservedFile()
    able = reserve.take(folder, 4096)
    reserve.give_back()
    return able


@pytest.mark.promise("D2")
def test_a_full_disk_still_takes_the_last_seconds(tmp_path):
    small = 'mount -t tmpfs -o size=6m none "$0" && exec "$@"'
    inside = ["unshare", "-Urm", "sh", "-c", small, str(tmp_path), *child(tmp_path, "full")]
    try:
        allowed = subprocess.run(["unshare", "-Urm", "true"], check=False, capture_output=True)
    except FileNotFoundError:
        pytest.skip("only Linux has disks of one process")
    if allowed.returncode != 0:
        pytest.skip("this system gives users no disks of their own")
    done = subprocess.run(inside, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (name, size), _, head = (line.split(maxsplit=1) for line in done.stdout.splitlines())
    assert name == "flight-1.jsonl"
    assert 100 * SAMPLES < int(size) < RESERVED_BYTES
    assert json.loads(" ".join(head))["fault"]["code"] == "CONTROL-LOST"


@pytest.mark.skipif(sys.platform != "linux", reason="the room is a file without a name")
def test_killed_before_it_has_a_name_it_leaves_nothing_torn_and_no_room_taken(tmp_path):
    done = subprocess.run(child(tmp_path, "link"), cwd=ROOT, check=False)
    assert done.returncode == -signal.SIGKILL
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(sys.platform != "linux", reason="the room is a file without a name")
def test_the_room_is_given_back_with_the_run(tmp_path):
    if not reserves(tmp_path):
        pytest.skip("this file system knows no files without a name")
    made = recorder(tmp_path)

    def kept():
        held = [path for path in Path("/proc/self/fd").iterdir() if path.exists()]
        ours = [path for path in held if str(tmp_path) in str(path.readlink())]
        return [path.stat().st_blocks * 512 for path in ours]

    made.note(RUN)
    assert kept() == [RESERVED_BYTES]
    made.note(FaultRaised(6.0, GONE))
    # For the next one there is room again.
    assert kept() == [RESERVED_BYTES]
    made.note(RunFinished(7.0, "run", "failed", "lost"))
    assert kept() == []
    assert [path.name for path in tmp_path.iterdir()] == ["flight-1.jsonl"]
