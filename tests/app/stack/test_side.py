"""The fall is drawn as it was recorded; the story keeps what was told, in any order of repeats."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PySide6.QtWidgets import QApplication

from tests.app.conftest import settle
from tests.app.stand_in import stability
from touchdown.app.shell.bench_view import HOLD_S, BenchViewPresenter
from touchdown.app.shell.run_story import RunStory
from touchdown.app.stack.comparison import MAX_QUESTIONS, StrategyRuns, stack_question
from touchdown.backend.core.events import (
    PhaseEntered,
    Released,
    RunFinished,
    RunStarted,
    StabilityJudged,
    TrialFinished,
    TrialStarted,
)
from touchdown.backend.core.values import Fall, Outcome
from touchdown.backend.devices import GripStatus, StagedOpening
from touchdown.backend.geometry import Surface, load_pieces
from touchdown.backend.learning.fused import Guard, GuardCalibration
from touchdown.backend.runs.requests import RunState, StackRequest
from touchdown.widgets.base import Panel, Theme
from touchdown.widgets.views import DecisionText, Score, TrialPrompt
from touchdown.widgets.views.scene import ABOVE, SIDE, UPRIGHT, SideBody, SideScene, SideView


@pytest.mark.parametrize("angle", [0.0, 0.3, -1.2, 1.57, 2.5])
def test_a_turned_body_shows_the_sides_that_a_turned_rectangle_has(angle):
    """Seen along y a cylinder is a rectangle; turned about y it is that rectangle turned."""
    turn = (np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0)
    above, foot = SideBody("pot", 7.5, 15.0, 38.0, 4.0, -2.0, turn).outlines_mm()
    cos, sin = np.cos(angle), np.sin(angle)
    for part, half, low, high in ((foot, 7.5, 0.0, 6.0), (above, 15.0, 6.0, 38.0)):
        corners = np.array([(x, z) for x in (-half, half) for z in (low, high)])
        turned = corners @ np.array([[cos, -sin], [sin, cos]]) + (4.0, -2.0)
        assert part.max(axis=0) == pytest.approx(turned.max(axis=0), abs=1e-4)
        assert part.min(axis=0) == pytest.approx(turned.min(axis=0), abs=1e-4)


def test_a_fall_towards_the_viewer_shows_the_round_end():
    turn = (np.cos(np.pi / 4), np.sin(np.pi / 4), 0.0, 0.0)
    above, _ = SideBody("pot", 7.5, 15.0, 38.0, 0.0, 0.0, turn).outlines_mm()
    assert np.hypot(*above.T) == pytest.approx(15.0, abs=1e-4)


def test_a_bottom_that_is_not_flat_shows_the_profile_of_its_face(seen):
    bent = replace(load_pieces().bottom("short"), surface=Surface(step_mm=0.8))
    seen.side._stand_on([bent])
    (outline,) = seen.side._bottoms[0].outlines_mm()
    assert outline[:, 1].max() == pytest.approx(0.8)
    assert outline[outline[:, 0] < -0.6, 1].max() == pytest.approx(0.0)


def fall():
    t_s = np.linspace(0, 1, 11)
    angle = 1.5 * t_s
    pose = np.zeros((11, 2, 7))
    pose[:, 0, 3] = 1.0
    pose[:, 1, 0] = 0.004 + 0.010 * t_s
    pose[:, 1, 2] = -0.020 * t_s
    pose[:, 1, 3], pose[:, 1, 5] = np.cos(angle / 2), np.sin(angle / 2)
    return Fall(t_s, pose, ("short", "pot"))


@pytest.fixture
def seen(bench, qtbot):
    """The presenter of a side view, the view, its panel and a clock wound by hand."""
    now_s, view = [50.0], SideView(Theme())
    panel = Panel("side", view)
    qtbot.addWidget(panel)
    panel.show()
    qtbot.waitExposed(panel, timeout=60_000)
    side = BenchViewPresenter(bench, view, panel, lambda: now_s[0])
    return SimpleNamespace(side=side, view=view, panel=panel, now_s=now_s)


def test_the_piece_follows_its_recorded_fall(bench, seen):
    side, view, panel, now_s = seen.side, seen.view, seen.panel, seen.now_s
    bench.turn(0.04)
    side.take(RunStarted(0.0, "r", "pot", "short", "paper", 7, 1, True, "{}"))
    side.take(TrialStarted(0.0, 1, 7, None))
    _draw(side)
    assert view.scene.hand_mm is not None
    side.take(Released(1.0, 1, False, -2.0, fall()))
    now_s[0] += 0.5
    _draw(side)
    piece = view.scene.piece
    assert piece.x_mm == pytest.approx(9.0, abs=0.01)
    assert piece.z_mm == pytest.approx(-10.0, abs=0.01)
    assert 2 * np.arctan2(piece.turn[2], piece.turn[0]) == pytest.approx(0.75, abs=1e-3)
    assert view.scene.span_mm[1] > 14.0 + 30.0, "all of the fallen piece is in the picture"
    side.take(TrialStarted(0.0, 2, 8, None))
    now_s[0] += HOLD_S - 0.6
    _draw(side)
    assert view.scene.piece.turn[2] == pytest.approx(np.sin(0.75), abs=1e-3)
    assert view.scene.hand_mm is None, "the hand belongs to the next trial"
    assert panel.detail.text() == "trial 1: fell"
    now_s[0] += 0.2
    _draw(side)
    assert view.scene.piece.turn == UPRIGHT
    assert view.scene.hand_mm is not None


def test_the_piece_stays_on_its_support_while_the_hand_rises(bench, seen):
    side, view, panel = seen.side, seen.view, seen.panel
    side.take(RunStarted(0.0, "r", "pot", "short", "paper", 7, 1, True, "{}"))
    side.take(TrialStarted(0.0, 1, 7, None))
    bench.press = 1.0
    bench.turn(0.04)
    side.take(PhaseEntered(0.0, "rise", 1))
    bench.press = 0.0
    bench.turn(0.04)
    _draw(side)
    assert (view.scene.piece.x_mm, view.scene.piece.z_mm) == (2.5, 0.0)
    assert view.scene.hand_mm == (4.0, 1.0, 27.0)
    assert panel.detail.text() == "released"
    side.take(Released(1.0, 1, True, 2.0, None))
    _draw(side)
    assert (view.scene.piece.x_mm, view.scene.piece.z_mm) == (2.5, 0.0)
    assert panel.detail.text() == "trial 1: stands"


def test_a_piece_between_loosened_jaws_is_still_drawn(bench, seen, monkeypatch):
    seen.side.take(RunStarted(0.0, "r", "pot", "short", "paper", 7, 1, True, "{}"))
    bench.turn(0.04)
    loose = GripStatus(30.3, 9.0, holding=False)
    monkeypatch.setattr(bench.devices["gripper"], "status", lambda: loose)
    _draw(seen.side)
    assert seen.view.scene.piece is None
    bench.interlock.staged = StagedOpening(30.0, 10.0)
    _draw(seen.side)
    assert seen.view.scene.piece is not None


@pytest.mark.parametrize("tilt_deg", [0.0, 12.0, -9.0])
def test_a_turned_hand_is_drawn_turned_with_its_piece(bench, seen, tilt_deg):
    """Turned about y, seen along y: the piece is a rectangle turned about the grasp pivot."""
    side, view = seen.side, seen.view
    side.take(RunStarted(0.0, "r", "pot", "short", "paper", 7, 1, True, "{}"))
    bench.turn(0.04)
    bench.devices["arm"].turn_rad = (0.0, np.radians(tilt_deg), 0.0)
    _draw(side)
    hand = np.array(view.scene.hand_mm)[[0, 2]]
    grip_mm = bench.catalogue.piece("pot").grip_height_mm
    cos, sin = np.cos(np.radians(tilt_deg)), np.sin(np.radians(tilt_deg))
    piece = view.scene.piece
    # A positive turn about y carries what is below the pivot to smaller x.
    assert (piece.x_mm, piece.z_mm) == pytest.approx(
        hand - (grip_mm * sin, grip_mm * cos), abs=0.02
    )
    _, left, right = view.scene.hand_parts_mm(SIDE)
    assert left == pytest.approx(right), "one finger is behind the other, along y"
    along = left - hand
    across = along @ (cos, -sin)
    assert (across.min(), across.max()) == pytest.approx((-12.5, 12.5), abs=0.01)
    _, low, high = view.scene.hand_parts_mm(ABOVE)
    assert high[:, 1].min() - low[:, 1].max() == pytest.approx(2 * view.scene.jaws_mm, abs=1e-3)


def test_from_above_the_hand_covers_the_piece(qtbot):
    view = SideView(Theme())
    qtbot.addWidget(view)
    view.resize(400, 200)
    piece = SideBody("pot", 7.5, 15.0, 38.0, 0.0, 0.0)
    shown = []
    for hand in (None, (0.0, 0.0, 30.0)):
        view.show_scene(SideScene((SideBody("short", 10.0, 10.0, 30.0, 0.0, -30.0),), piece, hand))
        at = view.halves()[1].place(11.0, 0.0)
        shown.append(view.grab().toImage().pixelColor(at.toPoint()).name())
    assert shown[0] != shown[1]


def test_nothing_fallen_is_drawn_below_the_table(bench, seen):
    side, view, now_s = seen.side, seen.view, seen.now_s
    bench.turn(0.04)
    side.take(RunStarted(0.0, "r", "pot", "short", "paper", 7, 1, True, "{}"))
    side.take(TrialStarted(0.0, 1, 7, None))
    pose = np.array([[[0.05, 0.0, -0.1, np.cos(np.pi / 4), 0.0, np.sin(np.pi / 4), 0.0]]])
    side.take(Released(1.0, 1, False, -2.0, Fall(np.zeros(1), pose, ("pot",))))
    now_s[0] += 0.1
    _draw(side)
    lowest = min(part[:, 1].min() for part in view.scene.piece.outlines_mm())
    assert lowest == pytest.approx(view.scene.table_mm, abs=1e-3)
    assert view.scene.table_mm < -20.0


def _draw(side):
    side.draw()
    side.draw()


def test_a_repeated_probe_number_replaces_the_older_look():
    story = RunStory()
    story.take(TrialStarted(0.0, 1, 7, None))
    for margin in (-1.0, 2.0):
        story.take(StabilityJudged(1.0, stability((1.0, 1.0), margin), 1))
    assert len(story.trial.probes) == 1
    assert story.trial.probes[0].stability.margin_mm == 2.0


def test_facts_before_any_trial_are_harmless():
    story = RunStory()
    story.take(StabilityJudged(1.0, stability((1.0, 1.0), 1.0), 1))
    assert story.trial is None
    assert story.outcomes == ()


PAPER, BLIND = "paper", "pick-and-place"


def begin(bench, strategy, seed=7):
    bench.events.publish(
        RunStarted(bench.clock_s(), strategy, "pot", "short", strategy, seed, 3, True, "{}")
    )
    bench.set_state(RunState.RUNNING)


def end(bench, ending="finished"):
    bench.events.publish(RunFinished(bench.clock_s(), "run", ending, ""))
    bench.set_state(RunState.IDLE)


def run(bench, strategy, outcome, margin):
    """Tell one trial of a run; only the method probes."""
    begin(bench, strategy)
    bench.tell_trial(1)
    if strategy == PAPER:
        bench.tell_probe(1, (7.2, 3.1), -2.1)
        bench.tell_probe(2, (4.6, 2.0), 1.6)
    bench.tell_end(outcome, margin)
    end(bench)


@pytest.fixture
def comparing(live, bench):
    live.go("stack")
    live.actions.action("stack.compare").trigger()
    comparison = live.workspaces["stack"].comparison
    yield comparison
    comparison.sheet.close()


def test_what_is_missing_is_run_one_after_the_other(live, bench, comparing):
    sheet = comparing.sheet
    assert [panel.count.text() for panel in sheet.panels] == ["Not run yet", "Not run yet"]
    assert sheet.run.text() == "Run both"
    sheet.run.click()
    assert [request.strategy for request in bench.started] == [PAPER]
    run(bench, PAPER, Outcome.PLACED, 1.6)
    settle(live)
    assert [request.strategy for request in bench.started] == [PAPER, BLIND]
    run(bench, BLIND, Outcome.FELL, -0.8)
    settle(live)
    assert len({stack_question(request) for request in bench.started}) == 1
    felt, blind = sheet.panels
    assert (felt.count.text(), blind.count.text()) == ("1 of 1 placed", "0 of 1 placed")
    assert felt.rate.text() == ""  # the interval of one trial says nothing
    assert felt.trial.text().startswith("Placed after 3 probes.")
    assert felt.belief.scene.belief.probes == 2
    assert blind.trial.text().startswith("Fell")
    assert blind.belief.scene.belief is None
    assert sheet.run.text() == "Run both again"
    assert sheet._pairs.text().startswith("Placed by Probe and believe alone: 1, by Pick and place")
    assert sheet._pairs.text().endswith("of 1 pair. Undecided; more trials may follow.")


def test_any_strategy_can_stand_on_the_right_and_keeps_its_answer(live, bench, comparing):
    sheet, (left, right) = comparing.sheet, comparing.sheet.panels
    run(bench, PAPER, Outcome.PLACED, 1.6)
    run(bench, "fused", Outcome.PLACED, 1.1)
    settle(live)
    names = {sheet.against.itemData(at) for at in range(sheet.against.count())}
    assert {"zero-wrench", "fused", BLIND} <= names
    assert PAPER not in names
    for name, count, runs in (("fused", "1 of 1 placed", "Run both again"),
                              ("zero-wrench", "Not run yet", "Run the other one")):  # fmt: skip
        at = sheet.against.findData(name)
        sheet.against.setCurrentIndex(at)
        sheet.against.activated.emit(at)
        assert right.accessibleName() == sheet.against.itemText(at)
        assert right.count.text() == count
        assert left.count.text() == "1 of 1 placed"
        assert sheet.run.text() == runs
    sheet.run.click()
    assert [request.strategy for request in bench.started] == ["zero-wrench"]
    settle(live)
    assert not sheet.against.isEnabled()


def test_devices_let_nothing_go_untested(live, bench):
    live.go("stack")
    bench.simulated = False
    live.actions.action("stack.compare").trigger()
    sheet = live.workspaces["stack"].comparison.sheet
    assert sheet.against.findData(BLIND) == -1
    assert sheet.against.currentData() == live.workspaces["stack"].comparison._pair[1] != BLIND
    assert sheet.against.findData("zero-wrench") >= 0
    sheet.close()


def test_a_run_that_was_cancelled_starts_no_other(live, bench, comparing):
    comparing.sheet.run.click()
    begin(bench, PAPER)
    end(bench, "cancelled")
    settle(live)
    assert len(bench.started) == 1
    assert comparing.sheet.run.text() == "Run both"


def test_after_a_stop_nothing_is_run(live, bench, comparing):
    live.stop()
    settle(live)
    assert not comparing.sheet.run.isEnabled()
    assert "Reset" in comparing.sheet.run.toolTip()
    comparing.run_missing()
    settle(live)
    assert bench.started == []


def test_an_earlier_run_of_the_same_question_counts_and_another_seed_does_not(live, bench):
    live.go("stack")
    run(bench, PAPER, Outcome.PLACED, 1.6)
    settle(live)
    live.actions.action("stack.compare").trigger()
    sheet = live.workspaces["stack"].comparison.sheet
    assert sheet.run.text() == "Run the other one"
    sheet.close()
    live.workspaces["stack"].page.run._seed.setValue(8)
    live.actions.action("stack.compare").trigger()
    assert sheet.run.text() == "Run both"
    sheet.close()


def test_of_a_finished_trial_the_last_map_alone_is_kept(live, bench, comparing):
    run(bench, PAPER, Outcome.PLACED, 1.6)
    settle(live)
    story = comparing._rivals.story(("pot", "short", 7, 3), PAPER)
    assert [look.belief is not None for look in story.trials[0].probes] == [False, True]
    shown = live.workspaces["stack"].presenter.story.trials[0].probes
    assert all(look.belief is not None for look in shown), "the page itself can look back"


def test_only_the_newest_questions_are_kept():
    rivals = StrategyRuns()
    for seed in range(MAX_QUESTIONS + 1):
        rivals.take(RunStarted(0.0, "r", "pot", "short", PAPER, seed, 3, True, "{}"))
    requests = [StackRequest("pot", ("short",), seed, 3) for seed in (0, 1, MAX_QUESTIONS)]
    assert [rivals.story(stack_question(r), PAPER) is not None for r in requests] == [
        False,
        True,
        True,
    ]


def test_certificate_of_the_form_is_shown_with_its_reason(live, bench):
    live.go("stack")
    run = live.workspaces["stack"].page.run
    shown = run._certificate
    assert (shown.text(), shown.isVisibleTo(run)) == ("", False)
    run.show_form(replace(run.form(), strategy="fused"))
    assert shown.text() == "No certificate for this bench: none was made for this network."
    run.show_certificate("Unsafe \u2264 1.0 % of releases.", "For pot.")
    assert (shown.toolTip(), shown.accessibleName()) == ("For pot.", "Certificate")
    assert shown.isVisibleTo(run)


def test_stages_are_offered_where_the_release_is_tested(live, bench):
    live.go("stack")
    run = live.workspaces["stack"].page.run
    run._staged.setChecked(True)
    assert run.form().staged
    run.show_form(replace(run.form(), strategy="pick-and-place"))
    assert not run._staged.isVisibleTo(run)
    assert not run.form().staged
    run.show_form(replace(run.form(), strategy="fused"))
    assert run._staged.isVisibleTo(run)


def test_a_release_in_stages_shows_its_step(live, bench):
    live.go("stack")
    run = live.workspaces["stack"].page.run
    phase = {"trial": 1, "trials": 12, "probe": 10, "phase": "release"}
    bench.set_state(RunState.RUNNING, **phase, step=12, steps=38)
    settle(live)
    assert run.detail.text() == "trial 1 of 12, probe 10: step 12 of 38"
    bench.set_state(RunState.RUNNING, steps=0)
    settle(live)
    assert run.detail.text() == "trial 1 of 12, probe 10: release"


def test_weighing_is_offered_for_a_piece_that_is_heavy_enough(live, bench):
    live.go("stack")
    run = live.workspaces["stack"].page.run
    assert not run._weigh.isVisibleTo(run)
    run.show_form(replace(run.form(), piece="brick", weigh=True))
    assert run._weigh.isVisibleTo(run)
    assert run.form().weigh
    run._piece.setCurrentIndex(run._piece.findData("pot"))
    assert not run.form().weigh


def test_signals_that_differ_are_shown_until_the_operator_resets_the_guard(live, bench):
    bench.guard = Guard(GuardCalibration(
        bench="b", bench_sha256="b", code="c", date="2026-01-01", scores={"pot": (1.0,) * 99}
    ))  # fmt: skip
    live.go("stack")
    page, presenter = live.workspaces["stack"].page, live.workspaces["stack"].presenter
    run = page.run
    assert run._signals.isHidden(), "the paper's strategy has no guard"
    run.show_form(replace(run.form(), strategy="fused"))
    assert run._signals.text() == "Signals look as in calibration (0 trials compared)."
    for _ in range(5):
        bench.guard.observe("pot", 9.0)
    presenter.take(TrialFinished(9.0, 1, 7, Outcome.ASKED, "why", 2, None, None))
    assert run._signals.text().startswith(
        "Signals differ from calibration: each release is asked ("
    )
    bench.guard.reset("new gels")
    presenter.show_model()
    assert run._signals.text() == "Signals look as in calibration (0 trials compared)."
    assert bench.prompt.attended


def test_the_bench_is_shown_wherever_form_and_score_leave_its_height(live):
    live.window.resize(1280, 720)
    live.go("stack")
    settle(live)
    page = live.workspaces["stack"].page
    last = "Seed 1: placed after 4 probes. Trial 2 of 2 follows."
    void = tuple(f"Trial {n}: Void: the bottom was put in the wrong place." for n in range(3))
    for score, there in (
        (Score((Outcome.PLACED,), 2, (0.05, 1.0), last), True),
        (Score((Outcome.ABORTED,) * 3, 4, (0.0, 0.9), last, void=void), False),
        (Score((), 2, None), True),
    ):
        page.score.show_score(score)
        settle(live)
        assert page.side_panel.isVisible() == there
    page.decision.show_text(
        DecisionText("Would stand here", "good", "+2.7 mm", "Centre of mass inside the hull.")
    )
    page.show_trial(TrialPrompt("What became of it?", "No lateral force on the fingers."))
    settle(live)
    bars = live.window._scrolls["stack"]
    assert not bars.verticalScrollBar().isVisible()
    assert not bars.horizontalScrollBar().isVisible()


def test_a_page_that_is_arranged_asks_for_no_further_layout(live, monkeypatch):
    """A layout that asks for the next one took half a core."""
    live.go("stack")
    settle(live)
    page, arranged = live.workspaces["stack"].page, []
    arrange = page._leave_room
    monkeypatch.setattr(page, "_leave_room", lambda: (arranged.append(1), arrange()))
    page.updateGeometry()
    for _ in range(10):
        QApplication.processEvents()
    assert len(arranged) <= 2
