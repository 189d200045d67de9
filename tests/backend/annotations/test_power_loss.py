"""Power loss at every step of recording and labelling, on a simulated disk, and refusing disks."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.backend.annotations.crash_trials import Known, record, verify
from tests.backend.annotations.disk_model import Disk, Done, Part, read_log

HERE = Path(__file__).parent
ROOT = HERE.parents[2]
COMPILER = shutil.which("cc")
PARTS = (Part(0.0, 0.0), Part(1.0, 0.0), Part(0.0, 1.0), Part(1.0, 1.0),
         Part(0.5, 0.5, 1), Part(0.5, 1.0, 2))  # fmt: skip
EPISODES = 2

pytestmark = pytest.mark.skipif(
    not (sys.platform == "linux" and COMPILER), reason="needs Linux and a C compiler"
)


def preloaded(place: Path, library: str, module: str, **variables: str) -> str:
    """Run a module on ``place``/disk with a library of this folder preloaded; return its output."""
    shim, source = place / "shim.so", HERE / library
    build = [str(COMPILER), "-O1", "-shared", "-fPIC", "-o", shim, source, "-ldl", "-pthread"]
    subprocess.run(build, check=True)
    (place / "disk").mkdir()
    environment = os.environ | {"LD_PRELOAD": str(shim), **variables}
    command = [sys.executable, "-m", f"tests.backend.annotations.{module}", place / "disk"]
    done = subprocess.run(
        command, cwd=ROOT, env=environment, check=True, stdout=subprocess.PIPE, text=True
    )
    return done.stdout


def traced(place: Path) -> list[Done]:
    """Let a child record and label two episodes; return all that it did to the disk."""
    log = place / "log"
    variables = {"TRACE_ROOT": str(place / "disk"), "TRACE_LOG": str(log)}
    preloaded(place, "disk_trace.c", "test_power_loss", **variables)
    return read_log(log)


def lay_out(root: Path, files: dict[str, bytes]) -> None:
    """Put the disk into a state, at the place where it was."""
    shutil.rmtree(root)
    root.mkdir()
    for name, content in files.items():
        path = Path(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


@pytest.mark.promise("D1", "D3")
@pytest.mark.slow
def test_power_lost_at_any_step_loses_nothing_acknowledged(place):
    trace = traced(place)
    root = place / "disk"
    disk, known = Disk(root), Known()
    seen, wrong, said = set[tuple[int, frozenset[tuple[str, int]]]](), list[str](), list[str]()
    for number, done in enumerate([*trace, Done("S", 0, 0, "the end", "", b"")]):
        if done.path == f"{root}/told":
            if done.kind == "W":
                said.append(done.data.decode())
                known.take(said[-1])
            continue
        # Between two synchronisations the states at the end hold all those before.
        if done.kind == "S":
            for part in PARTS:
                files = disk.states(part)
                files = {name: data for name, data in files.items() if not name.endswith("-shm")}
                state = frozenset((name, hash(data)) for name, data in files.items())
                if (len(said), state) in seen:
                    continue
                seen.add((len(said), state))
                lay_out(root, files)
                found = verify(root / "data", known)
                wrong += [f"{number} before {done.kind} {done.path}, {part}: {w}" for w in found]
        if done.path != "the end":
            disk.do(done)
    assert wrong == []
    assert len(known.episodes) == EPISODES
    assert len(known.labels) == EPISODES
    assert len(seen) > 100


@pytest.mark.promise("D1", "D2", "D3")
@pytest.mark.slow
def test_a_disk_that_refuses_a_call_loses_nothing_acknowledged(place):
    root = str(place / "disk")
    answer = json.loads(preloaded(place, "disk_refusals.c", "refusing_disk", REFUSE_ROOT=root))
    assert answer["wrong"] == []
    least = {"synchronising": 20, "writing": 5, "writing half": 5, "renaming": 3, "creating": 5}
    assert {kind: count for kind, count in answer["refused"].items() if count < least[kind]} == {}


def test_the_model_loses_what_was_not_synchronised(tmp_path):
    """A rename without its data is an empty file, a folder's entry alone is enough to lose all."""
    root = str(tmp_path)
    disk = Disk(tmp_path)
    for done in (
        Done("M", 9, 0, f"{root}/a", "", b""),
        Done("O", 1, 0, f"{root}/a/.x.part", "", b""),
        Done("W", 1, 0, f"{root}/a/.x.part", "", b"0123456789"),
        Done("R", 0, 0, f"{root}/a/.x.part", f"{root}/a/x", b""),
    ):
        disk.do(done)
    assert disk.states(Part(1.0, 0.0)) == {}
    assert disk.states(Part(0.0, 1.0)) == {f"{root}/a/x": b""}
    assert disk.states(Part(1.0, 1.0)) == {f"{root}/a/x": b"0123456789"}
    disk.do(Done("S", 1, 0, f"{root}/a/x", "", b""))
    disk.do(Done("S", 9, 0, f"{root}/a", "", b""))
    assert disk.states(Part(0.0, 0.0)) == {}
    disk.do(Done("S", 8, 0, root, "", b""))
    assert disk.states(Part(0.0, 0.0)) == {f"{root}/a/x": b"0123456789"}
    disk.do(Done("W", 1, 2, f"{root}/a/x", "", bytes(8192)))
    drawn = {disk.states(Part(0.5, 1.0, seed))[f"{root}/a/x"] for seed in range(40)}
    assert len(drawn) > 3


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    # One write a word, so that each stands in the trace where it was said.
    told = os.open(folder / "told", os.O_WRONLY | os.O_CREAT)

    def tell(line: str) -> None:
        os.write(told, line.encode())

    record(folder / "data", tell, 0, EPISODES)
