"""Every probe in the dataset is published, however its run ended; a full disk loses no decision."""

from __future__ import annotations

import errno
from dataclasses import replace

import numpy as np
import pytest

from tests.app.label.conftest import make_episode
from tests.backend.brisk import brisk_bench, brisk_method
from touchdown.app.collect.requests import apply_decision
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.labels import LabelStore
from touchdown.backend.annotations.values import EpisodeFilter
from touchdown.backend.bench.assembly import simulated_session
from touchdown.backend.core.events import (
    EpisodeDecided,
    EpisodeRecorded,
    FaultRaised,
    Paused,
    ProbeCollected,
    RunFinished,
)
from touchdown.backend.core.faults import Fault, FaultError
from touchdown.backend.runs import campaign as campaigns
from touchdown.backend.runs import collector as collecting
from touchdown.backend.runs.bench import PressedProbe
from touchdown.backend.runs.campaign import current_campaign, newest_campaign, read_campaign
from touchdown.backend.runs.collector import Collector, MeasuredOffset
from touchdown.backend.runs.plan import CancelledError
from touchdown.backend.runs.recorder import RecordingOptions
from touchdown.backend.runs.requests import CollectRequest


@pytest.fixture
def collect(tmp_path, monkeypatch):
    """Return what runs a campaign of one probe, which is taken at once and then goes wrong."""

    def run(goes_on, when_told=None, kind=EpisodeRecorded):
        def mounting(self, bench, target, origin, context, after=0):
            felt = PressedProbe(make_episode(7, frames=1), 1, bench.now_s(), 0.0)
            where = MeasuredOffset(np.array([1.0, -2.0]), 0.1, 20.0)
            context = replace(context, grip_id=f"{context.mounting_id}/grip-1", plan_item=0)
            self._record(collecting._PendingEpisode(felt, 0, where, 0.0), context)
            yield from goes_on(self, bench)
            return True

        monkeypatch.setattr(Collector, "mounting", mounting)
        session = simulated_session(
            brisk_bench("quiet"), keep=RecordingOptions(None), method=brisk_method()
        )
        facts, error = [], None

        def take(fact):
            facts.append(fact)
            if when_told is not None and isinstance(fact, kind):
                when_told(session)

        with Dataset.open(tmp_path / "ds", person="ann") as dataset:
            session.dataset = dataset
            session.events.subscribe(take)
            try:
                session.run(CollectRequest(count=1, person="ann"))
            except ValueError as raised:
                error = raised
            session.close()
            kept = [e.uuid for e in dataset.episodes(EpisodeFilter(deleted=None))]
            return facts, kept, error

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


def skip_the_probe(collector, bench):
    yield from collector._settled(bench)
    collector._decisions.give("skip")
    yield from collector._carry_out(bench)


def test_a_decision_waits_for_room_and_is_carried_out_then(collect, tmp_path, monkeypatch):
    delete, refused = LabelStore.delete, []

    def full(self, *args):
        if len(refused) < 2:
            refused.append(args)
            raise FaultError(Fault("DISK-FULL", "The disk is full.", "Not saved.", "Room."))
        delete(self, *args)

    monkeypatch.setattr(LabelStore, "delete", full)
    facts, _, _ = collect(skip_the_probe, lambda session: session.engine.resume(), Paused)
    assert [fact.fault.code for fact in facts if isinstance(fact, Paused)] == ["DISK-FULL"] * 2
    assert [fact.decision for fact in facts if isinstance(fact, EpisodeDecided)] == ["skip"]
    assert facts[-1].ending == "finished"
    folder = tmp_path / "ds"
    assert read_campaign(folder, newest_campaign(folder)).skipped == (0,)
    with Dataset.open(folder, write=False) as dataset:
        assert dataset.episodes() == []


@pytest.mark.parametrize("nth", [1, 2])
@pytest.mark.parametrize("room_made", [True, False])
def test_the_plan_waits_for_room_before_and_after_a_mounting(
    collect, tmp_path, monkeypatch, nth, room_made
):
    """Once for the new mounting, once for the skipped item."""
    write, calls = campaigns.write_atomically, []

    def full(path, content):
        calls.append(path)
        if len(calls) == nth:
            raise OSError(errno.ENOSPC, "No space left on device")
        write(path, content)

    monkeypatch.setattr(campaigns, "write_atomically", full)
    act = (lambda s: s.engine.resume()) if room_made else (lambda s: s.engine.cancel())
    facts, stored, error = collect(skip_the_probe, act, Paused)
    assert error is None
    assert len([fact for fact in facts if isinstance(fact, Paused)]) == 1
    assert facts[-1].ending == ("finished" if room_made else "cancelled")
    assert len(stored) == (0 if nth == 1 and not room_made else 1)
    folder = tmp_path / "ds"
    if room_made:
        kept = read_campaign(folder, newest_campaign(folder))
        assert (kept.mountings, kept.skipped) == (1, (0,))
    elif nth == 2:
        assert skipped_items(folder) == (0,)


def skipped_items(folder):
    """Return the items that a continued campaign skips."""
    with Dataset.open(folder) as dataset:
        plan = current_campaign(dataset, newest_campaign(folder))
        assert plan.todo(dataset.episodes()) == []
        return plan.skipped


def test_what_was_decided_just_before_a_cancel_is_carried_out(collect, tmp_path):
    def cancelled(collector, bench):
        yield from collector._settled(bench)
        collector._decisions.give("skip")
        raise CancelledError("by the operator")

    facts, _, _ = collect(cancelled)
    assert [fact.decision for fact in facts if isinstance(fact, EpisodeDecided)] == ["skip"]
    assert facts[-1].ending == "cancelled"
    assert skipped_items(tmp_path / "ds") == (0,)


@pytest.mark.parametrize("refusals", [1, 2])
def test_a_cancel_while_a_skip_waits_for_room_does_not_lose_it(
    collect, tmp_path, monkeypatch, refusals
):
    """With space at the end, or without: then the fault names the next step."""
    delete, refused = LabelStore.delete, []

    def full(self, *args):
        if len(refused) < refusals:
            refused.append(args)
            raise FaultError(Fault("DISK-FULL", "The disk is full.", "Not saved.", "Room."))
        delete(self, *args)

    monkeypatch.setattr(LabelStore, "delete", full)
    facts, (uuid,), _ = collect(skip_the_probe, lambda session: session.engine.cancel(), Paused)
    assert facts[-1].ending == "cancelled"
    decided = [fact.decision for fact in facts if isinstance(fact, EpisodeDecided)]
    cards = [fact.fault for fact in facts if isinstance(fact, FaultRaised)]
    if refusals == 1:
        assert (decided, cards) == (["skip"], [])
    else:
        assert decided == []
        assert [card.code for card in cards] == ["DISK-FULL"]
        assert "'skip' for item 1" in cards[0].what
        with Dataset.open(tmp_path / "ds", person="ann") as dataset:
            held = apply_decision(dataset, "ann", uuid, "skip")
            assert held.entry.deleted
    assert skipped_items(tmp_path / "ds") == (0,)


def test_a_skipped_probe_that_is_brought_back_is_done(collect, tmp_path):
    _, (uuid,), _ = collect(skip_the_probe)
    with Dataset.open(tmp_path / "ds", person="ann") as dataset:
        dataset.labels.restore("ann", uuid)
        plan = current_campaign(dataset, newest_campaign(tmp_path / "ds"))
        assert plan.todo(dataset.episodes()) == []
