"""Collecting on the simulated bench: grips, mountings, labels, decisions, restarts, full disks."""

from __future__ import annotations

import json
import math
from collections import Counter
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tests.backend.bench.brisk import RATE_HZ, brisk_method, brisk_session, on
from touchdown.backend.annotations import Dataset, EpisodeFilter, storage
from touchdown.backend.core import SampleStream
from touchdown.backend.core.events import (
    CampaignBegan,
    DecisionAwaited,
    EpisodeDecided,
    Gripped,
    Paused,
    PhaseEntered,
    ProbeCollected,
    RunFinished,
)
from touchdown.backend.core.faults import Fault, FaultError, InputError, RefusedError
from touchdown.backend.episodes import REST_KEY, read_first
from touchdown.backend.runs import CollectRequest, RunState, jig, newest_campaign, read_campaign
from touchdown.backend.runs.collect import prepare_campaign
from touchdown.backend.sensing import DRAGGED
from touchdown.backend.sensing.scene_camera import Homography

pytestmark = pytest.mark.slow


class Collected:
    """Session that collects into ``folder``, with its events."""

    def __init__(self, folder, method=None, **limits):
        self.dataset = Dataset.open(folder, person="ann")
        self.session = brisk_session(method=method or brisk_method(**limits))
        self.session.dataset = self.dataset
        # By default a short campaign grips anew for each probe; here one grip is enough.
        self._per_grip = limits.get("probes_per_grip", 50)
        self._per_mounting = limits.get("grips_per_mounting", 10)
        self.facts = []
        self.session.events.subscribe(self.facts.append)

    def run(self, **changes):
        asked = {"piece": "pot", "bottom": "circle15", "count": 5, "seed": 2, "person": "ann",
                 "probes_per_grip": self._per_grip,
                 "grips_per_mounting": self._per_mounting}  # fmt: skip
        self.session.run(CollectRequest(**{**asked, **changes}))
        return self

    def of(self, kind):
        return [fact for fact in self.facts if isinstance(fact, kind)]

    @property
    def entries(self):
        return self.dataset.episodes(EpisodeFilter(deleted=None))


@contextmanager
def collecting(folder, **limits):
    collected = Collected(folder, **limits)
    try:
        yield collected
    finally:
        collected.session.close()
        collected.dataset.close()


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Return five probes, two per grip, two grips per mounting."""
    with collecting(
        tmp_path_factory.mktemp("whole") / "ds", probes_per_grip=2, grips_per_mounting=2
    ) as collected:
        yield collected.run()


def test_every_item_of_the_plan_is_an_episode_with_a_label(whole):
    assert [entry.plan_item for entry in whole.entries] == [0, 1, 2, 3, 4]
    assert whole.of(RunFinished)[-1].ending == "finished"
    assert [fact.done for fact in whole.of(ProbeCollected)] == [1, 2, 3, 4, 5]
    for entry in whole.entries:
        assert entry.quality.accepted
        assert (entry.state, entry.person, entry.mode) == ("draft", "ann", "stepped")
        head = whole.dataset.labels.head(entry.uuid)
        assert head.source == "measured"
        assert head.label.sigma_um == 150


def test_grips_and_mountings_are_counted(whole):
    for field, counts in (("grip_id", [2, 2, 1]), ("mounting_id", [4, 1]), ("series", [4, 1])):
        assert list(Counter(getattr(entry, field) for entry in whole.entries).values()) == counts
    assert [(f.mounting, f.grip) for f in whole.of(Gripped)] == [(1, 1), (1, 2), (2, 1)]
    assert len(whole.of(CampaignBegan)) == 2
    assert [f.mass_g for f in whole.of(Gripped)] == pytest.approx([15.0] * 3, abs=2.0)


def test_the_label_is_measured_and_the_command_is_kept_apart(whole):
    for entry, fact in zip(whole.entries, whole.of(ProbeCollected), strict=True):
        label = whole.dataset.labels.head(entry.uuid).label
        np.testing.assert_allclose(label.offset_mm, fact.measured_mm, atol=6e-4)
        episode = whole.dataset.read(entry.uuid)
        np.testing.assert_allclose(episode.offset_mm, fact.commanded_mm)
        assert not np.array_equal(episode.offset_mm, label.offset_mm)
        np.testing.assert_allclose(episode.offset_mm, label.offset_mm, atol=0.05)
        assert len(episode.recording.frames) > 1.8 * 2 * RATE_HZ


def test_where_the_arm_was_told_to_be_is_recorded_beside_where_it_was(whole):
    episode = whole.dataset.read(whole.entries[0].uuid)
    recording = episode.recording
    told_mm = [np.interp(recording.pose_t_s, recording.command_t_s, recording.command_mm[:, axis])
               for axis in range(3)]  # fmt: skip
    off_mm = recording.pose_mm - np.stack(told_mm, axis=1)
    in_air = recording.pose_t_s < episode.onset_s - 0.1
    assert np.abs(off_mm[in_air, :2]).max() < 0.02
    # The compliant arm (15 N/mm) stays above its command by as much as it presses.
    force_n = float(recording.wrench[-50:, 2].mean())
    assert force_n > 3.0
    assert 15.0 * off_mm[-5:, 2].mean() == pytest.approx(force_n, rel=0.25)


def test_an_episode_names_what_its_displacements_count_from(whole):
    first, second = (whole.dataset.read(entry.uuid) for entry in whole.entries[:2])
    for finger in ("left", "right"):
        named = [dict(e.metadata)[f"reference_{finger}"] for e in (first, second)]
        assert len(set(named)) == 2
        field = next(f for f in first.recording.fields if f.finger == finger)
        rest = field.position_px - field.displacement_px
        seen = field.state == 0
        others = [f for f in second.recording.fields if f.finger == finger]
        moved = others[0].position_px - others[0].displacement_px - rest
        assert np.abs(moved[seen]).max() > 0.0


def test_the_scene_camera_shows_contact_and_outcome(whole):
    entry = whole.entries[0]
    episode = whole.dataset.read(entry.uuid)
    pressed, lifted = episode.recording.scene
    assert pressed.t_s < lifted.t_s
    board = Homography.parse(dict(episode.metadata)["scene_homography"])
    changed = np.abs(pressed.image.astype(int) - lifted.image.astype(int)).sum(axis=2) > 60
    # What moved is the piece; the near edge of its face lies where label and homography say.
    ring = episode.offset_mm + 7.5 * np.array(
        [[np.cos(a), np.sin(a)] for a in np.arange(0, 6.3, 0.1)]
    )
    near = board.to_px(ring)
    rows, columns = np.nonzero(changed)
    assert abs(rows.max() - near[:, 1].max()) <= 3
    assert abs(np.mean(columns[rows > rows.max() - 6]) - near[near[:, 1].argmax(), 0]) <= 4


def test_rest_is_recorded_before_the_first_probe_and_belongs_to_no_campaign(tmp_path):
    with collecting(tmp_path / "ds") as collected:
        collected.run(count=1, stage="rest", rest_s=0.6, ramp_fraction=0.4, grip_force_n=8.0)
        rest, probe = collected.entries
        assert (rest.campaign, rest.keep_frames, rest.state) == ("", "png", "unlabelled")
        assert rest.quality.reasons == ("Rest in air, no press",)
        still = collected.dataset.read(rest.uuid)
        assert dict(still.metadata)[REST_KEY] == "air"
        assert np.ptp(still.recording.wrench_t_s) == pytest.approx(0.6, abs=0.05)
        assert len(still.recording.frames) > 0.4 * 2 * RATE_HZ
        facts = read_first(collected.dataset.path(probe.uuid)).metadata["bench"]
        assert facts["stage"] == "rest"
        assert json.loads(facts["probe"])["grip_force_n"] == 8.0
        assert collected.of(ProbeCollected)[-1].done == 1
        # The campaign keeps its plan.
        again = CollectRequest(campaign=newest_campaign(tmp_path / "ds"), person="ann")
        resumed = prepare_campaign(collected.session, replace(again, grips_per_mounting=4))[2]
        named = "stage", "rest_s", "depth_mm", "ramp_fraction", "grip_force_n", "probes_per_grip"
        assert [getattr(resumed, n) for n in named] == ["rest", 0.6, None, 0.4, 8.0, 50]
        assert (type(resumed.probes_per_grip), resumed.grips_per_mounting) == (int, 4)
        with pytest.raises(InputError, match="The campaign records 'rest', not 'gel'"):
            prepare_campaign(collected.session, replace(again, stage="gel"))


def test_a_recording_of_friction_drags_the_piece_to_both_sides_and_keeps_it_as_rejected(tmp_path):
    with collecting(tmp_path / "ds") as collected:
        collected.run(count=1, stage="contact", depth_mm=0.8, drag_mm=0.9, probes_per_grip=2)
        assert all(DRAGGED in entry.quality.reasons for entry in collected.entries)
        ends = []
        for entry in collected.entries:
            episode = collected.dataset.read(entry.uuid)
            path = episode.recording
            touch, last = np.searchsorted(path.pose_t_s, episode.onset_s + np.array([0.0, 1.9]))
            ends.append(path.pose_mm[last] - path.pose_mm[touch])
        np.testing.assert_allclose(ends, [(0, 0.85, -0.5), (0, -0.85, -0.5), (0, 0.85, -0.5)],
                                   atol=0.1)  # fmt: skip
        # Continued, it drags as before.
        again = CollectRequest(campaign=newest_campaign(tmp_path / "ds"), person="ann")
        assert prepare_campaign(collected.session, again)[2].drag_mm == 0.9
        with pytest.raises(InputError, match="Bad value for 'drag_mm'"):
            CollectRequest(person="ann", drag_mm=3.1)


def test_a_restarted_campaign_collects_only_what_is_missing(tmp_path):
    with collecting(tmp_path / "ds") as first:
        on(first.session, ProbeCollected, lambda _: first.session.engine.cancel())
        first.run(count=2)
        assert first.of(RunFinished)[-1].ending == "cancelled"
        begun = {entry.plan_item: entry.uuid for entry in first.entries}
        assert set(begun) == {0}
    with collecting(tmp_path / "ds") as second:
        name = newest_campaign(tmp_path / "ds")
        second.run(campaign=name, person="bob", piece="barrel")
        entries = second.entries
        assert sorted(entry.plan_item for entry in entries) == [0, 1]
        assert {entry.piece for entry in entries} == {"pot"}
        assert begun[0] in {entry.uuid for entry in entries}
        assert [entry.person for entry in entries] == ["ann", "bob"]
        assert len({entry.mounting_id for entry in entries}) == 2
        assert second.of(CampaignBegan)[0].done == 1


def test_decisions_are_carried_out_one_key_each(tmp_path):
    wanted = ["redo", "discard", "skip", "flag", "keep"]
    with collecting(tmp_path / "ds") as collected:
        session = collected.session
        on(session, DecisionAwaited, lambda _: session.decide(wanted.pop(0)))
        collected.run(count=3, ask=True, seed=3)  # no probe of it is refused
        assert wanted == []
        decided = [(f.item, f.decision) for f in collected.of(EpisodeDecided)]
        # Item 0 again at once, then put off to the end; item 1 left out.
        assert decided == [(0, "redo"), (0, "discard"), (1, "skip"), (2, "flag"), (0, "keep")]
        rows = [(e.plan_item, e.deleted, e.flagged) for e in collected.entries]
        assert rows == [(0, True, False), (0, True, False), (1, True, False),
                        (2, False, True), (0, False, False)]  # fmt: skip
        campaign = read_campaign(tmp_path / "ds", newest_campaign(tmp_path / "ds"))
        assert campaign.skipped == (1,)
        assert campaign.todo(collected.entries) == []


def test_stop_works_while_a_decision_is_awaited(tmp_path):
    with collecting(tmp_path / "ds") as collected:
        session = collected.session
        on(session, DecisionAwaited, lambda _: session.stop())
        collected.run(count=2, ask=True)
        assert collected.of(RunFinished)[-1].ending == "stopped"
        assert session.interlock.stopped_by == "operator"
        assert len(collected.entries) == 1


def refuse_second_episode(collected, monkeypatch, times):
    """Let the disk be full for the second episode; return the refused ones."""
    record, refused = collected.dataset.record, []

    def recorded(episode, *args, **named):
        if len(collected.entries) == 1 and len(refused) < times:
            refused.append(episode)
            raise FaultError(Fault("DISK-FULL", "The disk is full.", "Not recorded.", "Room."))
        return record(episode, *args, **named)

    monkeypatch.setattr(collected.dataset, "record", recorded)
    return refused


def test_a_disk_that_refuses_an_episode_pauses_the_campaign_and_loses_nothing(
    tmp_path, monkeypatch
):
    with collecting(tmp_path / "ds") as collected:
        session, states = collected.session, []
        refusals = refuse_second_episode(collected, monkeypatch, 2)

        def resume(_):
            states.append((session.status().state, session.status().text))
            session.engine.resume()

        on(session, Paused, resume)
        collected.run(count=3)
        assert states == [(RunState.PAUSED, "The disk is full.")] * 2
        assert "in memory" in collected.of(Paused)[0].fault.consequence
        assert collected.of(RunFinished)[-1].ending == "finished"
        assert session.interlock.faults == ()
        assert [entry.plan_item for entry in collected.entries] == [0, 1, 2]
        kept = collected.dataset.read(collected.entries[1].uuid)
        assert np.array_equal(kept.observation, refusals[0].observation)


def test_a_campaign_pauses_before_the_next_probe_while_the_disk_has_no_room(tmp_path, monkeypatch):
    with collecting(tmp_path / "ds") as collected:
        session, free = collected.session, [10**12]
        monkeypatch.setattr(
            storage.shutil, "disk_usage", lambda _place: SimpleNamespace(free=free[0])
        )
        pressed = []

        def watch(fact):
            if isinstance(fact, PhaseEntered) and fact.phase == "press" and not pressed:
                free[0] = 420_000_000
            elif isinstance(fact, Paused):
                pressed.append(len(collected.of(PhaseEntered)))
                if len(pressed) == 2:
                    free[0] = 10**12
                session.engine.resume()

        session.events.subscribe(watch)
        collected.run(count=2)
        # Resumed without room it pauses again at once; nothing moved in between.
        assert len(pressed) == 2
        assert pressed[0] == pressed[1]
        assert "0.42 GB" in collected.of(Paused)[0].fault.what
        assert [entry.plan_item for entry in collected.entries] == [0, 1]


def test_a_campaign_is_refused_with_the_figure_below_1_gb(tmp_path, monkeypatch):
    with collecting(tmp_path / "ds") as collected:
        usage = SimpleNamespace(free=900_000_000)
        monkeypatch.setattr(storage.shutil, "disk_usage", lambda _place: usage)
        with pytest.raises(InputError, match=r"Only 0\.90 GB are free; recording needs 1\.00 GB"):
            collected.run(count=2)
        assert collected.of(PhaseEntered) == []
        assert collected.entries == []


def test_a_campaign_cancelled_on_a_full_disk_goes_on_later(tmp_path, monkeypatch):
    with collecting(tmp_path / "ds") as collected:
        session = collected.session
        refuse_second_episode(collected, monkeypatch, math.inf)
        on(session, Paused, lambda _: session.engine.cancel())
        collected.run(count=2)
        assert collected.of(RunFinished)[-1].ending == "cancelled"
        assert [fault.code for fault in session.interlock.faults] == ["DISK-FULL"]
        monkeypatch.undo()
        session.reset()
        collected.run(campaign=newest_campaign(tmp_path / "ds"))
        assert [entry.plan_item for entry in collected.entries] == [0, 1]


def test_a_piece_of_another_weight_is_not_probed(tmp_path, monkeypatch):
    with collecting(tmp_path / "ds", weight_tolerance_n=1e-4) as collected:
        collected.run(count=1, piece="mushroom")
        # Masses of the shipped pieces are nominal: told, and no reason to stop.
        assert collected.of(RunFinished)[-1].ending == "finished"
        monkeypatch.setattr(jig, "_vertical_n", lambda bench: 0.0)
        collected.run(count=1, piece="mushroom")
        assert collected.of(RunFinished)[-1].ending == "failed"
        assert collected.session.interlock.faults[0].code == "WRONG-WEIGHT"
        assert len(collected.entries) == 1


@pytest.mark.parametrize("forces_n", [(), (1.0, math.nan)])
def test_a_weight_without_valid_samples_names_the_sensor(forces_n):
    samples = SampleStream("force_torque", 6, 8)
    values = np.zeros((len(forces_n), 6))
    values[:, 2] = forces_n
    samples.put(np.full(len(forces_n), 1.0), values)
    raw = SimpleNamespace(samples=samples)
    bench = SimpleNamespace(now_s=lambda: 1.0, sensing=SimpleNamespace(raw=raw))
    with pytest.raises(FaultError, match="FT-STALE"):
        jig._vertical_n(bench)


def test_a_grip_that_drifted_is_ended(tmp_path):
    with collecting(tmp_path / "ds", drift_mm=1e-6) as collected:
        collected.run(count=3)
        assert len(collected.entries) == 3
        # The first probe of a grip sets the height; the second one is off by more than nothing.
        assert len(collected.of(Gripped)) == 2


def test_what_cannot_be_collected_is_refused(tmp_path):
    with collecting(tmp_path / "ds") as collected:
        for person in (" ", "two\nlines"):
            with pytest.raises(InputError, match="not the name of a person"):
                collected.run(person=person)
        with pytest.raises(InputError, match="no piece 'cup'"):
            collected.run(piece="cup")
        with pytest.raises(InputError, match="cannot carry"):
            collected.run(bottom="pot")
        with pytest.raises(InputError, match="Not enough displacements"):
            collected.run(pattern="grid", within_mm=0.05, count=900)
        collected.session.dataset = None
        collected.session.reset()
        with pytest.raises(RefusedError, match="No dataset"):
            collected.run()
        assert collected.entries == []
