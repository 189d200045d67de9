"""Kill a recorder again and again and look at what is left: ``python -m`` this module.

``steps FOLDER``: one death before and one after every durable step of recording and labelling.
``random FOLDER COUNT``: SIGKILL at random instants, always in the same dataset. Prints one JSON
object. The recorder is forked from this process, which has no threads: a death costs 0.1 s.
"""

from __future__ import annotations

import json
import os
import random
import select
import signal
import sqlite3
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tests.backend.annotations.conftest import add, context_for, small_episode
from touchdown.backend.annotations import database, episode_index
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.reconciliation import check_dataset
from touchdown.backend.annotations.values import EpisodeContext, Label
from touchdown.backend.episodes import episode_mcap
from touchdown.backend.episodes.mcap_container import McapWriter

EPISODES = 400
LONGEST_S = 0.06


class Steps:
    """Counts durable steps; kills this process at number ``last``."""

    def __init__(self, last: int) -> None:
        self.last, self.names = last, list[str]()

    def take(self, name: str) -> None:
        self.names.append(name)
        if len(self.names) == self.last:
            os.kill(os.getpid(), signal.SIGKILL)

    def around(self, owner: Any, name: str) -> None:
        original = getattr(owner, name)

        def call(*args: Any, **words: Any) -> Any:
            self.take(f"before {name}")
            answer = original(*args, **words)
            self.take(f"after {name}")
            return answer

        setattr(owner, name, call)

    def install(self) -> None:
        """Watch file creation, fsync, rename, read back and commit."""
        steps = self

        class Watched(sqlite3.Connection):
            def execute(self, sql: str, *values: Any) -> sqlite3.Cursor:
                if sql == "COMMIT":
                    steps.take("before COMMIT")
                answer = super().execute(sql, *values)
                if sql == "COMMIT":
                    steps.take("after COMMIT")
                return answer

        connect = sqlite3.connect
        database.sqlite3.connect = lambda *args, **words: connect(*args, factory=Watched, **words)
        for owner, name in ((os, "fsync"), (os, "replace"), (episode_mcap, "check_counts"),
                            (McapWriter, "add_chunk"), (McapWriter, "__init__"),
                            (episode_index, "enter_episode")):  # fmt: skip
            self.around(owner, name)


@dataclass(slots=True)
class Known:
    """Acknowledged data: episodes with their seeds, labels by revision."""

    episodes: dict[str, int] = field(default_factory=dict)
    labels: dict[str, tuple[str, int]] = field(default_factory=dict)

    def take(self, line: str) -> None:
        kind, uuid, number, rev = line.split()
        if kind == "episode":
            self.episodes[uuid] = int(number)
        else:
            self.labels[rev] = (uuid, int(number))


def record_one(
    dataset: Dataset, tell: Callable[[str], None], seed: int, context: EpisodeContext
) -> None:
    """Record one episode and label it, reporting each as soon as it is durable."""
    entry = add(dataset, Label(seed, -seed, 0, 9), seed=seed, context=context)
    tell(f"episode {entry.uuid} {seed} -\n")
    revision = dataset.labels.set("ann", entry.uuid, Label(seed + 1, 0, 0, 9))
    tell(f"label {entry.uuid} {seed + 1} {revision.rev_uuid}\n")


def record(folder: Path, tell: Callable[[str], None], first: int, count: int) -> None:
    """Record episodes and label each, reporting all that is durable."""
    with Dataset.open(folder, person="cleo") as dataset:
        context = context_for(dataset)
        for seed in range(first, first + count):
            record_one(dataset, tell, seed, context)


def forked(work: Callable[[Callable[[str], None]], None]) -> tuple[int, int]:
    """Fork a child that does ``work``; return (pid, reading end of its pipe)."""
    out, into = os.pipe()
    pid = os.fork()
    if pid:
        os.close(into)
        return pid, out
    os.close(out)
    code = 1
    try:
        work(lambda line: _write(into, line))
        code = 0
    finally:
        os._exit(code)


def _write(descriptor: int, line: str) -> None:
    os.write(descriptor, line.encode())


def told(out: int) -> Iterator[str]:
    """Yield the lines of a child until it ends."""
    with os.fdopen(out) as lines:
        for line in lines:
            if line.endswith("\n"):
                yield line


def verify(folder: Path, known: Known) -> list[str]:
    """Open the dataset after a crash; return the violated promises."""
    wrong = []
    with Dataset.open(folder) as dataset:
        entries = {entry.uuid: entry for entry in dataset.episodes()}
        for uuid, seed in known.episodes.items():
            if uuid not in entries or entries[uuid].file_state != "complete":
                wrong.append(f"episode {uuid} is lost")
            elif not np.array_equal(
                dataset.read(uuid).observation, small_episode(seed=seed).observation
            ):
                wrong.append(f"episode {uuid} has other signals")
        for rev, (uuid, x_um) in known.labels.items():
            history = {r.rev_uuid: r.label.x_um for r in dataset.labels.history(uuid)}
            if history.get(rev) != x_um:
                wrong.append(f"label {rev} is lost")
        wrong += [f"torn: {e.uuid}" for e in entries.values() if e.file_state != "complete"]
        wrong += [finding.message for finding in check_dataset(dataset.parts, whole=True)]
    with Dataset.open(folder) as dataset:
        wrong += [f"said again: {notice}" for notice in dataset.notices]
    return wrong


def steps(folder: Path) -> dict[str, object]:
    """Die before and after every step of one episode and one label."""
    home = folder / "count"
    counted = Steps(0)
    pid, out = forked(lambda tell: _count(counted, home, tell))
    names = "".join(told(out)).split("\n")[-2].split("|")
    os.waitpid(pid, 0)
    wrong: list[str] = []
    deaths = 0
    for last in range(1, len(names) + 1):
        place, known = folder / f"step-{last}", Known()
        Dataset.open(place).close()

        def work(tell: Callable[[str], None], place: Path = place, last: int = last) -> None:
            Steps(last).install()
            record(place, tell, 0, 1)

        pid, out = forked(work)
        for line in told(out):
            known.take(line)
        deaths += os.WTERMSIG(os.waitpid(pid, 0)[1]) == signal.SIGKILL
        wrong += [f"{names[last - 1]} ({last}): {what}" for what in verify(place, known)]
    return {"steps": names, "deaths": deaths, "wrong": wrong}


def _count(counted: Steps, home: Path, tell: Callable[[str], None]) -> None:
    Dataset.open(home).close()
    counted.install()
    record(home, lambda line: None, 0, 1)
    tell("|".join(counted.names) + "\n")


def random_kills(folder: Path, count: int, seed: int = 1) -> dict[str, object]:
    """Kill the recorder ``count`` times at random instants after its first report."""
    rng, known, wrong = random.Random(seed), Known(), list[str]()
    Dataset.open(folder).close()
    slowest_s, deaths = 0.0, 0
    for trial in range(count):
        first = 1000 * trial

        def work(tell: Callable[[str], None], first: int = first) -> None:
            record(folder, tell, first, EPISODES)

        pid, out = forked(work)
        os.set_blocking(out, True)
        heard = os.read(out, 1)
        select.select([], [], [], rng.uniform(0, LONGEST_S))
        os.kill(pid, signal.SIGKILL)
        with os.fdopen(out, "rb") as lines:
            heard += lines.read()
        deaths += os.WTERMSIG(os.waitpid(pid, 0)[1]) == signal.SIGKILL
        for line in heard.decode().splitlines(keepends=True):
            if line.endswith("\n"):
                known.take(line)
        began_s = time.perf_counter()
        wrong += restarted(folder)
        slowest_s = max(slowest_s, time.perf_counter() - began_s)
    wrong += verify(folder, known)
    return {
        "deaths": deaths, "episodes": len(known.episodes), "labels": len(known.labels),
        "slowest_restart_s": round(slowest_s, 3), "wrong": wrong,
    }  # fmt: skip


def restarted(folder: Path) -> list[str]:
    """Open once; only adoption and repair of leftovers may be necessary."""
    with Dataset.open(folder) as dataset:
        return [f"labels frozen: {dataset.labels.frozen}"] if dataset.labels.frozen else []


if __name__ == "__main__":
    kind, place = sys.argv[1], Path(sys.argv[2])
    answer = steps(place) if kind == "steps" else random_kills(place, int(sys.argv[3]))
    sys.stdout.write(json.dumps(answer) + "\n")
