"""Sensor failure during a campaign: one fault, no lost data, continues after a reset."""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import kstest

from tests.app.label.conftest import make_episode
from tests.backend.annotations.conftest import context_for, small_episode
from tests.backend.bench.brisk import brisk_session, on
from touchdown.app.collect.requests import apply_decision
from touchdown.backend import core
from touchdown.backend.annotations import Dataset, EpisodeFilter, Label
from touchdown.backend.annotations.labels import LabelStore
from touchdown.backend.config.method import StackSettings
from touchdown.backend.core.events import (
    EpisodeDecided,
    EpisodeRecorded,
    Event,
    FaultRaised,
    HandOverAwaited,
    MountingAwaited,
    Paused,
    PhaseEntered,
    ProbeCollected,
)
from touchdown.backend.core.faults import Fault, FaultError, InputError
from touchdown.backend.emulation.simulated_disturbances import Disturbance, DisturbanceScript
from touchdown.backend.episodes.quality import count_coverage
from touchdown.backend.geometry import circle, load_pieces, overlap_area_mm2, rectangle
from touchdown.backend.runs import collector as collecting
from touchdown.backend.runs.bench import PressedProbe
from touchdown.backend.runs.campaign import (
    PATTERNS,
    ProbeTarget,
    current_campaign,
    grid_displacements_mm,
    new_campaign,
    newest_campaign,
    pair_coverage,
    planned_displacement_mm,
    read_campaign,
)
from touchdown.backend.runs.collector import Collector, MeasuredOffset
from touchdown.backend.runs.plan import CancelledError
from touchdown.backend.runs.requests import GRIPS, MOUNTINGS, CollectRequest


class Failing:
    """Collecting session with a device that fails during a press."""

    def __init__(self, dataset: Dataset) -> None:
        self.facts: list[Event] = []
        self.dataset = dataset
        self.session = brisk_session()
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
        assert self.facts[-1].ending == "failed"

    def told_s(self) -> float:
        (told,) = [fact.t_s for fact in self.facts if isinstance(fact, FaultRaised)]
        return told

    def only_what_was_told(self, count: int) -> None:
        """Check that the dataset holds only published probes, none incomplete or with NaN."""
        told = [f.uuid for f in self.facts if isinstance(f, ProbeCollected)]
        assert [e.uuid for e in self.dataset.episodes(EpisodeFilter(deleted=None))] == told
        assert len(told) == count


@pytest.fixture
def failing(stored):
    made = Failing(stored)
    yield made
    made.session.close()


@pytest.mark.slow
def test_after_an_unplugged_camera_the_campaign_goes_on_where_it_was(failing):
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
    device, kind, code, failing
):
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
@pytest.mark.parametrize("phase", ["approach", "press", "hold"])
def test_a_piece_that_is_lost_within_a_probe_is_no_probe(phase, failing):
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
    assert failing.told_s() - lost_s[0] <= 0.2


@pytest.mark.promise("G1")
def test_a_piece_that_turns_in_the_grasp_is_no_probe(failing):
    failing.fail_in_press(1, "gripper", "turn", 3.0)
    failing.run(count=1)
    failing.one_fault("PIECE-TURNED", "gripper")
    failing.only_what_was_told(0)
    assert 0.0 < failing.told_s() - failing.fails_s <= 0.2


TARGET = ProbeTarget(circle(15.0), rectangle(12.0, 28.0))
EMPTY = count_coverage(np.empty((0, 2)), TARGET.face, TARGET.bottom)


@pytest.fixture
def stored(tmp_path):
    with Dataset.open(tmp_path / "data", person="cleo") as opened:
        yield opened


def places(pattern, count, target=TARGET, seed=3):
    return np.array(
        [planned_displacement_mm(pattern, target, seed, k, count, EMPTY) for k in range(count)]
    )


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("within", [None, 6.0], ids=str)
def test_every_pattern_stays_where_the_faces_overlap(pattern, within):
    target = ProbeTarget(TARGET.face, TARGET.bottom, within)
    found = places(pattern, 40, target)
    assert (overlap_area_mm2(target.face, found, target.bottom) >= 6.0).all()
    assert np.abs(found).max() <= (within or 99.0)
    np.testing.assert_array_equal(found, places(pattern, 40, target))


def test_random_places_are_uniform():
    found = places("random", 400, ProbeTarget(circle(15.0), circle(15.0), 5.0), seed=0)
    for axis in range(2):
        assert kstest(found[:, axis], "uniform", args=(-5.0, 10.0)).pvalue > 0.01
    assert not np.allclose(
        found, places("random", 400, ProbeTarget(*[circle(15.0)] * 2, 5.0), seed=4)
    )


@pytest.mark.parametrize("count", [1, 7, 50, 200])
def test_a_grid_has_the_wanted_number_of_even_places(count):
    found = grid_displacements_mm(TARGET, count)
    assert len(np.unique(found, axis=0)) == count
    if count >= 50:
        apart = np.hypot(*(found[:, None] - found).transpose(2, 0, 1))
        nearest = np.where(apart > 0, apart, np.inf).min(axis=1)
        assert nearest.max() <= 1.5 * nearest.min()


def test_adaptive_places_leave_no_hole_before_they_repeat():
    seen, holes = EMPTY, EMPTY.holes
    for k in range(holes):
        seen = seen.with_offset(planned_displacement_mm("adaptive", TARGET, 5, k, holes, seen))
    assert seen.counts[seen.possible].max() <= 2
    assert seen.covered > 0.97


def test_a_range_that_holds_no_grid_is_refused():
    with pytest.raises(InputError, match="Not enough displacements"):
        grid_displacements_mm(ProbeTarget(circle(15.0), circle(15.0), 0.1), 400)


def test_a_campaign_survives_a_restart(tmp_path):
    campaign = replace(new_campaign("pot", "short", "grid", 7, 12, 5.0), mountings=1).without(4)
    campaign.save(tmp_path)
    assert read_campaign(tmp_path, campaign.uuid) == campaign
    assert newest_campaign(tmp_path) == campaign.uuid
    later = new_campaign("pot", "short", "grid", 8, 12, None)
    later.save(tmp_path)
    assert newest_campaign(tmp_path) == later.uuid
    assert campaign.todo([]) == [k for k in range(12) if k != 4]


@pytest.mark.parametrize(
    "text", ["", "{", "[]", '{"format": 2}', '{"format": 1, "pattern": "spiral", "skipped": []}']
)
def test_a_damaged_campaign_is_named(tmp_path, text):
    path = tmp_path / "campaigns" / "c.json"
    path.parent.mkdir()
    path.write_text(text)
    with pytest.raises(InputError, match=r"c\.json"):
        read_campaign(tmp_path, "c")


@pytest.mark.parametrize("key", ["seed", "count", "within_mm", "skipped", "mountings"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e300, -1e300, True, "1"])
def test_a_campaign_with_a_senseless_number_is_named(tmp_path, key, value):
    campaign = new_campaign("pot", "short", "grid", 7, 12, 5.0).without(4)
    campaign.save(tmp_path)
    path = tmp_path / "campaigns" / f"{campaign.uuid}.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content | {key: [value] if key == "skipped" else value}))
    with pytest.raises(InputError, match=rf"'{key}.*{campaign.uuid}"):
        read_campaign(tmp_path, campaign.uuid)


@pytest.mark.parametrize(
    ("key", "value"), [("format", True), ("skipped", {}), ("skipped", [2**70])]
)
def test_a_campaign_with_a_value_of_another_type_is_named(tmp_path, key, value):
    campaign = new_campaign("pot", "short", "grid", 7, 12, 5.0)
    campaign.save(tmp_path)
    path = tmp_path / "campaigns" / f"{campaign.uuid}.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {key: value}))
    with pytest.raises(InputError, match=campaign.uuid):
        read_campaign(tmp_path, campaign.uuid)


def test_holes_are_those_of_all_campaigns_that_somebody_stands_for(stored):
    mine = new_campaign("pot", "circle15", "adaptive", 0, 5, None)
    context = replace(context_for(stored), campaign=mine.uuid)
    others = replace(context, campaign="another")
    rejected = small_episode(accepted=False)
    made = [
        stored.record(episode, Label(4000 * k, 0, 0, 9), source="measured", context=where).uuid
        for k, (episode, where) in enumerate(
            [(small_episode(), context), (small_episode(), others), (small_episode(), others),
             (small_episode(), others), (rejected, context)]
        )
    ]  # fmt: skip
    for uuid in made[1:3]:
        stored.labels.accept("ann", uuid)
    stored.labels.approve("bea", made[1])
    pieces = load_pieces()
    seen = pair_coverage(
        stored, mine, ProbeTarget(pieces.piece("pot").face, pieces.piece("circle15").face)
    )
    # Mine as a draft, theirs approved and submitted; not their draft, nor what is no observation.
    found = [seen.centre_mm(i, j) for i, j in zip(*np.nonzero(seen.counts), strict=True)]
    assert sorted(found) == [(0.0, 0.0), (4.0, 0.0), (8.0, 0.0)]


@pytest.mark.parametrize(
    ("count", "asked", "most", "grips"),
    [(20, None, 7, 1), (2, None, 1, 1), (200, None, 50, 1), (2000, None, 50, 10), (20, 9, 9, 1)],
)
def test_a_campaign_makes_three_grips_and_mountings_or_more_unless_told_otherwise(
    count, asked, most, grips
):
    method = CollectRequest(count=count, probes_per_grip=asked).method(StackSettings())
    assert method.collect.probes_per_grip == most
    assert method.collect.grips_per_mounting == grips
    if asked is None and count >= GRIPS:
        in_all = -(-count // most)
        assert in_all >= GRIPS
        assert -(-in_all // grips) >= MOUNTINGS
    told = CollectRequest(count=count, grips_per_mounting=7).method(StackSettings())
    assert told.collect.grips_per_mounting == 7


@pytest.fixture
def collect(tmp_path, monkeypatch):
    """Return what runs a campaign of one probe, which is taken at once and then goes wrong."""

    def run(goes_on, when_told=None, kind=EpisodeRecorded):
        def mounting(self, bench, target, origin, context, after=0):
            felt = PressedProbe(make_episode(7, frames=1), 1, bench.now_s(), 0.0)
            where = MeasuredOffset(np.array([1.0, -2.0]), 0.1, 20.0)
            context = replace(context, grip_id=f"{context.mounting_id}/grip-1", plan_item=0)
            self._record(collecting._PendingEpisode(felt, 0, where, 0.0), context, 2)
            yield from goes_on(self, bench)
            return True

        monkeypatch.setattr(Collector, "mounting", mounting)
        session = brisk_session()
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
    collector._decisions.append("skip")
    yield from collector._carry_out(bench)


def refuse_deletions(monkeypatch, times):
    """Let the disk be full for the next deletions."""
    delete, refused = LabelStore.delete, []

    def full(self, *args):
        if len(refused) < times:
            refused.append(args)
            raise FaultError(Fault("DISK-FULL", "The disk is full.", "Not saved.", "Room."))
        delete(self, *args)

    monkeypatch.setattr(LabelStore, "delete", full)


def test_a_decision_waits_for_room_and_is_carried_out_then(collect, tmp_path, monkeypatch):
    refuse_deletions(monkeypatch, 2)
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
    write, calls = core.write_atomically, []

    def full(path, content):
        calls.extend([path] if path.parent.name == "campaigns" else [])
        if path in calls[-1:] and len(calls) == nth:
            raise OSError(errno.ENOSPC, "No space left on device")
        write(path, content)

    monkeypatch.setattr(core, "write_atomically", full)
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
        collector._decisions.append("skip")
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
    refuse_deletions(monkeypatch, refusals)
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


def collected(dataset: Dataset, answer: Callable[[Event], bool], **asked):
    """Collect by hand-over; return the session, the events, and the times of the prompts."""
    session = brisk_session()
    session.dataset = dataset
    facts: list[Event] = []
    session.events.subscribe(facts.append)
    asked_of: list[tuple[str, bool]] = []

    def reply(fact: MountingAwaited | HandOverAwaited) -> None:
        if isinstance(fact, MountingAwaited):
            what = f"fitted since {fact.mounting}"
        else:
            what = "fit anew" if fact.anew else "give" if fact.gives else "take"
        asked_of.append((what, session.hand.holding))
        session.answer(answer(fact))

    on(session, MountingAwaited | HandOverAwaited, reply)
    session.run(CollectRequest(seed=2, person="ann", hand_over=True, **asked))
    session.close()
    return session, facts, asked_of


@pytest.mark.slow
def test_each_grip_is_handed_over_and_taken_back(stored):
    answers = iter([True, True, True, True, False])
    session, facts, asked_of = collected(
        stored, lambda _: next(answers), count=2, probes_per_grip=1
    )
    # Asked with open jaws before they close, and with the piece held before they open.
    # Between two mountings somebody has to fit bottom and gels: the program says so.
    assert asked_of == [
        ("give", False), ("take", True), ("fit anew", False), ("give", False), ("take", True)
    ]  # fmt: skip
    # Nobody took it the last time: the jaws stay closed, and nothing is lost.
    assert facts[-1].ending == "cancelled"
    assert session.hand.holding
    entries = stored.episodes()
    assert len({entry.grip_id for entry in entries}) == 2
    assert len({entry.series for entry in entries}) == 2
    # 0.05 mm arm, 0.1 mm origin, and 0.5 mm of the hand instead of 0.1 mm of a jig.
    assert {stored.labels.head(e.uuid).label.sigma_um for e in entries} == {512}


def test_the_jaws_do_not_close_on_a_no(stored):
    session, facts, _ = collected(stored, lambda _: False, count=1)
    assert facts[-1].ending == "cancelled"
    assert not session.hand.holding
    assert [f.phase for f in facts if isinstance(f, PhaseEntered)] == ["shift"]
    assert stored.episodes() == []


@pytest.fixture(scope="module")
def broken_off(tmp_path_factory):
    """Return a dataset whose campaign ended after the first of two grips."""
    folder = tmp_path_factory.mktemp("broken-off") / "ds"
    with Dataset.open(folder, person="ann") as dataset:
        answers = iter([True, True, False])
        collected(dataset, lambda _: next(answers), count=2, probes_per_grip=1)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("anew", [False, True])
def test_a_campaign_that_goes_on_asks_whether_bottom_and_gels_were_fitted_anew(
    broken_off, tmp_path, anew
):
    """Splits go by mounting: a restart without refitting must not begin another one."""
    shutil.copytree(broken_off, tmp_path / "ds")
    with Dataset.open(tmp_path / "ds", person="ann") as dataset:
        uuid = newest_campaign(dataset.folder)
        assert read_campaign(dataset.folder, uuid).mountings == 1
        answers = iter([anew, True, True])
        _, facts, asked_of = collected(
            dataset, lambda _: next(answers), campaign=uuid, probes_per_grip=1
        )
        # Asked before anything is handed over or moves.
        assert [what for what, _ in asked_of] == ["fitted since 1", "give", "take"]
        moves = [type(fact) for fact in facts]
        assert moves.index(MountingAwaited) < moves.index(PhaseEntered)
        assert facts[-1].ending == "finished"
        first, second = dataset.episodes()
        assert (first.series == second.series) is not anew
        assert (first.mounting_id == second.mounting_id) is not anew
        assert first.grip_id != second.grip_id
        number, grip = (2, 1) if anew else (1, 2)
        assert second.grip_id == f"{uuid}/mounting-{number}/grip-{grip}"
        assert read_campaign(dataset.folder, uuid).mountings == number
