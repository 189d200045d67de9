"""The operator's day over the emulated bench: drivers, sockets, terminals and pipes, in real time.

Jog, probe, collect, label, train, stack, review, each through the functions behind the window. On
a busy computer the wires lose time: what a link fault ended is begun again after Reset, as the
operator would, and counted.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from tests.bench.registry import Figure, figure
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.bench.assembly import SimulatedBenchChoice
from touchdown.backend.bench.emulated import EmulatedBench
from touchdown.backend.config.method import SAMPLES_PER_PROBE
from touchdown.backend.core.events import (
    Event,
    FaultRaised,
    FaultsReset,
    Paused,
    ProbeCollected,
    RunFinished,
    TrialFinished,
)
from touchdown.backend.core.faults import FaultError, RefusedError, StaleSampleError
from touchdown.backend.core.values import CHANNELS
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

PROBES, TRIES = 4, 8
SETTLE_S = 1.5
"""The sensors begin to deliver."""
JOG_MM_S, JOG_S, LEAST_MM = 10.0, 1.0, 1.0
"""Asked; near the surface, where the day begins, a jog goes at the speed of contact."""
PERSON = "bench"
PULLED, PULLED_AT_S, PULLED_S = ("force_torque", "tactile_left", "arm"), 14.0, 3.0
"""One plug after the other is out for a moment, amid the probes of the scene that is then set."""
TINY = ("--labels", "submitted", "--divide-series", "--epochs", "1")


class Day:
    """One day in ``folder``; each part returns whether it held."""

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
            [sys.executable, "-m", "backend", *map(str, words)], capture_output=True, check=False
        )
        return done.returncode == 0 and out.is_file() and bool(list_training_runs(data))

    def stack(self) -> bool:
        return self.run(StackRequest("pot", ("short",), 301))

    def review(self) -> bool:
        """What the newest run wrote is read again as it was told."""
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
        for _ in range(TRIES):
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
    """Which parts of the day did not hold, and what had to be begun again."""
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
    """Plugs are pulled and put back amid a campaign, which goes on after Reset: what is missing."""
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
