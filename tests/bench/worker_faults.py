"""Faults of the program: failing workers, held locks, and a window beside what fails.

Processes and threads are killed, leave, raise or are stopped. A real window runs while a camera
blocks, code raises, a training dies or the catalogue is locked.
"""

import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import psutil

from tests.backend.devices.waiting import until
from tests.backend.exchange.test_imports import lerobot_21
from tests.backend.rig.served import Backend, Served
from tests.bench.children.failing_window import HOOKS, THREADS, WAYS, failed_s
from tests.bench.children.faulty_window import FIRST_LABELS, HELD_S, LABELS
from tests.bench.children.watched_arm import watched_arm
from tests.bench.figures import Figure, at_least, at_most, failures, figure, stated
from tests.bench.labelling import fill
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.bench import EmulatedBench, SimulatedBenchChoice
from touchdown.backend.core import FaultError, InputError, lock_file
from touchdown.backend.episodes.packs import read_pack
from touchdown.backend.exchange.imports import read_foreign
from touchdown.backend.jobs import JobContext, JobSpec, JobStore, ProcessPool
from touchdown.backend.runs import RecordingOptions, SceneChoice

ASKED, KILLS = 100, 20
TOLD_S, GONE_S, FREE_MS = 0.5, 3.0, 10.0
LIMIT_S = 180.0
WINDOW = "tests.bench.children.failing_window"
HOLDS = {
    "robot": "from touchdown.backend.devices.melfa.sockets import ControllerLock; "
    "it = ControllerLock('10.0.0.1', 10001)",
    "dataset": "from touchdown.backend.core.files import lock_file; from pathlib import Path; "
    "it = lock_file(Path('writer.lock'))",
}


@contextmanager
def hooked() -> Iterator[Mapping[str, str]]:
    """An environment whose interpreters fail on a signal, each in its way."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "sitecustomize.py").write_text(HOOKS)
        paths = [folder, str(Path.cwd()), os.environ.get("PYTHONPATH", "")]
        path = os.pathsep.join(filter(None, paths))
        yield {**os.environ, "PYTHONPATH": path, "QT_QPA_PLATFORM": "offscreen"}


def window(
    environment: Mapping[str, str], *words: str, module: str = WINDOW, limit_s: float = LIMIT_S
) -> dict[str, float | str]:
    """Let a worker of a window fail in a process of its own; return what came of it."""
    missed: dict[str, float | str] = {"told_s": limit_s, "closed_s": limit_s, "left": 0}
    try:
        done = subprocess.run(
            [sys.executable, "-m", module, *words], env=environment, capture_output=True, text=True,
            timeout=limit_s, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return {**missed, "named": "nothing"}
    if done.returncode or not done.stdout:
        return {**missed, "named": (done.stderr.strip().splitlines() or ["nothing"])[-1]}
    found: dict[str, float | str] = json.loads(done.stdout.splitlines()[-1])
    return found


@figure("faults")
def failing_workers() -> list[Figure]:
    """Processes and threads that raise, leave, are killed, crash, stop or deadlock."""
    found: dict[str, dict[str, float | str]] = {}
    with hooked() as environment:
        for way in WAYS:
            found[f"training {way}"] = window(environment, "worker", "training", way)
        for way in ("raises", "deadlock"):
            found[f"bench {way}"] = window(environment, "worker", "bench", way)
    with failing_children():
        found |= {f"rig {way}": rig(number) for way, number in WAYS.items()}
    return [
        worst(found, "told_s", "a failing worker is named after, worst", "s", TOLD_S),
        worst(found, "closed_s", "everything is closed after a failing worker, worst", "s", GONE_S),
        worst(found, "left", "processes left after a failing worker", "", 0.0),
    ]


def rig(number: signal.Signals) -> dict[str, float | str]:
    """Let the rig fail while the arm moves; return what the backend made of it."""
    served = Served()
    backend = Backend(served.settings)
    try:
        backend.moving()
        process = psutil.Process(backend.link.hello["pid"])
        begun_s = time.monotonic()
        os.kill(process.pid, number)
        until(lambda: backend.interlock.latched)
        told_s = time.monotonic() - failed_s(process.pid, begun_s)
        named = backend.interlock.faults[0].code
        begun_s = time.monotonic()
        backend.close()
        closed_s = time.monotonic() - begun_s
    finally:
        backend.close()
        served.close()
    return {"told_s": told_s, "named": named, "closed_s": closed_s, "left": process.is_running()}


def worst(
    found: Mapping[str, Mapping[str, float | str]], key: str, name: str, unit: str, most: float
) -> Figure:
    """Return the largest of one value over all workers and ways."""
    values = {case: float(one[key]) for case, one in found.items()}
    case = max(values, key=lambda one: values[one])
    over = [f"{one} {value:.2f} ({found[one]['named']})" for one, value in values.items()
            if value > most]  # fmt: skip
    told = f"{case}; {len(values)} cases" + "".join(f"; {one}" for one in over)
    return at_most(name, values[case], unit, most, told)


@figure("faults", long=True)
def quitting_asked_for_by_workers(asked: int = ASKED) -> list[Figure]:
    """Each kind of thread requests the end of the program: time until the process has ended."""
    took_s: list[tuple[float, str]] = []
    for number in range(asked):
        thread = THREADS[number % len(THREADS)]
        with (
            hooked() as environment,
            subprocess.Popen(
                [sys.executable, "-m", WINDOW, "quit", thread],
                env=environment,
                stdout=subprocess.PIPE,
                text=True,
            ) as child,
        ):
            assert child.stdout is not None
            said = child.stdout.readline()
            try:
                child.wait(LIMIT_S)
                took_s.append((time.monotonic() - float(said), thread))
            except (subprocess.TimeoutExpired, ValueError):
                child.kill()
                took_s.append((LIMIT_S, thread))
    in_time = sum(taken_s <= GONE_S for taken_s, _ in took_s)
    slowest_s, thread = max(took_s)
    told = f"slowest {slowest_s:.2f} s ({thread}); threads: {', '.join(THREADS)}"
    name = "gone within 3 s of being asked by a worker"
    return [Figure(name, f"{in_time} of {asked}", "", "all", in_time == asked, told)]


@figure("faults")
def locks_of_killed_programs() -> list[Figure]:
    """From kill -9 of who holds the robot, or a dataset, until its lock can be taken.

    A second program that is refused at the robot tries again every 20 ms by itself.
    """
    rows = []
    for kind, code in HOLDS.items():
        took_ms = [_freed_ms(code) for _ in range(KILLS)]
        told = f"{KILLS} kills; median {sorted(took_ms)[KILLS // 2]:.1f} ms"
        name, worst_ms = f"{kind} free after kill -9, worst", max(took_ms)
        rows.append(at_most(name, worst_ms, "ms", FREE_MS, told))
    return rows


def _freed_ms(code: str) -> float:
    held = f"import sys, tempfile; tempfile.tempdir = '.'; {code}; print(1, flush=True); input()"
    with tempfile.TemporaryDirectory() as folder:
        command: Sequence[str] = [sys.executable, "-c", held]
        with subprocess.Popen(
            command, cwd=folder, env={**os.environ, "PYTHONPATH": str(Path.cwd())},
            stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        ) as child:  # fmt: skip
            assert child.stdout is not None
            child.stdout.readline()
            (path,) = Path(folder).glob("*.lock")
            assert not _taken(path)
            pause, begun_s = threading.Event(), time.monotonic()
            child.kill()
            while not _taken(path):
                pause.wait(0.0002)
            return 1e3 * (time.monotonic() - begun_s)


def _taken(path: Path) -> bool:
    try:
        os.close(lock_file(path))
    except BlockingIOError:
        return False
    return True


READS = ("raises", "leaves", "killed", "crashes", "stopped", "deadlock")
# The devices continue without the thread that waits for the next scene; its deadlock is reported
# with the next scene.
SERVES = ("raises", "leaves", "killed", "crashes", "stopped")
NAMES = {"BENCH-GONE", "BENCH-STILL"}
NEXT_SCENE_S = 15.0
BEGUN_S = 0.1  # processor time after which a reader has started its work
Found = dict[str, float | str]


def work(spec: JobSpec, _: JobContext) -> Mapping[str, Any]:
    """Compute until there is a file that ends it."""
    end = Path(str(spec.params["end"]))
    while not end.exists():
        sum(range(100_000))
    return {}


@contextmanager
def failing_children() -> Iterator[None]:
    """Let all interpreters that are started meanwhile fail on a signal, each in its way."""
    with hooked() as environment, mock.patch.dict(os.environ, environment):
        yield


def strike(number: int, way: str, told: Callable[[], str]) -> Found:
    """Let the process fail; return who was named, and how long after it had."""
    asked_s = time.monotonic()
    os.kill(number, WAYS[way])
    until(told)
    return {"told_s": time.monotonic() - failed_s(number, asked_s), "named": told()}


def closed(found: Found, close: Callable[[], object], before: set[psutil.Process]) -> Found:
    """Close what is left; add how long that took, and what is left even then."""
    begun_s = time.monotonic()
    close()
    found["closed_s"] = time.monotonic() - begun_s
    found["left"] = len(children() - before)
    return found


def children() -> set[psutil.Process]:
    return set(psutil.Process().children(recursive=True))


def emulated(way: str) -> Found:
    """The process of the emulated bench, while a live session stands on it."""
    before = children()
    bench = EmulatedBench(SimulatedBenchChoice(preset="quiet"), keep=RecordingOptions(None))
    try:
        bench.session.prepare(SceneChoice())
        bench.session.open()
        (number,) = (p.pid for p in children() - before if "emulated_child" in p.cmdline()[-1])

        def told() -> str:
            codes = {fault.code for fault in bench.session.interlock.faults}
            return ", ".join(codes & NAMES)

        found = strike(number, way, told)
    except BaseException:
        bench.close()
        raise
    return closed(found, bench.close, before)


def next_scene() -> Found:
    """Deadlock of the thread that waits for the next scene: time until reported."""
    before = children()
    bench = EmulatedBench(SimulatedBenchChoice(preset="quiet"), keep=RecordingOptions(None))
    try:
        bench.session.prepare(SceneChoice())
        (child,) = (p for p in children() - before if "emulated_child" in p.cmdline()[-1])
        os.kill(child.pid, WAYS["deadlock"])
        until(lambda: failed_s(child.pid, 0.0))
        asked_s, named = time.monotonic(), "nothing"
        try:
            bench.session.prepare(SceneChoice())
        except FaultError as error:
            named = error.fault.code
        found: Found = {"told_s": time.monotonic() - asked_s, "named": named}
        bench.session.prepare(SceneChoice())
    finally:
        begun_s = time.monotonic()
        bench.close()
    found["left"], found["closed_s"] = len(children() - before), time.monotonic() - begun_s
    return found


def reading(way: str) -> Found:
    """The reader of a foreign file, as soon as it is at work."""
    before, said = children(), list[str]()
    with tempfile.TemporaryDirectory() as folder:
        path = lerobot_21(Path(folder) / "set")

        def read() -> None:
            try:
                list(read_foreign("lerobot", path))
            except InputError as error:
                said.append(error.what)

        thread = threading.Thread(target=read)
        thread.start()
        until(lambda: children() - before)
        (child,) = children() - before
        until(lambda: child.cpu_times().user > BEGUN_S)
        found = strike(child.pid, way, lambda: "".join(said))
        return closed(found, thread.join, before)


class Told(Exception):  # noqa: N818 - what Ctrl-C is for its operator
    """Ends the wait for jobs at the first report."""


def pooled(way: str) -> Found:
    """A worker of a pool, amid a job; whoever waits for it gives up when he is told."""
    before, said = children(), list[str]()

    def tell(text: str) -> None:
        said.append(text)
        raise Told

    with tempfile.TemporaryDirectory() as folder:
        end = Path(folder) / "end"
        pool = ProcessPool({"work": work}, JobStore(Path(folder) / "store"), 1, tell)
        job = JobSpec("work", {"end": str(end)})
        pool.submit(job)
        (worker,) = children() - before - trackers()
        until(lambda: pool._workers.has_begun(job.id))
        asked_s = time.monotonic()
        os.kill(worker.pid, WAYS[way])
        with suppress(Told):
            said.extend(result.error.splitlines()[-1] for result in pool.finished())
        told_s = time.monotonic() - failed_s(worker.pid, asked_s)
        found: Found = {"told_s": told_s, "named": said[0]}
        return closed(found, pool.close, before | trackers())


def trackers() -> set[psutil.Process]:
    """Return what the library keeps for the life of this process, beside its workers."""
    return {one for one in children() if "resource_tracker" in " ".join(one.cmdline())}


@figure("faults")
def failing_children_without_a_window() -> list[Figure]:
    """The emulated bench, the reader of an import and the workers of a pool, in every way."""
    found: dict[str, Found] = {}
    with failing_children():
        found |= {f"import {way}": reading(way) for way in READS}
        found |= {f"pool {way}": pooled(way) for way in WAYS}
        found |= {f"emulated bench {way}": emulated(way) for way in SERVES}
        later = {"next scene deadlock": next_scene()}
    named = later["next scene deadlock"]["named"]
    text = f"a scene that is never set is told after ({named})"
    found |= {case: {**one, "told_s": 0.0} for case, one in later.items()}
    return [
        worst(later, "told_s", text, "s", NEXT_SCENE_S),
        worst(found, "told_s", "a failing child is named after, worst", "s", TOLD_S),
        worst(found, "closed_s", "everything is closed after a failing child, worst", "s", GONE_S),
        worst(found, "left", "processes left after a failing child", "", 0.0),
    ]


FAULTY_WINDOW, SCENARIO_S = "tests.bench.children.faulty_window", 600.0
RATES = ("left_fps", "right_fps", "traces_fps")
MOST_GAP_MS, MOST_PERCENT, LEAST_KEPT = 100.0, 30.0, 0.9
MOST_LINES_PER_S, MOST_LOG_BYTES = 5.0, 10_000_000
EPISODES = 30
Measured = Mapping[str, Mapping[str, float]]


def measured_window(*words: str, **environment: str) -> dict[str, Any]:
    """Run a scenario in a window of its own; raises InputError if the window did not survive."""
    with hooked() as hooks:
        found = window({**hooks, **environment}, *words, module=FAULTY_WINDOW, limit_s=SCENARIO_S)
    if "named" in found:
        raise InputError(f"The window ended early: {found['named']}.", words[0], "See its output.")
    return found | {"gone_s": time.monotonic()}


def _gap(name: str, gap_ms: float, note: str) -> Figure:
    return at_most(name, gap_ms, "ms", MOST_GAP_MS, note)


def _kept(name: str, share: float, note: str) -> Figure:
    text = f"{name}: frame rates kept, worst of three views"
    return at_least(text, share, "of 1", LEAST_KEPT, note)


def _rates(one: Mapping[str, float]) -> str:
    return "/".join(f"{one[name]:.1f}" for name in RATES)


@figure("faults")
def camera_that_blocks_beside_a_window() -> list[Figure]:
    """The longest gap of the window's ticks, and quitting while a read is blocked."""
    with watched_arm() as arm:
        found = measured_window("blocked camera", str(arm.lab))
    closed_s = found["gone_s"] - found["asked_s"]
    note = f"a read of 10 s; {found['usual_ms']:.0f} ms in 5 s before; cards {found['cards']}"
    return [
        _gap("longest gap of the window's ticks, camera blocked", found["blocked_ms"], note),
        at_most("window gone after quitting, camera blocked", closed_s, "s", GONE_S),
    ]  # fmt: skip


@figure("faults", long=True)
def exceptions_of_every_kind() -> list[Figure]:
    """In a slot, a timer, a paint event, a thread and a queued call: once, then at every tick."""
    kinds: Measured = measured_window("exceptions")["kinds"]
    told_s = max(one["told_s"] for one in kinds.values())
    lines = max(one["lines_per_s"] for one in kinds.values())
    times = ", ".join(f"{kind} {1e3 * one['told_s']:.0f} ms" for kind, one in kinds.items())
    loud = ", ".join(f"{kind} {one['lines_per_s']:.1f}" for kind, one in kinds.items())
    return [
        at_most("exception: its card is there after, worst", told_s, "s", TOLD_S, times),
        at_most("log of an exception at every tick", lines, "lines/s", MOST_LINES_PER_S, loud),
    ]  # fmt: skip


@figure("faults")
def window_beside_the_same_error_in_every_frame() -> list[Figure]:
    """Share of a core, frame rates and longest gap of the window, with the error and without."""
    found = measured_window("error in every frame")
    kinds: Mapping[str, Measured] = found["kinds"]

    def note(words: Callable[[Mapping[str, float]], str]) -> str:
        return "; ".join(f"{kind} {words(one['with'])}, without {words(one['without'])}"
                         for kind, one in kinds.items())  # fmt: skip

    def worst(key: str) -> tuple[float, str]:
        value = max(one["with"][key] for one in kinds.values())
        return value, note(lambda one: f"{one[key]:.1f}")

    percent, shares = worst("core_percent")
    kept = min(one["with"][name] / one["without"][name] for one in kinds.values() for name in RATES)
    log_bytes = found["log_bytes"]
    return [
        _kept("error in every frame", kept, note(_rates)),
        at_most("error in every frame: share of a core, worst", percent, "%", MOST_PERCENT, shares),
        _gap("error in every frame: longest gap, worst", *worst("gap_ms")),
        Figure("error in every frame: log", log_bytes / 1e3, "kB", "<= 10,000",
               log_bytes <= MOST_LOG_BYTES, f"errors: {found['raised']}"),
    ]  # fmt: skip


@figure("faults")
def window_beside_a_training_without_memory() -> list[Figure]:
    """Frame rates and longest gap before, beside and after it, and while it dies."""
    ways: Mapping[str, Measured] = measured_window("dying training")["ways"]
    kept, gap_ms, notes = 1.0, 0.0, list[str]()
    for way, whens in ways.items():
        # The window alone, before and after: both include the other load of the machine.
        alone = {name: (whens["before"][name] + whens["after"][name]) / 2.0 for name in RATES}
        for when in ("beside", "dying"):
            kept = min(kept, *(whens[when][name] / alone[name] for name in RATES))
            gap_ms = max(gap_ms, whens[when]["gap_ms"])
        rows = (f"{w} {_rates(one)}, gap {one['gap_ms']:.0f} ms" for w, one in whens.items())
        notes.append(f"{way}: {', '.join(rows)}")
    name = "training that dies: longest gap of the window's ticks"
    return [_kept("training that dies", kept, "; ".join(notes)), _gap(name, gap_ms, "")]


@figure("faults")
def labels_while_the_catalogue_is_locked() -> list[Figure]:
    """The longest gap of the window's ticks while labels wait, and how many of them were lost."""
    with tempfile.TemporaryDirectory() as name:
        place = Path(name) / "dataset"
        fill(place, EPISODES, EPISODES)
        found = measured_window("locked catalogue", TOUCHDOWN_DATA=name)
        asked: Mapping[str, tuple[int, int]] = found["asked"]
        with Dataset.open(place, write=False) as dataset:
            heads = {uuid: dataset.labels.head(uuid) for uuid in asked}
    lost = [
        uuid for uuid, (x_um, y_um) in asked.items() if heads[uuid].state != "submitted"
        or (heads[uuid].label.x_um, heads[uuid].label.y_um) != (x_um, y_um)
    ]  # fmt: skip
    locked = found["locked"]
    note = "; ".join(
        f"{held_s} s {gap_ms:.0f} ms ({found['waited'][held_s]} waited), not locked "
        f"{found['free'][held_s]:.0f} ms" for held_s, gap_ms in locked.items()
    )  # fmt: skip
    all_asked = len(asked) == FIRST_LABELS + 2 * LABELS * len(HELD_S)
    return [
        _gap("catalogue locked: longest gap of the window's ticks", max(locked.values()), note),
        Figure("catalogue locked: labels of the Label page lost", len(lost), f"of {len(asked)}",
               "0", not lost and all_asked, ", ".join(lost)),
    ]  # fmt: skip


SHARDS, KILLS_EACH, SHARD_CPU_S = 50, 2, 1.2
SHARD_WORDS = (
    "simulate", "--piece", "pot", "--bottoms", "circle15,circle25,square15", "--episodes", "6600",
    "--probes-per-grip", "6", "--seed", "1", "--start", "2026-01-31T12:00:00Z",
    "--executor", "serial",
)  # fmt: skip


class ShardWorker:
    """Process of one shard, started again after each kill; killed at random processor times."""

    def __init__(self, out: Path, number: int) -> None:
        words = (*SHARD_WORDS, "--shard", f"{number}/{SHARDS}", "--out", str(out))
        self.command = [sys.executable, "-m", "touchdown", *words]
        rng = np.random.default_rng([24, number])
        self.instants_s = list(rng.uniform(0.0, SHARD_CPU_S, KILLS_EACH))
        self.killed, self.ended, self.codes = 0, False, list[int]()
        self.start()

    def start(self) -> None:
        self.child = psutil.Popen(
            self.command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )  # fmt: skip

    def look(self) -> None:
        """Kill the process if its instant has come; start it again unless it is done."""
        if self.child.poll() is not None:
            self.codes.append(self.child.returncode)
            self.ended = self.child.returncode == 0
        elif self.killed < KILLS_EACH:
            with suppress(psutil.NoSuchProcess):
                if sum(self.child.cpu_times()[:2]) < self.instants_s[self.killed]:
                    return
                self.child.kill()
                self.child.wait()
                self.killed += 1
        else:
            return
        if not self.ended:
            self.start()


@figure("shards", long=True)
def fifty_killed_workers() -> list[Figure]:
    """Kill 50 workers of a sharded simulation, two times each; compare with one process."""
    with tempfile.TemporaryDirectory() as name:
        out, alone = Path(name) / "shards", Path(name) / "alone"
        began_s, workers = time.monotonic(), [ShardWorker(out, k) for k in range(SHARDS)]
        seen: dict[str, tuple[int, int]] = {}
        repeated: set[str] = set()
        while not all(worker.ended for worker in workers):
            for worker in workers:
                if not worker.ended:
                    worker.look()
            for path in out.glob(".jobs/*/result.json"):
                about = path.stat()
                mark = (about.st_ino, about.st_mtime_ns)
                if seen.setdefault(path.parent.name, mark) != mark:
                    repeated.add(path.parent.name)
            threading.Event().wait(0.05)
        took_s = time.monotonic() - began_s
        amid = len(list(out.glob(".jobs/.*.part")))
        for folder in (out, alone):  # the first call finds nothing to do
            words = [sys.executable, "-m", "touchdown", *SHARD_WORDS, "--out", str(folder)]
            subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
        planned, done = ({p.name for p in f.glob(".jobs/[!.]*")} for f in (alone, out))
        packs, expected = ({p.name: p.read_bytes() for p in f.glob("*.mcap")} for f in (out, alone))
        uuids = [row.label["episode"] for p in sorted(out.glob("*.mcap")) for row in read_pack(p)]
    kills = sum(worker.killed for worker in workers)
    failed = [code for worker in workers for code in worker.codes if code not in (0, -9)]
    wrong = [key for key in packs.keys() | expected.keys() if packs.get(key) != expected.get(key)]
    of = f"{len(planned)} jobs, {SHARDS} workers, {kills} kills, {amid} of them amid a job"
    return [
        failures("shards: jobs missing or not planned", len(planned ^ done), "", of),
        failures("shards: jobs done twice", len(repeated), ""),
        failures("shards: episodes twice", len(uuids) - len(set(uuids)), f"of {len(uuids)}"),
        failures("shards: packs other than those of one process", len(wrong), f"of {len(packs)}"),
        failures("shards: workers that ended with an error", len(failed), ""),
        stated("shards: time until all jobs are done", took_s, "s"),
    ]
