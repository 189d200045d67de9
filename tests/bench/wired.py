"""The emulated bench over real wires compared with the simulated one.

Real time over real sockets, terminals and pipes: on a busy computer presses are voided and
repeated, and a trial that a link fault ended is tried again. ``parts_of_the_first_probe`` uses a
stepped clock: noise of the sensor, law of the arm, and a world that falls behind.

``python -m tests.bench.wired --runs N --busy K`` runs ``stack --emulated`` N times beside K busy
processes and prints each run; ``--tree`` names another checkout, for a comparison.
"""

import argparse
import ctypes
import os
import re
import resource
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import psutil

from tests.backend.bench.wound import WoundWires, bursts, force_apart, simulated_press
from tests.bench.figures import Figure, at_least, at_most, figure, stated
from touchdown.backend.bench import EmulatedBench, Session, SimulatedBenchChoice, simulated_session
from touchdown.backend.cli.output import VerbOutput
from touchdown.backend.config.simulation import SimulationSettings
from touchdown.backend.core.events import (
    EpisodeRecorded,
    Event,
    FaultRaised,
    Paused,
    PhaseEntered,
    TrialFinished,
)
from touchdown.backend.core.faults import FaultError
from touchdown.backend.core.values import TACTILE_CHANNELS, Episode, FloatArray, Outcome
from touchdown.backend.runs import EVENT_LOG_NAME, RecordingOptions, StackRequest, read_events

FIRST_SEED, TRIALS = 300, 20
BOTTOMS = ("short", "long")
HELD = slice(15, 20)
TRIAL_ATTEMPTS = 3


@dataclass
class Run:
    """Result of one trial: end, first episode, faults."""

    ends: list[TrialFinished] = field(default_factory=list)
    episodes: list[Episode] = field(default_factory=list)
    # includes sensors that paused the run; without an operator this ends the try
    faults: list[str] = field(default_factory=list)
    presses: int = 0  # presses before the first episode; repeated presses move the piece

    def hear(self, fact: Event) -> None:
        if isinstance(fact, TrialFinished):
            self.ends.append(fact)
        elif isinstance(fact, EpisodeRecorded):
            self.episodes.append(fact.episode)
        elif isinstance(fact, PhaseEntered):
            self.presses += fact.phase == "press" and not self.episodes
        elif isinstance(fact, FaultRaised | Paused):
            self.faults.append(fact.fault.code)


def stack(session: Session, seed: int) -> Run:
    run = Run()
    leave = session.events.subscribe(run.hear)
    try:
        session.run(StackRequest("pot", (BOTTOMS[seed % 2],), seed))
    finally:
        leave()
    return run


def tried(session: Session, seed: int) -> Run:
    """Return what a trial gave; one whose devices could not be connected gave its fault alone."""
    try:
        return stack(session, seed)
    except FaultError as error:
        return Run(faults=[error.fault.code])


def held(episode: Episode) -> tuple[FloatArray, FloatArray]:
    """Return mean wrench (6,) and marker displacements (252,) px of the ticks of the hold."""
    ticks = episode.observation[HELD].astype(np.float64).mean(axis=0)
    return ticks[TACTILE_CHANNELS:], ticks[:TACTILE_CHANNELS]


def compare(trials: int = TRIALS) -> list[Figure]:
    alike, wrench_off, marker_off, presses = 0, [], [], []
    ended: Counter[str] = Counter()
    simulated = simulated_session(SimulatedBenchChoice(), keep=RecordingOptions(None))
    with EmulatedBench(SimulatedBenchChoice(), keep=RecordingOptions(None)) as bench:
        for seed in range(FIRST_SEED, FIRST_SEED + trials):
            wanted = stack(simulated, seed)
            for _ in range(TRIAL_ATTEMPTS):
                found = tried(bench.session, seed)
                if not found.faults:
                    break
                ended[found.faults[0]] += 1
                bench.session.reset()
            alike += bool(found.ends) and wanted.ends[-1].outcome is found.ends[-1].outcome
            if found.episodes and wanted.episodes:
                (wrench, px), (other, other_px) = held(wanted.episodes[0]), held(found.episodes[0])
                off = np.linalg.norm(other[:3] - wrench[:3]) / np.linalg.norm(wrench[:3])
                wrench_off.append(100.0 * float(off))
                marker_off.append(float(np.sqrt(np.mean((other_px - px) ** 2))))
                presses.append(found.presses - wanted.presses)
    simulated.close()
    note = f"{ended.total()} tries ended by a link fault and repeated"
    note += "".join(f"; {count} {code}" for code, count in ended.most_common())
    if not wrench_off:
        return [
            Figure("emulated: outcomes as simulated", 0, f"of {trials}", "", ok=False, note=note)
        ]
    wrench_pc, marker_px = float(np.median(wrench_off)), float(np.median(marker_off))
    within = sum(off <= 2.0 for off in wrench_off)
    spread = f"median; {within} of {len(wrench_off)} within 2 %, largest {max(wrench_off):.1f} %"
    repeated = [off for off, more in zip(wrench_off, presses, strict=True) if more]
    spread += f"; {sum(off <= 2.0 for off in repeated)} of {len(repeated)} after a void press"
    least, largest = round(0.9 * trials), f"median; largest {max(marker_off):.2f} px"
    return [
        at_least("emulated: outcomes as simulated", alike, f"of {trials}", least, note),
        at_most("emulated: force of the first probe", wrench_pc, "% off", 2, spread),
        at_most("emulated: markers of the first probe", marker_px, "px rms off", 0.2, largest),
    ]


@figure("wired", long=True)
def emulated_beside_simulated() -> list[Figure]:
    return compare()


MOST_PC = 2.0
BEHIND_S = 0.06
NOISY = SimulationSettings()
STILL = SimulationSettings.model_validate({"wrist": {"white_n": 0.01, "white_nm": 0.0004}})
LONGER_S = 1.7  # a longer rest before the press gives other noise and changes nothing else


def share(name: str, apart_pc: Sequence[float], *, promised: bool = True) -> Figure:
    """Return the median of one comparison, with how many are within the limit."""
    median_pc, within = float(np.median(apart_pc)), sum(pc <= MOST_PC for pc in apart_pc)
    note = f"median; {within} of {len(apart_pc)} within 2 %, largest {max(apart_pc):.1f} %"
    target, ok = ("<= 2", median_pc <= MOST_PC) if promised else ("stated", None)
    return Figure(f"first probe: {name}", median_pc, "% off", target, ok, note)


@figure("wired", long=True)
def parts_of_the_first_probe(trials: int = TRIALS) -> list[Figure]:
    noise, wires, behind, law = [], [], [], []
    for seed in range(FIRST_SEED, FIRST_SEED + trials):
        wanted = simulated_press(seed, NOISY)
        noise.append(force_apart(wanted, simulated_press(seed, NOISY, LONGER_S)))
        wires.append(force_apart(wanted, WoundWires(seed, NOISY, bursts(0.0)).press()))
        behind.append(force_apart(wanted, WoundWires(seed, NOISY, bursts(BEHIND_S)).press()))
        still = simulated_press(seed, STILL)
        law.append(force_apart(still, WoundWires(seed, STILL, bursts(0.0)).press()))
    return [
        share("simulated twice, other sensor noise", noise, promised=False),
        share("wires, stepped clock", wires),
        share("the same, world up to 60 ms behind", behind),
        share("wires, nearly no sensor noise: the arm's law", law),
    ]


BUSY_RUNS, BUSY, SETTLE_S, RUN_S, FIRST_BUSY_SEED = 20, 6, 3.0, 300.0, 1
# Computes until its standard input ends.
BUSY_PROGRAM = """
import os, select
while not select.select([0], [], [], 0)[0]:
    sum(k * k for k in range(100_000))
"""
MEMORY = Path("/dev/shm")
PR_CAPBSET_DROP, CAP_SYS_NICE = 24, 23


def drop_priority_rights() -> None:
    """Leave the rights of an ordinary user to the program that this process executes next."""
    resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
    resource.setrlimit(resource.RLIMIT_NICE, (0, 0))
    ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, CAP_SYS_NICE, 0, 0, 0)


def check_rights() -> None:
    """Raise an error if a program with dropped rights gets real-time priority or niceness -1."""
    for call in ("os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))", "os.nice(-1)"):
        ended = subprocess.run(
            [sys.executable, "-c", f"import os; {call}"],
            preexec_fn=drop_priority_rights, capture_output=True, check=False,
        )  # fmt: skip
        if b"PermissionError" not in ended.stderr:
            raise RuntimeError(f"the rights were not dropped: {call}")


@contextmanager
def busy_processes(count: int) -> Iterator[None]:
    """Run programs that compute all the time, each in a session of its own, at plain priority."""
    programs = [
        subprocess.Popen(
            [sys.executable, "-c", BUSY_PROGRAM], stdin=subprocess.PIPE, start_new_session=True
        )
        for _ in range(count)
    ]
    try:
        yield
    finally:
        for program in programs:
            program.communicate()


@dataclass(frozen=True, slots=True)
class BusyRun:
    """One run of ``stack --emulated`` beside busy processes. No fault is injected, so that each of
    ``faults`` is a false one.
    """

    seed: int
    load: float  # mean number of threads of bench and busy processes that run or could run
    average: float  # load average of the computer over a minute, at the end of the run
    outcome: str  # "refused" if the run never began
    probes: int
    repeated: int  # presses that were void or no observation
    faults: tuple[str, ...]
    said: str  # what the start says about real time
    seconds: float

    @property
    def good(self) -> bool:
        """True for a run that a fault of this computer neither ended nor prevented."""
        return not self.faults and self.outcome not in ("aborted", "refused")

    def __str__(self) -> str:
        faults = ", ".join(self.faults) or "none"
        return (
            f"seed {self.seed}: {self.outcome}, {self.probes} probes, {self.repeated} presses "
            f"repeated, false faults: {faults}; load {self.load:.1f}, load average of the computer "
            f"{self.average:.1f}, {self.seconds:.0f} s; start says: {self.said or 'nothing'}"
        )


def runnable_threads() -> int:
    """Return how many threads of the programs that this process started run or could run."""
    count = 0
    for child in psutil.Process().children(recursive=True):
        for status in Path(f"/proc/{child.pid}/task").glob("*/stat"):
            with suppress(OSError):
                count += status.read_text().rpartition(") ")[2].startswith("R")
    return count


def share_of_processors() -> str:
    """Return the weight of this program's control group against 1024 of any other."""
    found = re.search(r":cpu(?:,cpuacct)?:/([^/\n]+)", Path("/proc/self/cgroup").read_text())
    path = Path("/sys/fs/cgroup/cpu") / (found[1] if found else "") / "cpu.shares"
    if found and path.is_file():
        return path.read_text().strip()
    return "1024, shared with other programs"


def busy_run(seed: int, tree: Path) -> BusyRun:
    # In memory: delays of a disk are not measured here.
    with tempfile.TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None) as folder:
        begun_s, runnable = time.monotonic(), []
        command = ("-m", "touchdown", "stack", "--emulated", "--seed", str(seed), "--runs", folder)
        environment = {"PYTHONPATH": str(tree), "COLUMNS": "400", "TMPDIR": folder}
        with subprocess.Popen(
            [sys.executable, *command, "--no-episodes"],
            cwd=tree, env={**os.environ, **environment},
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            preexec_fn=drop_priority_rights, start_new_session=True, text=True,
        ) as child:  # fmt: skip
            while child.poll() is None and time.monotonic() - begun_s < RUN_S:
                runnable.append(runnable_threads())
                threading.Event().wait(0.5)
            child.kill()
            lines = child.communicate()[0].splitlines()
        facts = [
            fact for log in Path(folder).glob(f"*/{EVENT_LOG_NAME}") for fact in read_events(log)
        ]
    ends = [fact for fact in facts if isinstance(fact, TrialFinished)]
    found = [fact.fault.code for fact in facts if isinstance(fact, FaultRaised | Paused)]
    if ends and ends[-1].outcome is Outcome.ABORTED and not found:
        found = re.findall(r"\[([A-Z-]+)\]", ends[-1].reason) or [ends[-1].reason]
    if not ends and not found:
        found = [line.split()[-1] for line in lines if "where:" in line] or ["NO-END"]
    repeated = sum("is void" in line or "not an observation" in line for line in lines)
    return BusyRun(
        seed, statistics.fmean(runnable), os.getloadavg()[0],
        ends[-1].outcome.value if ends else "refused", ends[-1].probes if ends else 0, repeated,
        tuple(found), next((line for line in lines if "too busy" in line), ""),
        time.monotonic() - begun_s,
    )  # fmt: skip


def busy_runs(
    runs: int, busy: int, tree: Path, tell: Callable[[BusyRun], object] = lambda run: None
) -> list[BusyRun]:
    """Run the seeds one after the other beside ``busy`` processes."""
    check_rights()
    found = []
    with busy_processes(busy):
        threading.Event().wait(SETTLE_S)
        for seed in range(FIRST_BUSY_SEED, FIRST_BUSY_SEED + runs):
            found.append(busy_run(seed, tree))
            tell(found[-1])
    return found


@figure("load", long=True)
def runs_beside_busy_processes() -> list[Figure]:
    tree = Path(__file__).resolve().parents[2]
    runs = busy_runs(BUSY_RUNS, BUSY, tree)
    good, name = sum(run.good for run in runs), f"stack --emulated beside {BUSY} busy processes"
    return [
        at_least(
            f"{name}: without a false fault", good, f"of {len(runs)}", round(0.9 * len(runs)),
            "no right to real-time priority, checked; each busy process has a session of its own; "
            f"weight of the control group {share_of_processors()}",
        ),
        stated(f"{name}: load", statistics.median(run.load for run in runs), "",
               f"{min(run.load for run in runs):.1f} to {max(run.load for run in runs):.1f}"),
        stated(f"{name}: placed", sum(run.outcome == "placed" for run in runs), f"of {len(runs)}"),
        *(
            stated(f"run {number}: load {run.load:.1f}, {len(run.faults)} false faults",
                   run.outcome, "", str(run))
            for number, run in enumerate(runs, 1)
        ),
    ]  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.wired")
    parser.add_argument("--runs", type=int, default=BUSY_RUNS)
    parser.add_argument("--busy", type=int, default=BUSY)
    parser.add_argument("--tree", type=Path, default=Path(__file__).resolve().parents[2])
    args = parser.parse_args()
    screen = VerbOutput()
    runs = busy_runs(args.runs, args.busy, args.tree.resolve(), lambda run: screen.say(str(run)))
    screen.say(f"{sum(run.good for run in runs)} of {len(runs)} without a false fault")
    return 0


if __name__ == "__main__":
    sys.exit(main())
