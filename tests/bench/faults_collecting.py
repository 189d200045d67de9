"""A campaign of probes during which a device fails: what was acknowledged must be there, whole."""

from __future__ import annotations

import random
import tempfile
from contextlib import suppress
from pathlib import Path

import numpy as np

from tests.backend.devices.trials import Ended
from tests.backend.runs.test_collect_faults import Failing
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.core.events import PhaseEntered, ProbeCollected, RunFinished
from touchdown.backend.core.faults import TouchdownError
from touchdown.backend.emulation.disturbances import (
    DISTURBANCE_KINDS,
    Disturbance,
    DisturbanceScript,
)
from touchdown.backend.runs.campaign import newest_campaign

COUNT, TRIES = 2, 4
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


def trial(seed: int) -> Ended:
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
    asked: dict[str, object] = {"count": COUNT}
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
        asked = {"campaign": found} if found is not None else {"count": COUNT}
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
        "an item is missing or there twice": items == list(range(COUNT)),
    }
    return [name for name, holds in rows.items() if not holds]


def _is_whole(dataset: Dataset, uuid: str) -> bool:
    episode = dataset.read(uuid)
    accepted = episode.quality.accepted
    return not accepted or bool(np.isfinite(episode.observation).all())
