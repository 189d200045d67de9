"""The Collect half while a campaign goes on: answers, progress, origin, hand-over."""

import math
import re
from dataclasses import replace
from types import SimpleNamespace

import pytest
from PySide6.QtCore import Qt

from tests.app.collect.conftest import CAMPAIGN, PROBES
from tests.app.conftest import settle
from touchdown.app.collect.origin import CampaignPace, OriginCheckNote, RecorderGauge, residual_text
from touchdown.app.collect.probes import PairProbes, ProbeRecord, displacement_text
from touchdown.app.collect.requests import probe_text
from touchdown.app.collect.workspace import CollectMemory
from touchdown.app.shell import duration_text, restore_form
from touchdown.backend.core.events import (
    DecisionAwaited,
    EpisodeDecided,
    HandOverAwaited,
    MountingAwaited,
    OriginChecked,
    RunFinished,
)
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.runs.campaign import new_campaign
from touchdown.backend.runs.requests import RunState

KEY = Qt.Key


@pytest.mark.parametrize(
    ("key", "decision"),
    [(KEY.Key_Return, "keep"), (KEY.Key_Backspace, "discard"), (KEY.Key_X, "flag"),
     (KEY.Key_R, "redo"), (KEY.Key_S, "skip"), (KEY.Key_F5, "keep")],
)  # fmt: skip
def test_one_key_answers_for_the_last_probe(page, key, decision):
    page.begin()
    newest = page.uuids[-1]
    page.probed(newest)
    page.tell(DecisionAwaited(1.0, newest, 0))
    assert page.view.probe.detail.text() == "waiting for you"
    page.press(key)
    assert page.bench.decisions == [decision]
    assert page.bench.started == []


def test_a_new_run_leaves_the_probes_of_the_one_before_alone(page):
    before = {e.uuid: (e.flagged, e.deleted) for e in page.presenter.dataset.episodes()}
    page.begin()
    assert page.view.probe.result.text() == "Probing"
    assert not any(button.isEnabled() for button in page.view.probe.buttons.values())
    for key in (KEY.Key_Return, KEY.Key_Backspace, KEY.Key_X, KEY.Key_R, KEY.Key_S):
        page.press(key)
    page.settle()
    assert {e.uuid: (e.flagged, e.deleted) for e in page.presenter.dataset.episodes()} == before
    assert page.bench.decisions == []
    page.bench.set_state(RunState.IDLE)
    page.tell(RunFinished(2.0, "run", "cancelled", "cancelled by the operator"))
    assert page.view.probe.buttons["discard"].isEnabled(), "an older one can be decided again"


def test_space_and_f12_stop_while_the_question_waits(page):
    page.begin()
    page.probed(page.uuids[-1])
    page.tell(DecisionAwaited(1.0, page.uuids[-1], 0))
    page.press(KEY.Key_Space)
    assert page.bench.stops == 1
    page.press(KEY.Key_F12)
    assert page.bench.stops == 2
    assert page.bench.decisions == []


def test_an_older_probe_is_decided_in_the_dataset_and_shown(page):
    first = page.uuids[0]
    page.presenter.probes.choose(first)
    settle(page.main)
    page.press(KEY.Key_X)
    page.settle()
    dataset = page.presenter.dataset
    assert dataset.entry(first).flagged
    assert page.view.distribution.scene.flagged.sum() == 1
    page.press(KEY.Key_Backspace)
    page.settle()
    assert dataset.entry(first).deleted
    assert first not in page.uuids
    assert len(page.view.distribution.scene.points_mm) == PROBES - 1
    assert page.view.coverage.scene.bins.counts.sum() == PROBES - 1
    page.view.deleted.setChecked(True)
    settle(page.main)
    assert page.uuids[0] == first
    page.press(KEY.Key_Return)
    page.settle()
    assert not dataset.entry(first).deleted
    assert page.bench.decisions == []


def test_what_a_run_decides_is_read_again(page):
    page.begin()
    newest = page.uuids[-1]
    page.probed(newest)
    page.presenter.dataset.labels.flag("Ann", newest)
    page.tell(EpisodeDecided(1.0, newest, 0, "flag", "Ann"))
    assert page.view.distribution.scene.flagged[-1]
    assert "flagged" in page.view.probe.result.text()


def test_progress_pause_and_end_with_the_focus_on_the_page(page):
    target = page.view.target
    target.start.setFocus()
    page.begin()
    assert page.view.hasFocus()
    assert (target.bar.value(), target.bar.maximum()) == (2, 20)
    page.probed(page.uuids[-1], done=3)
    assert target.bar.value() == 3
    assert target.eta.text().startswith("17 left")
    page.press(KEY.Key_P)
    settle(page.main)
    assert target.pause.text() == "Resume"
    target.pause.click()
    assert page.bench.engine.orders == ["pause", "resume"]
    target.end.click()
    page.bench.set_state(RunState.CANCELLING)
    settle(page.main)
    assert not any(field.isEnabled() for field in (target.piece, target.count, target.here))
    page.bench.set_state(RunState.IDLE)
    page.tell(RunFinished(2.0, "run", "cancelled", "cancelled by the operator"))
    assert page.bench.engine.orders == ["pause", "resume", "cancel"]
    assert target.start.isEnabled()
    assert target.eta.text() == "cancelled by the operator"
    assert page.view.hasFocus()


def test_the_bar_counts_no_probe_that_was_discarded(page):
    page.begin()
    bar, dataset = page.view.target.bar, page.presenter.dataset
    older, newest = page.uuids[-2:]
    page.probed(newest, done=3)
    page.tell(EpisodeDecided(1.0, newest, 0, "flag", "Ann"))
    assert bar.value() == 3
    page.tell(EpisodeDecided(1.0, newest, 0, "discard", "Ann"))
    assert bar.value() == 2
    # An older one is discarded beside the run, which goes on counting it.
    page.presenter._progress.campaign = CAMPAIGN
    page.presenter.probes.choose(older)
    page.press(KEY.Key_Backspace)
    page.settle()
    assert dataset.entry(older).deleted
    assert bar.value() == 1
    page.press(KEY.Key_Return)
    page.settle()
    assert not dataset.entry(older).deleted
    assert bar.value() == 2


def test_a_discarded_probe_can_be_collected_again_without_a_restart(page):
    dataset = page.presenter.dataset
    plan = new_campaign("pot", "circle15", "random", 0, PROBES, None)
    replace(plan, uuid=CAMPAIGN).save(dataset.folder)
    page.presenter._read_campaign()
    page.settle()
    target = page.view.target
    assert (target.bar.value(), target.bar.maximum()) == (PROBES, PROBES)
    assert not target.go_on.isEnabled()
    page.presenter.probes.choose(page.uuids[0])
    page.press(KEY.Key_Backspace)
    page.settle()
    assert target.bar.value() == PROBES - 1
    assert target.go_on.isEnabled()


def test_the_end_of_a_campaign_offers_to_label_it_or_to_continue(page):
    dataset, step = page.presenter.dataset, page.main.window.next_step
    plan = replace(new_campaign("pot", "circle15", "random", 0, PROBES, None), uuid=CAMPAIGN)
    for more, offered in ((1, "Continue: 1 left"), (0, "Label the episodes")):
        replace(plan, count=PROBES + more).save(dataset.folder)
        page.begin()
        assert step.isHidden(), "a run that starts takes the offer of the former one away"
        page.bench.set_state(RunState.IDLE)
        page.tell(RunFinished(2.0, "run", "finished", f"{PROBES} probes are collected."))
        page.settle()
        assert step.text.text() == f"Collection of pot on circle15: {PROBES} probes are collected."
        assert step.yes.text() == offered
    started = len(page.bench.started)
    step.yes.click()
    assert page.workspace.page.front == "label"
    assert len(page.bench.started) == started, "an offer moves nothing"
    for half, hidden in (("label", True), ("collect", False)):
        page.workspace.page.show_half(half)
        page.workspace._offer_next("Collection ended.", 0)
        assert step.isHidden() is hidden, "no offer to label where one labels"
    page.workspace.page.show_half("label")
    assert step.isHidden(), "the offer has been followed"
    page.workspace._context.offer("A training ended.", "Put it in use", page.view.setFocus)
    page.workspace.page.show_half("collect")
    page.workspace.page.show_half("label")
    assert not step.isHidden(), "another offer stays"


def test_the_check_of_the_origin_is_used_once_and_remembered_and_gone_with_the_origin(page):
    page.begin()
    page.tell(OriginChecked(1.0, (0.25, -0.5), 0.11, True))
    target = page.view.target
    assert "x +0.25, y \N{MINUS SIGN}0.50" in target.residual.text()
    assert not target.take.isEnabled() or page.presenter.origin.note is not None
    page.bench.set_state(RunState.IDLE)
    page.tell(RunFinished(2.0, "run", "finished", "done"))
    target.take.click()
    target.take.click()
    assert (target.origin[0].value(), target.origin[1].value()) == (0.25, -0.5)
    kept, dropped = restore_form(CollectMemory(), page.workspace.memory())
    assert (kept.origin, dropped) == (page.presenter.origin.note, [])
    page.bench.turn(0.08)
    x_mm, y_mm, _ = page.bench.devices["arm"].poses.since(0).values[-1]
    target.here.click()
    assert [field.value() for field in target.origin] == [x_mm, y_mm]
    # A check of another origin says nothing about this one.
    assert page.presenter.origin.note is None
    page.bench.turn(3.0)
    page.bench.devices["arm"].poses.clear()
    target.origin[0].setValue(7.0)
    target.here.click()
    assert target.origin[0].value() == 7.0, "an old place of the arm is not used"


def test_in_contact_nothing_starts_and_a_lift_is_offered(page):
    steps = []
    jog = SimpleNamespace(step=lambda *asked: steps.append(asked), active=False)
    page.bench.hand = SimpleNamespace(
        pressing_n=3.0, active=False, powered=True, switching=False, holding=True, jog=jog
    )
    settle(page.main)
    target = page.view.target
    assert not target.start.isEnabled()
    assert target.why_not.text() == "In contact: lift first."
    assert target.lift.isVisible()
    target.lift.click()
    assert steps == [("z", "XYZ", 5.0, 5.0)]
    page.bench.hand.pressing_n = 0.0
    settle(page.main)
    assert target.start.isEnabled()
    assert not target.lift.isVisible()
    page.bench.hand = None


def test_a_hand_at_the_jaws_is_asked_for_and_confirmed_by_f5(page):
    target = page.view.target
    target.hand_over.setChecked(True)
    page.press(KEY.Key_F5)
    (asked,) = page.bench.started
    assert (asked.hand_over, asked.ask, asked.within_mm) == (True, True, None)
    page.begin()
    page.tell(HandOverAwaited(0.5, "pot", gives=True))
    assert target.why_not.text() == "Hold the pot between the jaws: they close on it."
    assert (target.start.text(), target.start.isEnabled()) == ("Confirm", True)
    page.press(KEY.Key_F5)
    assert page.bench.answers == [True]
    settle(page.main)
    assert (target.start.text(), target.start.isEnabled()) == ("Start collecting", False)
    page.press(KEY.Key_F5)
    assert page.bench.answers == [True]
    assert len(page.bench.started) == 1


@pytest.mark.parametrize("clicked", [True, False])
@pytest.mark.parametrize("anew", [True, False])
def test_a_campaign_that_goes_on_asks_for_its_mounting_and_takes_either_answer(page, anew, clicked):
    target = page.view.target
    page.begin()
    page.tell(MountingAwaited(0.5, "circle15", 2))
    assert target.why_not.text() == (
        "Were the circle15 or the gels mounted again since mounting 2 of this campaign?"
    )
    assert (target.start.text(), target.go_on.text()) == ("Mounted again", "As it was")
    assert target.start.isEnabled()
    assert target.go_on.isEnabled()
    with_key = Qt.KeyboardModifier.NoModifier if anew else Qt.KeyboardModifier.ShiftModifier
    if clicked:
        (target.start if anew else target.go_on).click()
    else:
        page.press(KEY.Key_F5, with_key)
    assert page.bench.answers == [anew]
    settle(page.main)
    assert (target.start.text(), target.go_on.text()) == ("Start collecting", "Continue")
    assert not target.go_on.isEnabled()
    assert len(page.bench.started) == 0


@pytest.mark.promise("W18")
def test_the_gauge_counts_bytes_of_the_last_two_minutes(tmp_path):
    gauge = RecorderGauge()
    assert gauge.bytes_a_minute(0.0) == 0.0
    for second in range(0, 61, 10):
        gauge.note(float(second), 2_000_000)
    assert gauge.bytes_a_minute(60.0) == pytest.approx(12e6)
    # The time comes before the rate, so that no figure is cut off in a narrow window.
    assert re.fullmatch(r"(Nearly full: )?[\d.]+ GB free, .+ at 12.0 MB/min",
                        gauge.words(tmp_path, 60.0))  # fmt: skip
    assert gauge.bytes_a_minute(1000.0) == 0.0
    assert gauge.words(tmp_path, 1000.0).endswith(" GB free"), "no rate without a recording"
    assert "does not answer" in gauge.words(tmp_path / "gone", 1000.0)


def test_the_time_left_follows_the_last_probes():
    pace = CampaignPace()
    pace.restart(0.0)
    assert pace.words(10) == ""
    for k in range(1, 5):
        pace.note(12.0 * k)
    assert pace.words(10) == "10 left, about 2 min at 12.0 s each"
    assert pace.words(0) == ""
    assert duration_text(3 * 86400) == "3 days"
    assert duration_text(3.5 * 3600) == "3 h 30 min"


def test_a_pair_without_a_probe_has_holes_only():
    catalogue = load_pieces()
    harvest = PairProbes(catalogue.piece("pot").face, catalogue.piece("circle15").face)
    assert harvest.covered.covered == 0.0
    assert harvest.newest == ""
    assert len(harvest.distribution(0, "").points_mm) == 0


def test_notes_that_make_no_sense_are_refused():
    assert restore_form(CollectMemory(), {"origin": None}) == (CollectMemory(), [])
    for bad in (3, {}, {"residual_mm": [1], "sigma_mm": 1, "at": "", "agrees": 1, "used": 0}):
        assert restore_form(CollectMemory(), {"origin": bad}) == (CollectMemory(), ["origin"])
    far = OriginCheckNote((1.0, 0.0), 0.1, False, "2026-01-01 10:00")
    assert "does not agree" in residual_text(far)


def test_a_displacement_in_words():
    assert displacement_text((1.234, -0.3)) == "+1.2, \N{MINUS SIGN}0.3"
    assert displacement_text((1.234, -0.3), 2, " mm") == "+1.23, \N{MINUS SIGN}0.30 mm"
    assert displacement_text((math.nan, math.nan), 2, " mm") == "none"


@pytest.mark.parametrize(
    ("offset_mm", "item", "said"),
    [((1.5, -0.25), 4, "x, y +1.50, \N{MINUS SIGN}0.25 mm, item 5, 1a2b3c4d"),
     ((math.nan, math.nan), None, "No displacement, no plan, 1a2b3c4d")],
)  # fmt: skip
def test_a_probe_says_what_is_not_known_of_it(offset_mm, item, said):
    quality = SimpleNamespace(accepted=True, slip_mm=0.0, dropped_frames=0)
    entry = SimpleNamespace(
        quality=quality, deleted=False, flagged=False, plan_item=item, uuid="0190-1a2b3c4d"
    )
    words = probe_text(ProbeRecord(entry, offset_mm), asking=False, running=False, back=True)
    assert words.where == said
