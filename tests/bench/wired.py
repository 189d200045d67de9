"""The emulated bench over real wires compared with the simulated one, and an operator's day.

Real time over real sockets, terminals and pipes: on a busy computer presses are voided and
repeated, and a trial that a link fault ended is tried again. ``parts_of_the_first_probe`` uses a
stepped clock: noise of the sensor, law of the arm, and a world that falls behind.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tests.backend.emulators.wound import WoundWires, bursts, force_apart, simulated_press
from tests.bench.registry import Figure, figure
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.bench.assembly import SimulatedBenchChoice, simulated_session
from touchdown.backend.bench.emulated import EmulatedBench
from touchdown.backend.bench.session import Session
from touchdown.backend.config.method import SAMPLES_PER_PROBE
from touchdown.backend.config.simulation import SimulationSettings
from touchdown.backend.core.events import (
    EpisodeRecorded,
    Event,
    FaultRaised,
    FaultsReset,
    Paused,
    PhaseEntered,
    ProbeCollected,
    RunFinished,
    TrialFinished,
)
from touchdown.backend.core.faults import FaultError, RefusedError, StaleSampleError
from touchdown.backend.core.values import CHANNELS, TACTILE_CHANNELS, Episode, FloatArray
from touchdown.backend.devices.jog import JogOrder
from touchdown.backend.emulation.fault_plan import FaultPlan
from touchdown.backend.learning.training_runs import list_training_runs
from touchdown.backend.runs.campaign import newest_campaign
from touchdown.backend.runs.event_log import read_events
from touchdown.backend.runs.recorder import RecordingOptions
from touchdown.backend.runs.requests import (
    CollectRequest,
    ProbeRequest,
    Request,
    SceneChoice,
    StackRequest,
)

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
    least = round(0.9 * trials)
    return [
        Figure(
            "emulated: outcomes as simulated",
            alike,
            f"of {trials}",
            f">= {least}",
            alike >= least,
            note,
        ),
        Figure(
            "emulated: force of the first probe", wrench_pc, "% off", "<= 2", wrench_pc <= 2, spread
        ),
        Figure(
            "emulated: markers of the first probe",
            marker_px,
            "px rms off",
            "<= 0.2",
            marker_px <= 0.2,
            f"median; largest {max(marker_off):.2f} px",
        ),
    ]


@figure("wired")
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


@figure("wired")
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


PROBES, DAY_ATTEMPTS = 4, 8
SETTLE_S = 1.5  # start-up time of the sensors
# commanded; near the surface the speed is that of contact
JOG_MM_S, JOG_S, LEAST_MM = 10.0, 1.0, 1.0
PERSON = "bench"
# plugs pulled one after the other, during the probes of a scene
PULLED, PULLED_AT_S, PULLED_S = ("force_torque", "tactile_left", "arm"), 14.0, 3.0
TINY = ("--labels", "submitted", "--divide-series", "--epochs", "1")


class Day:
    """One day in ``folder``; each part returns True on success."""

    def __init__(self, folder: Path, bench: EmulatedBench, dataset: Dataset) -> None:
        self.folder, self.bench, self.session, self.dataset = folder, bench, bench.session, dataset
        self.facts: list[Event] = []
        self.again = self.presses = 0
        self.session.events.subscribe(self.facts.append)

    def parts(self) -> tuple[Callable[[], bool], ...]:
        return (
            *(self.connect, self.jog, self.probe, self.collect),
            *(self.label, self.train, self.stack, self.review),
        )

    def connect(self) -> bool:
        return self.tried(lambda: self.session.prepare(SceneChoice("pot", ("circle15",), 3))) and (
            self.session.hand is not None
        )

    def jog(self) -> bool:
        """Hold the pad that rises."""

        def hold() -> None:
            session, hand = self.session, self.session.hand
            assert hand is not None
            begin_s = session.clock_s()
            while session.clock_s() < begin_s + SETTLE_S:
                session.advance()
            before_mm = session.devices["arm"].pose(1.0).z_mm
            self.presses += 1
            end_s, sequence = session.clock_s() + JOG_S, 0
            while session.clock_s() < end_s:
                now_s, sequence = session.clock_s(), sequence + 1
                hand.jog.renew(JogOrder(self.presses, sequence, now_s, "z", "XYZ", JOG_MM_S))
                session.advance()
            hand.jog.end(self.presses)
            risen_mm.append(session.devices["arm"].pose(1.0).z_mm - before_mm)

        risen_mm: list[float] = []
        return self.tried(hold) and risen_mm[-1] >= LEAST_MM

    def probe(self) -> bool:
        return self.run(ProbeRequest())

    def collect(self) -> bool:
        self.session.dataset = self.dataset
        asked = CollectRequest(count=PROBES, person=PERSON, seed=3, probes_per_grip=2)

        def request() -> Request:
            found = newest_campaign(self.dataset.folder)
            return CollectRequest(campaign=found, person=PERSON) if found else asked

        ended = self.run(request)
        told = [fact.uuid for fact in self.facts if isinstance(fact, ProbeCollected)]
        kept = {entry.uuid for entry in self.dataset.episodes()}
        return ended and len(kept) >= PROBES and set(told) <= kept

    def label(self) -> bool:
        for entry in self.dataset.episodes():
            self.dataset.labels.accept(PERSON, entry.uuid)
        return all(
            self.dataset.labels.head(entry.uuid).state == "submitted"
            for entry in self.dataset.episodes()
        )

    def train(self) -> bool:
        """A tiny model of what was collected, in a process of its own."""
        self.session.dataset = None
        data, out = self.dataset.folder, self.folder / "tiny.safetensors"
        words = ["train", data, "--out", out, *TINY]
        done = subprocess.run(
            [sys.executable, "-m", "touchdown", *map(str, words)], capture_output=True, check=False
        )
        return done.returncode == 0 and out.is_file() and bool(list_training_runs(data))

    def stack(self) -> bool:
        return self.run(StackRequest("pot", ("short",), 301))

    def review(self) -> bool:
        """Compare the files of the newest run with its events."""
        folder = self.session.run_folder
        told = [fact for fact in self.facts if isinstance(fact, TrialFinished)]
        assert folder is not None
        read = [fact for fact in read_events(folder) if isinstance(fact, TrialFinished)]
        return bool(read) and read[-1].outcome is told[-1].outcome

    def run(self, request: Request | Callable[[], Request]) -> bool:
        def once() -> None:
            self.session.run(request() if callable(request) else request)

        held = self.tried(once)
        return held and [f for f in self.facts if isinstance(f, RunFinished)][-1].ending == (
            "finished"
        )

    def tried(self, act: Callable[[], None]) -> bool:
        """Act; after a fault of a link once more, from Reset and a new scene on."""
        for _ in range(DAY_ATTEMPTS):
            try:
                act()
                if not self.session.interlock.latched:
                    return True
            except (FaultError, RefusedError, StaleSampleError):
                pass
            self.again += 1
            self.session.reset()
            try:
                self.session.prepare(SceneChoice("pot", ("circle15",), 3))
            except FaultError:
                continue
        return False


@figure("wired")
def operators_day_over_wires() -> list[Figure]:
    """Operator's day over the wires: count parts that failed."""
    with (
        tempfile.TemporaryDirectory() as name,
        Dataset.open(Path(name) / "ds", person=PERSON) as dataset,
        EmulatedBench(SimulatedBenchChoice(), keep=RecordingOptions(Path(name) / "runs")) as bench,
    ):
        day = Day(Path(name), bench, dataset)
        missed = [part.__name__ for part in day.parts() if not part()]
    note = f"{', '.join(missed)}; " if missed else ""
    note += f"{day.again} times a link fault ended something, which was begun again"
    told = "operator's day over the wires: parts that did not hold"
    return [Figure(told, len(missed), "of 8", "0", not missed, note)]


def pulled(device: str) -> FaultPlan:
    fault = {"at_s": PULLED_AT_S, "for_s": PULLED_S, "device": device, "kind": "unplug"}
    return FaultPlan.model_validate({"fault": [fault]})


@figure("wired")
def plugs_pulled_while_collecting() -> list[Figure]:
    """Plugs pulled and reinserted during a campaign with Reset: count lost probes."""
    plans = [pulled(device) for device in PULLED]
    with (
        tempfile.TemporaryDirectory() as name,
        Dataset.open(Path(name) / "ds", person=PERSON) as dataset,
        EmulatedBench(
            SimulatedBenchChoice(), keep=RecordingOptions(Path(name) / "runs"), plan=plans.pop(0)
        ) as bench,
    ):

        def next_plug(fact: Event) -> None:
            if isinstance(fact, FaultsReset):
                bench.plan = plans.pop(0) if plans else FaultPlan()

        bench.session.events.subscribe(next_plug)
        day = Day(Path(name), bench, dataset)
        held = day.collect()
        told = {fact.uuid for fact in day.facts if isinstance(fact, ProbeCollected)}
        kept = {entry.uuid for entry in dataset.episodes()}
        whole = sum(
            dataset.read(uuid).observation.shape == (SAMPLES_PER_PROBE, CHANNELS) for uuid in kept
        )
    struck = sorted({f.fault.code for f in day.facts if isinstance(f, FaultRaised | Paused)})
    lost = len(told - kept) + len(kept) - whole + max(0, PROBES - len(kept))
    note = f"{len(kept)} probes kept; {day.again} times gone on after {', '.join(struck) or 'none'}"
    ok = held and lost == 0 and day.again >= len(PULLED)
    return [Figure("collecting while plugs are pulled: probes lost", lost, "", "0", ok, note)]
