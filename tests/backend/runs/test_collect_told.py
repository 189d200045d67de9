"""Every probe that is in the dataset was announced, whatever ended its run and wherever."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from backend.assembly import simulated_session
from backend.catalogue.dataset import Dataset
from backend.core.facts import EpisodeRecorded, ProbeCollected, RunFinished
from backend.runs import collecting
from backend.runs.collected import Measured
from backend.runs.collecting import Collector
from backend.runs.judged import Felt
from backend.runs.requests import CollectRequest
from backend.session import Keep
from tests.app.label.conftest import make_episode
from tests.backend.brisk import brisk_bench, brisk_method


@pytest.fixture
def collect(tmp_path, monkeypatch):
    """Return what runs a campaign of one probe, which is taken at once and then goes wrong."""

    def run(goes_wrong, when_told=None):
        def mounting(self, bench, target, origin, context, after=0):
            felt = Felt(make_episode(7, frames=1), 1, bench.now_s(), 0.0)
            where = Measured(np.array([1.0, -2.0]), 0.1, 20.0)
            context = replace(context, grip_id=f"{context.mounting_id}/grip-1", plan_item=0)
            self._enter(collecting._Taken(felt, 0, where, 0.0), context)
            yield from goes_wrong(self, bench)

        monkeypatch.setattr(Collector, "mounting", mounting)
        session = simulated_session(brisk_bench("quiet"), keep=Keep(None), method=brisk_method())
        facts, error = [], None

        def take(fact):
            facts.append(fact)
            if when_told is not None and isinstance(fact, EpisodeRecorded):
                when_told(session)

        with Dataset.open(tmp_path / "ds", person="ann") as dataset:
            session.dataset = dataset
            session.hub.subscribe(take)
            try:
                session.run(CollectRequest(count=1, person="ann"))
            except ValueError as raised:
                error = raised
            session.close()
            return facts, [entry.uuid for entry in dataset.episodes()], error

    return run


def test_a_probe_is_announced_though_its_run_failed_of_an_error_of_its_own(collect):
    def wrong(collector, bench):
        yield from ()
        raise ValueError("no such place")

    facts, stored, error = collect(wrong)
    assert [fact.uuid for fact in facts if isinstance(fact, ProbeCollected)] == stored
    assert len(stored) == 1
    assert str(error) == "no such place"
    assert isinstance(facts[-1], RunFinished)
    assert facts[-1].ending == "failed"


def test_a_probe_is_announced_in_full_though_the_run_is_cancelled_while_it_is(collect):
    facts, stored, _ = collect(
        lambda collector, bench: collector._settled(bench), lambda session: session.engine.cancel()
    )
    told = [type(f) for f in facts if isinstance(f, EpisodeRecorded | ProbeCollected)]
    assert told == [EpisodeRecorded, ProbeCollected]
    assert [f.uuid for f in facts if isinstance(f, ProbeCollected)] == stored
    assert facts[-1].ending == "cancelled"
