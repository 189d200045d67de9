"""Fault campaign over all devices by stepped clock, and probes that lose or turn their piece."""

from __future__ import annotations

import math
import random
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from tests.backend.devices.melfa.trials import trial as trials_trial
from tests.backend.devices.optoforce.trials_wrist import trial as trials_wrist_trial
from tests.backend.devices.trials import Ended
from tests.backend.devices.trials_camera import trial as trials_camera_trial
from tests.backend.devices.wsg.trials_gripper import trial as trials_gripper_trial
from tests.backend.runs.test_campaign import Failing
from tests.bench.registry import Figure, figure
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.values import EpisodeFilter
from touchdown.backend.core.events import (
    Event,
    FaultRaised,
    PhaseEntered,
    ProbeCollected,
    RunFinished,
)
from touchdown.backend.core.faults import TouchdownError
from touchdown.backend.emulation.disturbances import (
    DISTURBANCE_KINDS,
    Disturbance,
    DisturbanceScript,
)
from touchdown.backend.runs.campaign import newest_campaign
from touchdown.backend.simulation.world import World

CAMPAIGN_PROBES, TRIES = 2, 4
SLOW_HZ = {"force_torque": 300.0, "tactile_left": 10.0, "tactile_right": 10.0}
FAULTS = tuple((device, kind) for device, kinds in DISTURBANCE_KINDS.items() for kind in kinds)


class _AnyTime(Failing):
    """As ``Failing``, at any instant of any phase, and for a while."""

    def break_at(self, phase: int, after_s: float, device: str, kind: str, for_s: float) -> None:
        self._when = (phase, after_s, Disturbance(device, kind, 0.0, for_s))

    def _take(self, fact) -> None:
        self.facts.append(fact)
        phases = sum(isinstance(f, PhaseEntered) for f in self.facts)
        if self._when is not None and phases == self._when[0]:
            _, after_s, what = self._when
            begins_s = fact.t_s + after_s
            rate_hz = SLOW_HZ[what.device] if what.kind == "slow" else None
            fault = Disturbance(what.device, what.kind, begins_s, what.length_s, rate_hz)
            script = DisturbanceScript((fault,))
            bench = self.session._stage.advance.__self__
            for part in (bench, bench._world, *bench.tactile.values()):
                part._script = script
            self._when = None

    _when: tuple[int, float, Disturbance] | None = None


def campaign_trial(seed: int) -> Ended:
    """Collect two probes with one fault, go on after Reset until they are there, and look."""
    rng = random.Random(seed)
    device, kind = rng.choice(FAULTS)
    with (
        tempfile.TemporaryDirectory() as folder,
        Dataset.open(Path(folder) / "ds", person="ann") as dataset,
    ):
        failing = _AnyTime(dataset)
        try:
            when = (rng.randint(2, 12), rng.uniform(0.0, 0.5))
            failing.break_at(*when, device, kind, rng.uniform(0.2, 3.0))
            broken = _run(failing, dataset)
        finally:
            failing.session.close()
    return Ended(seed, "collecting", f"{device} {kind}", tuple(broken))


def _run(failing: _AnyTime, dataset: Dataset) -> list[str]:
    asked: dict[str, object] = {"count": CAMPAIGN_PROBES}
    endings, latched = [], True
    for _ in range(TRIES):
        # What ends a run early is announced and raised as well.
        with suppress(TouchdownError):
            failing.run(**asked)
        endings.append([f for f in failing.facts if isinstance(f, RunFinished)][-1].ending)
        if endings[-1] == "finished":
            break
        latched = latched and len(failing.session.interlock.faults) > 0
        for _ in range(40):  # until the fault is over
            failing.session._stage.advance(100_000)
        failing.session.reset()
        found = newest_campaign(dataset.folder)
        asked = {"campaign": found} if found is not None else {"count": CAMPAIGN_PROBES}
    told = [fact.uuid for fact in failing.facts if isinstance(fact, ProbeCollected)]
    # One that was stored when the run ended is there without a word: it was never acknowledged.
    entries = dataset.episodes()
    whole = {entry.uuid for entry in entries}
    # A probe that its quality refuses is kept beside the one that was taken in its place.
    items = sorted(entry.plan_item for entry in entries if entry.quality.accepted)
    broken = [uuid for uuid in whole if not _is_whole(dataset, uuid)]
    rows = {
        f"ended {endings}": endings[-1] == "finished" and set(endings) <= {"finished", "failed"},
        "a run failed without a latched fault": latched,
        "an acknowledged episode is lost": set(told) <= whole,
        "an episode cannot be read": not broken,
        "an item is missing or there twice": items == list(range(CAMPAIGN_PROBES)),
    }
    return [name for name, holds in rows.items() if not holds]


def _is_whole(dataset: Dataset, uuid: str) -> bool:
    episode = dataset.read(uuid)
    accepted = episode.quality.accepted
    return not accepted or bool(np.isfinite(episode.observation).all())


TRIALS: Sequence[tuple[str, Callable[[int], object], int]] = (
    ("arm", trials_trial, 120),
    ("gripper, both protocols", trials_gripper_trial, 150),
    ("wrist sensors, seven makes", trials_wrist_trial, 180),
    ("tactile cameras", trials_camera_trial, 120),
    ("devices while collecting", campaign_trial, 30),
)
LEAST = 500
FIRST = 10_000  # seeds other than those of the tests and of the group ``arm``


@figure("faults")
def faults_of_every_device() -> list[Figure]:
    """Random faults at random instants: count those not ended as documented."""
    rows, total, missed = [], 0, 0
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        for device, trial, count in TRIALS:
            ended = list(pool.map(trial, range(FIRST, FIRST + count), chunksize=5))
            broken = [one for one in ended if one.broken]
            kinds = len({one.fault for one in ended})
            told = f"{count} faults of {kinds} kinds" + (f"; {broken[0]}" if broken else "")
            name = f"faults not ended as documented: {device}"
            rows.append(Figure(name, len(broken), "", "0", not broken, told))
            total, missed = total + count, missed + len(broken)
    note = "no unsafe command in the emulators' logs, no acknowledged episode lost"
    good = total >= LEAST and missed == 0
    rows.append(Figure("injected faults in all", total, "", f">= {LEAST}", good, note))
    return rows


GRIP_TRIALS, SEEN_S = 200, 0.2
PHASES = ("approach", "press", "hold")
# Range of the angles; instants during contact, early enough for detection.
TURNS_DEG, FELT_S, LAST_S = (1.5, 10.0), 0.3, 1.7


class _Struck(Failing):
    """As ``Failing``; something happens to the piece some time after a phase of the first probe
    began."""

    struck_s = _due_s = float("inf")

    def strike(self, phase: str, after_s: float, blow: Callable[[World], None]) -> None:
        self._phase, self._after_s = phase, after_s
        step = self.session.advance

        def advance() -> None:
            step()
            if self.struck_s == float("inf") and self.session.clock_s() >= self._due_s:
                scene = self.session._scene
                assert scene is not None
                blow(scene.gripper._world)
                self.struck_s = self.session.clock_s()

        self.session.advance = advance

    def _take(self, fact: Event) -> None:
        super()._take(fact)
        if isinstance(fact, PhaseEntered) and fact.phase == self._phase:
            self._due_s = min(self._due_s, fact.t_s + self._after_s)

    _phase, _after_s = "", 0.0


def _lose(world: World) -> None:
    world.jaws.piece_present = world.jaws.holding = False


def lost(seed: int) -> Ended:
    """Collect one probe, in which the piece is lost; return what does not hold."""
    rng = random.Random(seed)
    phase, after_s = rng.choice(PHASES), rng.uniform(0.0, 0.5)
    return _collected(seed, phase, after_s, _lose, "PIECE-LOST", "lost")


def turned(seed: int) -> Ended:
    """Collect one probe, in which the piece turns; return what does not hold."""
    rng = random.Random(seed)
    after_s, angle_deg = rng.uniform(FELT_S, LAST_S), rng.choice((-1, 1)) * rng.uniform(*TURNS_DEG)

    def turn(world: World) -> None:
        assert world.holding is not None
        world.holding.turn(math.radians(angle_deg))

    told = f"turned by {angle_deg:.1f} degrees"
    return _collected(seed, "press", after_s, turn, "PIECE-TURNED", told)


def _collected(
    seed: int, phase: str, after_s: float, blow: Callable[[World], None], code: str, what: str
) -> Ended:
    with (
        tempfile.TemporaryDirectory() as folder,
        Dataset.open(Path(folder) / "ds", person="ann") as dataset,
    ):
        struck = _Struck(dataset)
        struck.strike(phase, after_s, blow)
        try:
            with suppress(TouchdownError):
                struck.run(count=1)
            kept = dataset.episodes(EpisodeFilter(deleted=None))
        finally:
            struck.session.close()
    phases = [f for f in struck.facts if isinstance(f, PhaseEntered)]
    # What is lost after the probe has ended was held while it lasted: that label is right.
    lifted_s = next((f.t_s for f in phases if f.phase == "lift"), float("inf"))
    told = [f for f in struck.facts if isinstance(f, FaultRaised) and f.fault.code == code]
    rows = {
        "never struck": struck.struck_s < float("inf"),
        "a label": struck.struck_s >= lifted_s or not any(e.quality.accepted for e in kept),
        "not told": len(told) == 1,
        "told late": bool(told) and told[0].t_s - struck.struck_s <= SEEN_S,
    }
    broken = tuple(name for name, holds in rows.items() if not holds)
    return Ended(seed, "collecting", f"{what} {after_s:.2f} s into {phase}", broken)


def _of(trial: Callable[[int], Ended], count: int) -> Sequence[Ended]:
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        return list(pool.map(trial, range(count), chunksize=5))


@figure("faults")
def pieces_lost_in_probes(count: int = GRIP_TRIALS) -> list[Figure]:
    """The gripper loses its piece at a random instant of a probe: labels that come of it."""
    broken = [one for one in _of(lost, count) if one.broken]
    name = f"probes of {count} with a lost piece that gave a label, or told late"
    return [Figure(name, len(broken), "", "0", not broken, str(broken[0]) if broken else "")]


@figure("faults")
def pieces_turned_in_probes(count: int = GRIP_TRIALS) -> list[Figure]:
    """The piece turns in the grasp at a random instant of a press: labels that come of it."""
    broken = [one for one in _of(turned, count) if one.broken]
    name = f"probes of {count} with a piece that turned and gave a label, or told late"
    return [Figure(name, len(broken), "", "0", not broken, str(broken[0]) if broken else "")]
