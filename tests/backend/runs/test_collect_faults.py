"""Sensor failure during a campaign: one fault, no lost data, continues after a reset."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.backend.brisk import brisk_bench, brisk_method
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.values import EpisodeFilter
from touchdown.backend.bench.assembly import simulated_session
from touchdown.backend.core.events import (
    Event,
    FaultRaised,
    PhaseEntered,
    ProbeCollected,
    RunFinished,
)
from touchdown.backend.emulation.disturbances import Disturbance, DisturbanceScript
from touchdown.backend.runs.campaign import newest_campaign
from touchdown.backend.runs.recorder import RecordingOptions
from touchdown.backend.runs.requests import CollectRequest


class Failing:
    """Collecting session with a device that fails during a press."""

    def __init__(self, dataset: Dataset) -> None:
        self.facts: list[Event] = []
        self.dataset = dataset
        self.session = simulated_session(
            brisk_bench("quiet"), keep=RecordingOptions(None), method=brisk_method()
        )
        self.session.dataset = dataset
        self.session.events.subscribe(self._take)
        self._fails: tuple[int, str, str, float | None] | None = None
        self.fails_s = float("inf")

    def run(self, **asked) -> None:
        # One mounting, so that the device that is made to fail is the one in use.
        asked = {"grips_per_mounting": 10, **asked}
        self.session.run(CollectRequest(seed=2, person="ann", **asked))

    def fail_in_press(self, number: int, device: str, kind: str, much: float | None = None) -> None:
        self._fails = (number, device, kind, much)

    def _take(self, fact: Event) -> None:
        self.facts.append(fact)
        pressed = [f for f in self.facts if isinstance(f, PhaseEntered) and f.phase == "press"]
        if self._fails is not None and len(pressed) == self._fails[0]:
            _, device, kind, much = self._fails
            self.fails_s = fact.t_s + 0.3
            script = DisturbanceScript((Disturbance(device, kind, self.fails_s, much=much),))
            bench = self.session._stage.advance.__self__
            for part in (bench, bench._world, *bench.tactile.values()):
                part._script = script
            self._fails = None

    def one_fault(self, code: str, device: str) -> None:
        """Check that only this fault was published and latched, and that it failed the run."""
        raised = [f.fault for f in self.facts if isinstance(f, FaultRaised)]
        assert [(f.code, f.device) for f in raised] == [(code, device)]
        assert self.session.interlock.faults == tuple(raised)
        assert isinstance(self.facts[-1], RunFinished)
        assert self.facts[-1].ending == "failed"

    def only_what_was_told(self, count: int) -> None:
        """Check that the dataset holds only published probes, none incomplete or with NaN."""
        told = [f.uuid for f in self.facts if isinstance(f, ProbeCollected)]
        assert [e.uuid for e in self.dataset.episodes(EpisodeFilter(deleted=None))] == told
        assert len(told) == count


@pytest.fixture
def failing(tmp_path: Path) -> Iterator[Failing]:
    with Dataset.open(tmp_path / "ds", person="ann") as dataset:
        made = Failing(dataset)
        yield made
        made.session.close()


@pytest.mark.slow
def test_after_an_unplugged_camera_the_campaign_goes_on_where_it_was(failing: Failing) -> None:
    failing.fail_in_press(2, "tactile_left", "stop")
    failing.run(count=2)
    failing.one_fault("CAMERA-STALE", "tactile_left")
    failing.only_what_was_told(1)
    failing.session.reset()
    failing.run(campaign=newest_campaign(failing.dataset.folder))
    assert failing.facts[-1].ending == "finished"
    entries = failing.dataset.episodes()
    assert [entry.plan_item for entry in entries] == [0, 1]
    assert all(entry.quality.accepted and entry.file_state == "complete" for entry in entries)


@pytest.mark.parametrize(
    ("device", "kind", "code"),
    [("tactile_right", "freeze", "CAMERA-FROZEN"), ("force_torque", "nan", "FT-STALE")],
)
def test_a_failing_sensor_within_a_press_is_no_probe_and_the_campaign_goes_on(
    device: str, kind: str, code: str, failing: Failing
) -> None:
    failing.fail_in_press(1, device, kind)
    failing.run(count=1)
    failing.one_fault(code, device)
    failing.only_what_was_told(0)
    failing.session.reset()
    failing.run(campaign=newest_campaign(failing.dataset.folder))
    assert failing.facts[-1].ending == "finished"
    failing.only_what_was_told(1)
    (entry,) = failing.dataset.episodes()
    assert (entry.plan_item, entry.quality.accepted) == (0, True)
    assert np.isfinite(failing.dataset.film(entry.uuid).episode.observation).all()


@pytest.mark.promise("G1")
@pytest.mark.parametrize("phase", ["approach", "hold"])
def test_a_piece_that_is_lost_within_a_probe_is_no_probe(phase: str, failing: Failing) -> None:
    lost_s: list[float] = []

    def lose(fact: Event) -> None:
        if isinstance(fact, PhaseEntered) and fact.phase == phase and not lost_s:
            jaws = failing.session._stage.gripper._world.jaws
            jaws.piece_present = jaws.holding = False
            lost_s.append(fact.t_s)

    failing.session.events.subscribe(lose)
    failing.run(count=1)
    failing.one_fault("PIECE-LOST", "gripper")
    failing.only_what_was_told(0)
    (told,) = [fact for fact in failing.facts if isinstance(fact, FaultRaised)]
    assert told.t_s - lost_s[0] <= 0.2


@pytest.mark.promise("G1")
def test_a_piece_that_turns_in_the_grasp_is_no_probe(failing: Failing) -> None:
    failing.fail_in_press(1, "gripper", "turn", 3.0)
    failing.run(count=1)
    failing.one_fault("PIECE-TURNED", "gripper")
    failing.only_what_was_told(0)
    (told,) = [fact for fact in failing.facts if isinstance(fact, FaultRaised)]
    assert 0.0 < told.t_s - failing.fails_s <= 0.2
