"""Disks that refuse the n-th call of a kind, and a catalogue whose lock is held.

As a program (``python -m tests.bench.disk_faults FOLDER``) it is the recorder whose calls a
preloaded library refuses, those of SQLite included.
"""

from __future__ import annotations

import ctypes
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from tests.backend.annotations.conftest import context_for, small_episode
from tests.backend.annotations.crash_trials import Known, forked, record_one, told, verify
from tests.bench.registry import Figure, figure
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.values import Label
from touchdown.backend.core.faults import FaultError, TouchdownError

ROOT = Path(__file__).resolve().parents[2]
SOURCE = Path(__file__).with_name("disk_refusals.c")
KINDS = ("synchronising", "writing", "writing half", "renaming", "creating")
HELD_S = (0.1, 1.0, 10.0)
HOLD = """
import sqlite3, sys, time
other = sqlite3.connect(sys.argv[1], isolation_level=None)
other.execute("BEGIN IMMEDIATE")
print("held", flush=True)
time.sleep(float(sys.argv[2]))
other.execute("ROLLBACK")
"""
# episodes recorded after the refusal was armed; largest number of calls of a kind
EPISODES, LIMIT = 2, 400


@figure("faults")
def disks_that_refuse() -> list[Figure]:
    """The n-th call of each kind fails while episodes and labels are recorded, for every n."""
    name = "refusals of a disk, for every n: lost, torn, or not gone on"
    compiler = shutil.which("cc")
    if compiler is None or sys.platform != "linux":
        return [Figure(name, None, "", "0", None, "needs Linux and a C compiler")]
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        shim, disk = Path(folder) / "refusals.so", Path(folder) / "disk"
        build = [compiler, "-O1", "-shared", "-fPIC", "-o", str(shim), str(SOURCE), "-ldl"]
        subprocess.run(build, check=True)
        disk.mkdir()
        done = subprocess.run(
            [sys.executable, "-m", "tests.bench.disk_faults", str(disk)],
            cwd=ROOT, env=os.environ | {"LD_PRELOAD": str(shim), "REFUSE_ROOT": str(disk)},
            capture_output=True, text=True, check=True,
        )  # fmt: skip
    answer = json.loads(done.stdout.splitlines()[-1])
    counts, wrong = answer["refused"], answer["wrong"]
    ok = not wrong and all(0 < counts[kind] < LIMIT for kind in KINDS)
    said = ", ".join(f"{counts[kind]} x {kind}" for kind in KINDS)
    told_all = f"{sum(counts.values())} refusals: {said}" + "".join(f"; {w}" for w in wrong[:3])
    return [Figure(name, len(wrong), "", "0", ok, told_all)]


@figure("faults")
def catalogues_that_are_locked() -> list[Figure]:
    """Another process holds the lock for 0.1, 1 and 10 s while episodes are recorded."""
    known, refused, slowest_s, wrong = Known(), list[str](), 0.0, list[str]()
    with tempfile.TemporaryDirectory() as name:
        place = Path(name) / "data"
        with Dataset.open(place, person="cleo") as dataset:
            context = context_for(dataset)
            for number, held_s in enumerate(HELD_S):
                holding = [sys.executable, "-c", HOLD, str(dataset.database.path), str(held_s)]
                with subprocess.Popen(holding, stdout=subprocess.PIPE, text=True) as other:
                    assert other.stdout is not None
                    other.stdout.readline()
                    begun_s = time.monotonic()
                    try:
                        entry = dataset.record(
                            small_episode(seed=number), Label(number, -number, 0, 9),
                            source="commanded", context=context,
                        )  # fmt: skip
                        known.take(f"episode {entry.uuid} {number} -")
                    except FaultError as error:
                        slowest_s = max(slowest_s, time.monotonic() - begun_s)
                        refused.append(f"{held_s:g} s: {error.fault.code}")
                # Once it is let go, the same is done.
                entry = dataset.record(
                    small_episode(seed=90 + number), Label(1, 1, 0, 9), source="commanded",
                    context=context,
                )  # fmt: skip
                known.take(f"episode {entry.uuid} {90 + number} -")
                revision = dataset.labels.set("ann", entry.uuid, Label(number, 0, 0, 9))
                known.take(f"label {entry.uuid} {number} {revision.rev_uuid}")
        wrong += verify(place, known)
    ok = not wrong and refused == ["10 s: CATALOGUE-BUSY"] and slowest_s < 3.0
    told = f"{len(wrong)} lost, {len(known.episodes)} recorded; refused: {', '.join(refused)}"
    name = "catalogue locked by another process for 0.1, 1, 10 s: refused after"
    return [Figure(name, slowest_s, "s", "2, at 10 s alone, none lost", ok, told)]


def _scenario(place: Path, kind: int, nth: int, tell: Callable[[str], None]) -> None:
    """Record and label, whatever is refused; tell what was acknowledged, and if it was met."""
    library = ctypes.CDLL(None)
    with Dataset.open(place, person="cleo") as dataset:
        context = context_for(dataset)
        library.arm(kind, nth)
        for seed in range(EPISODES + 1):
            # The disk works again: the last call must succeed.
            last = seed == EPISODES
            if last:
                tell(f"met {library.was_refused()} - -\n")
                library.arm(-1, 0)
            try:
                record_one(dataset, tell, seed, context)
            except TouchdownError as error:
                if last:
                    tell(f"stuck {type(error).__name__} {str(error).replace(' ', '_')} -\n")
        tell("end - - -\n")


def _one(place: Path, kind: int, nth: int) -> tuple[bool, list[str]]:
    """Return whether the call was refused, and the violated requirements."""
    known, met, ended, wrong = Known(), False, False, list[str]()
    Dataset.open(place).close()
    pid, out = forked(lambda tell: _scenario(place, kind, nth, tell))
    for line in told(out):
        word, second, *_ = line.split()
        met = met or (word == "met" and second == "1")
        ended = ended or word == "end"
        if word == "stuck":
            wrong.append(line.strip())
        elif word in ("episode", "label"):
            known.take(line)
    os.waitpid(pid, 0)
    if not ended:
        wrong.append("an error that is no fault of ours ended it")
    if len(known.episodes) < EPISODES:
        wrong.append("cost more than one episode")
    return met, wrong + verify(place, known)


def _all(folder: Path) -> dict[str, object]:
    refused, wrong = dict.fromkeys(KINDS, 0), list[str]()
    for kind, name in enumerate(KINDS):
        for nth in range(1, LIMIT + 1):
            place = folder / f"{kind}-{nth}"
            met, found = _one(place, kind, nth)
            wrong += [f"{name} {nth}: {what}" for what in found]
            shutil.rmtree(place)
            if not met and not found:
                break
            refused[name] += 1
    return {"refused": refused, "wrong": wrong}


if __name__ == "__main__":
    sys.stdout.write(json.dumps(_all(Path(sys.argv[1]))) + "\n")
