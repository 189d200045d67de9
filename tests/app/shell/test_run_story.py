"""The Stack workspace shows what the facts say, and orders what the operator asks."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QPushButton

from tests.app.conftest import settle
from tests.app.stand_in import action
from touchdown.app.shell.run_story import ProbeStory, TrialStory, outcome_text
from touchdown.app.shell.settings import load_settings
from touchdown.app.stack.presenter import stack_request
from touchdown.backend.core import (
    InputError,
    Outcome,
    PhaseEntered,
    PieceWeighed,
    RunStarted,
    Stability,
    TrialFinished,
)
from touchdown.backend.runs.requests import RunState, StackRequest
from touchdown.widgets.forms.run_form import RunForm
from touchdown.widgets.views.belief import NO_PROBE


@pytest.fixture
def page(live):
    return live.workspaces["stack"].page


def told(live, bench, end=None):
    bench.tell_start()
    bench.set_state(RunState.RUNNING)
    bench.tell_probe(1, (7.2, 3.1), -3.4)
    bench.tell_probe(2, (4.4, 1.9), -1.1)
    if end is not None:
        bench.tell_end(end)
    settle(live)


def test_start_hands_over_what_is_filled_in_and_remembers_it(live, bench, page, tmp_path):
    page.run.show_form(RunForm("barrel", "hex20", "long", 11, 5, "pick-and-place", "step"))
    page.run.start.click()
    assert bench.started == [
        StackRequest("barrel", ("long", "hex20"), 11, 5, "pick-and-place", "step")
    ]
    kept, _ = load_settings(tmp_path / "window.json")
    assert kept.pages["stack"]["mode"] == "step", "a crash does not bring the automatic mode back"
    assert stack_request(RunForm(bottom="short", under="")).bottoms == ("short",)
    assert stack_request(RunForm(weigh=True)).weigh
    assert stack_request(RunForm(staged=True)).staged


def test_a_weighed_centre_of_mass_is_shown_before_the_first_probe_and_on_the_map(live, bench, page):
    bench.tell_start()
    bench.set_state(RunState.RUNNING)
    bench.events.publish(PieceWeighed(3.0, 150.2, 0.4, (2.41, -1.58), (0.55, 0.24)))
    settle(live)
    assert page.belief.scene.empty[0] == "Centre of mass +2.4 \u00b1 0.6, \u22121.6 \u00b1 0.2 mm"
    bench.tell_probe(1, (7.2, 3.1), -3.4)
    settle(live)
    assert page.belief.scene.com_sigma_mm == (0.55, 0.24)
    assert "2 \u03c3 of the weighing" in [text for _, text, *_ in page.legend._places()]


def test_buttons_follow_the_state(live, bench, page):
    run = page.run
    assert (run.start.isEnabled(), run.pause.isEnabled(), run.cancel.isEnabled()) == (1, 0, 0)
    run.start.click()
    live.actions.action("stack.start").trigger()
    assert len(bench.started) == 1
    settle(live)
    assert (run.start.isEnabled(), run.pause.isEnabled(), run.cancel.isEnabled()) == (0, 1, 1)
    run.pause.click()
    settle(live)
    assert run.pause.text() == "Resume"
    run.pause.click()
    run.cancel.click()
    assert bench.engine.orders == ["pause", "resume", "cancel"]


def test_a_run_that_is_held_up_before_its_first_estimate_says_so_and_keeps_its_form(
    live, bench, page
):
    bench.tell_start()
    for state, title in (
        (RunState.RUNNING, "Probing"),
        (RunState.PAUSING, "Pausing"),
        (RunState.PAUSED, "Paused"),
        (RunState.CANCELLING, "Cancelling"),
    ):
        bench.set_state(state)
        settle(live)
        assert page.decision._result.text() == title
        assert not page.run._piece.isEnabled()
    bench.set_state(RunState.IDLE)
    settle(live)
    assert page.run._piece.isEnabled()


def test_decision_and_map_show_the_newest_probe(live, bench, page):
    told(live, bench)
    assert page.decision._margin.text() == "\N{MINUS SIGN}1.1 mm"
    assert page.belief.scene.belief.probes == 2
    assert len(page.strip.thumbnails) == 2
    assert page.belief.scene.truth is None
    assert "probe 2" in page.belief_panel.detail.toolTip()


def test_looking_back_and_forward_again(live, bench, qtbot, page):
    told(live, bench)
    qtbot.mouseClick(page.strip.thumbnails[0], Qt.MouseButton.LeftButton)
    settle(live)
    assert page.belief.scene.belief.probes == 1
    assert "Looking back" in page.decision._text.text()
    bench.tell_probe(3, (1.6, 0.7), 1.6)
    settle(live)
    assert page.belief.scene.belief.probes == 1  # stays where the operator looks
    qtbot.mouseClick(page.strip.thumbnails[2], Qt.MouseButton.LeftButton)
    settle(live)
    assert page.belief.scene.belief.probes == 3


def test_the_score_counts_and_gives_the_interval_from_three_trials_on(live, bench, page):
    told(live, bench, Outcome.PLACED)
    bench.tell_trial(2)
    bench.tell_end(Outcome.FELL)
    settle(live)
    score = page.score
    assert score._count.text() == "1 of 2 placed"
    assert score._rate.text() == ""
    bench.tell_trial(3)
    bench.tell_end(Outcome.FELL)
    settle(live)
    assert score._count.text() == "1 of 3 placed"
    assert score._rate.text() == "33 % success, 95 % interval 6 to 79 %"


def test_a_trial_without_a_verdict_still_says_how_it_ended(live, bench, page):
    bench.tell_start()
    bench.tell_end(Outcome.FELL, -2.0)
    settle(live)
    assert page.decision._result.text().endswith("Trial 1 fell")
    assert page.decision._margin.text() == "\N{MINUS SIGN}2.0 mm"


@pytest.mark.parametrize("outcome", list(Outcome))
def test_a_margin_stands_beside_an_outcome_only_after_a_release(live, bench, outcome, page):
    told(live, bench, outcome)
    released = outcome not in (Outcome.GAVE_UP, Outcome.ASKED, Outcome.ABORTED)
    assert page.decision._margin.text() == ("+1.6 mm" if released else "")
    assert page.decision._caption.isVisible() == released
    assert page.strip.thumbnails[1].caption.text() == "2: \N{ALMOST EQUAL TO}\N{MINUS SIGN}1.1 mm"


def test_a_trial_stopped_in_its_first_press_tells_one_story(live, bench, page):
    bench.tell_start()
    bench.events.publish(PhaseEntered(bench.clock_s(), "approach", 1))
    settle(live)
    assert page.decision._text.text() == "The press comes next."
    bench.events.publish(PhaseEntered(bench.clock_s(), "press", 1))
    settle(live)
    assert page.decision._result.text() == "Pressing"
    assert page.decision._text.text() == "The estimate comes after the press."
    assert page.belief.scene.empty[0] == "The first probe is running"
    done = TrialFinished(
        bench.clock_s(), 1, 7, Outcome.ABORTED, "stopped by operator", 0, None, None
    )
    bench.events.publish(done)
    settle(live)
    assert page.belief.scene.empty[0] == "No probe in this trial"
    assert page.score._last.text() == "Seed 7: aborted after 0 probes. Trial 2 of 3 follows."
    bench.tell_finish()
    settle(live)
    assert page.score._last.text().endswith(
        "The run ended after 1 of 3 trials. Start begins a new run."
    )
    assert page.score.detail.text() == "1 of 3, 1 aborted"
    assert page.score._count.text() == "0 of 1 placed"


def test_operate_has_no_map_before_a_probe_or_stacking_run(live, bench):
    live.go("operate")
    settle(live)
    belief = live.workspaces["operate"].page.belief
    assert belief.scene.empty[0] == "No probe yet"
    bench.tell_start()
    settle(live)
    assert belief.scene.empty == NO_PROBE


def test_an_outcome_stays_until_the_next_trial_has_a_map(live, bench, page):
    told(live, bench, Outcome.PLACED)
    bench.tell_trial(2)
    settle(live)
    assert page.belief.scene.truth is not None
    assert page.decision._result.text().endswith("Trial 1 placed")
    assert page.decision._caption.text() == "true margin"
    bench.tell_probe(1, (5.0, 1.0), -2.0)
    settle(live)
    assert page.belief.scene.truth is None
    assert page.belief.scene.path == ((5.0, 1.0),)
    assert page.decision._result.text().endswith("Would fall here")
    assert page.decision._caption.text() == "est. margin"


def test_a_new_run_empties_map_and_message(live, bench, page):
    told(live, bench, Outcome.PLACED)
    assert "Probe 2" in live.window._message.text()
    bench.tell_start(piece="barrel")
    settle(live)
    story = live.workspaces["stack"].presenter.story
    assert (story.head.piece, len(story.trials)) == ("barrel", 1)
    assert live.window._message.text() == ""
    assert live.window._message.toolTip() == ""
    assert page.belief.scene.belief is None
    assert page.strip.thumbnails == []


@pytest.mark.promise("W15")
@pytest.mark.parametrize(("key", "mode"), [(Qt.Key.Key_A, "approve"), (Qt.Key.Key_N, "step")])
def test_approval_is_asked_and_given_by_key(live, bench, key, mode, page):
    page.run.show_form(RunForm(mode=mode))
    told(live, bench)
    QTest.keyClick(live.window, key)
    assert bench.answers == []  # nothing waits: nothing is approved in advance
    settle(live)
    stood = page.belief_panel.geometry()
    bench.set_state(RunState.RUNNING, awaiting=action((4.4, 1.9), -1.1))
    settle(live)
    assert page.decision.approve.text() == f"Move and probe  {'A' if mode == 'approve' else 'N'}"
    assert page.decision._ask_text.text() == "Take this step and probe again?"
    assert page.belief_panel.geometry() == stood
    assert live.bar.pill.state.word == "YOUR TURN"
    QTest.keyClick(live.window, key)
    assert bench.answers == [True]
    QTest.keyClick(live.window, Qt.Key.Key_D)
    assert bench.answers == [True, False]


@pytest.mark.promise("W15")
def test_a_question_never_stands_beside_the_decision_before(live, bench, page):
    decision = page.decision
    told(live, bench)
    assert "2.2 mm" not in decision.accessibleDescription()
    bench.set_state(RunState.RUNNING, awaiting=action((2.0, 1.0), 2.2), estimated=3)
    settle(live)
    assert not decision.approve.isVisible(), "what is asked about has not been told yet"
    bench.tell_probe(3, (2.0, 1.0), 2.2)
    for _ in range(12):
        if not decision.approve.isVisible():
            live.pump.tick()
    assert decision.approve.isVisible()
    assert "+2.2 mm" in decision.accessibleDescription()
    decision.decline.click()
    assert bench.answers == [False]


def test_letters_do_nothing_in_a_text_field(live, bench, page):
    bench.set_state(RunState.RUNNING)
    settle(live)
    page.run._seed.setEnabled(True)
    page.run._seed.setFocus()
    QTest.keyClick(page.run._seed, Qt.Key.Key_P)
    assert bench.engine.orders == []


@pytest.mark.promise("W7")
def test_a_fault_becomes_a_card_until_reset(live, bench):
    bench.tell_fault()
    bench.tell_fault()
    settle(live)
    assert live.cards.codes == ("FT-TRIP",)
    assert live.cards.card("FT-TRIP").count == 2
    assert live.bar.pill.state.word == "FAULT"
    live.cards.card("FT-TRIP")._act()
    settle(live)
    assert live.cards.codes == ()
    assert live.bar.pill.state.word == "READY"


@pytest.mark.promise("W5")
def test_stale_by_the_windows_own_clock(live, bench, page):
    now_s = [1000.0]
    live.workspaces["stack"].live._now_s = live._chips._now_s = lambda: now_s[0]
    live._chips._drawn_s = 0.0
    bench.turn(0.04)
    settle(live)
    assert live.bar.chips["tactile_left"].value.state == "ready"
    now_s[0] += 0.201
    live._chips._drawn_s = 0.0
    settle(live)
    assert live.bar.chips["tactile_left"].value.state == "stale"
    assert page.tactile["left"]._age.value == "stale"
    now_s[0] += 2.0
    settle(live)
    assert page.tactile["left"]._age.value == "gone"
    bench.turn(0.04)
    settle(live)
    assert page.tactile["left"]._age.value == "fresh"


@pytest.mark.promise("W6")
@pytest.mark.parametrize(
    ("received", "lost", "shown"),
    [(100, 0, 0), (20, 1, 0), (20, 3, 3), (1000, 20, 0), (1000, 30, 30)],
)
def test_lost_frames_are_in_the_tips_and_on_the_chip_where_they_are_many(
    live, bench, received, lost, shown, page
):
    bench.devices["tactile_left"].received = received
    bench.devices["tactile_left"].lost = lost
    bench.turn(0.04)
    live._chips._drawn_s = live.workspaces["stack"].live._headers_s = 0.0
    settle(live)
    detail = page.captions["left"].detail
    noun = "frame" if lost == 1 else "frames"
    assert detail.text().endswith(" Hz")
    assert detail.toolTip().endswith(f"; {lost} {noun} lost")
    assert f"{lost} {noun} lost" in live.bar.chips["tactile_left"].toolTip()
    assert live.bar.chips["tactile_left"].value.lost == shown
    assert "0 samples lost" in live.bar.chips["force_torque"].toolTip()


@pytest.mark.promise("W5")
def test_every_frame_of_a_run_is_drawn_once(live, bench):
    bench.set_state(RunState.RUNNING)
    before = live.workspaces["stack"].live.frames_shown["left"]
    for _ in range(10):
        bench.turn(0.04)
        settle(live, 5)
    assert live.workspaces["stack"].live.frames_shown["left"] == before + 10
    live.window.showMinimized()
    bench.turn(0.2)
    settle(live)
    assert live.workspaces["stack"].live.frames_shown["left"] == before + 10
    live.window.showNormal()
    settle(live)
    assert live.workspaces["stack"].live.frames_shown["left"] > before + 10


@pytest.mark.promise("W5")
@pytest.mark.parametrize("what", ["markers", "wrench", "run", "hand"])
def test_a_bench_that_stands_still_is_drawn_less_often_until_something_moves(live, bench, what):
    shown, clock = live.workspaces["stack"].live, [0.0]
    shown._now_s, shown._moved_s = lambda: clock[0], 0.0

    def calm_for(seconds):
        for _ in range(round(seconds / 0.04)):
            clock[0] += 0.04
            bench.turn(0.04)
            found = shown.calm()
        return found

    assert not calm_for(0.9)
    assert calm_for(0.2)
    bench.turn(0.04)
    live.pump.tick()
    assert live.pump._timer.interval() == 125
    if what == "markers":
        field = bench.fields["right"].newest()
        moved = replace(field, position_px=field.position_px + 0.31)
        bench.fields["right"].put(bench.clock_s(), moved)
    elif what == "wrench":
        values = np.tile([0.0, 0.0, 2.0, 0.0, 0.0, 0.0], (40, 1))
        bench.wrench.put(bench.clock_s() + 0.001 * np.arange(40), values)
    elif what == "run":
        bench.set_state(RunState.RUNNING)
    else:
        bench.hand = SimpleNamespace(active=True)
    assert not shown.calm()
    bench.set_state(RunState.IDLE)
    bench.hand = None
    assert not calm_for(0.9)
    assert calm_for(0.3), "the new place is one of rest"


@pytest.mark.promise("W5")
def test_at_rest_the_tracked_picture_is_shown(live, bench):
    shown, view = live.workspaces["stack"].live, live.workspaces["stack"].page.tactile["left"]
    shown._at_rest = True
    bench.turn(0.12)
    tracked = bench.frames["left"].newest()
    bench.frames["left"].put(9.0, replace(tracked, t_s=9.0))
    shown.draw_finger("left")
    assert view._frame is tracked


@pytest.mark.promise("W1")
def test_simulated_is_said_in_banner_pill_and_title(live):
    assert "SIMULATED" in live.window.windowTitle()
    assert live.window._banner.isVisible()
    assert "simulated" in live.bar.pill.state.note
    assert live.bar._estop.text() == "none"


def test_closing_while_running_asks_and_stops_first(live, bench):
    bench.set_state(RunState.RUNNING)
    assert not live.window.close()
    assert live.window.isVisible()
    answers = live.window.findChildren(QPushButton)
    next(button for button in answers if button.text() == "Stop and close").click()
    assert bench.stops == 1
    assert not live.window.isVisible()


def test_the_question_follows_what_it_asks_about(live, bench):
    def answers():
        asked = live.cards.asks
        return [b for b in live.cards.findChildren(QPushButton) if asked.text in b.accessibleName()]

    bench.set_state(RunState.RUNNING)
    live.window.close()
    answers()[1].setFocus()
    settle(live)
    assert "A run is active" in live.cards.asks.text
    bench.set_state(RunState.IDLE)
    settle(live)
    assert "It has ended" in live.cards.asks.text
    assert [button.text() for button in answers()] == ["Stay", "Close"]
    # The answer that had the focus is gone: Space must not close now what it would have kept.
    assert answers()[0].hasFocus()
    answers()[1].click()
    assert bench.stops == 0
    assert not live.window.isVisible()


def test_a_bench_that_cannot_be_built_is_a_card(main, qtbot):
    def fail():
        raise KeyError("no such model")  # of whatever kind

    main.connect_bench(fail)
    qtbot.waitUntil(lambda: not main._loader.busy, timeout=60_000)
    settle(main)
    assert main.cards.codes == ("CONNECT",)
    assert "no such model" in main.cards.card("CONNECT").text.what
    assert main.bar.pill.state.word == "NO DEVICES"
    buttons = main.cards.card("CONNECT").findChildren(QPushButton)
    next(button for button in buttons if button.text() == "Try again").click()
    assert main.cards.codes == ()
    assert main.bar.pill.state.word == "CONNECTING"
    qtbot.waitUntil(lambda: not main._loader.busy, timeout=60_000)
    settle(main)
    assert main.cards.codes == ("CONNECT",)


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (InputError("No model.", "pod.safetensors", "Train one."),
         ("No model.", "Bench file: lab.toml. In pod.safetensors. Nothing", "Train one. Correct")),
        (InputError("Bad value for 'kind'.", "lab.toml", "Correct it."),
         ("Bad value for 'kind'.", "In lab.toml. Nothing", "Correct it. Correct")),
        (AssertionError(), ("AssertionError", "Bench file: lab.toml. Nothing", "Correct this")),
    ],
)  # fmt: skip
def test_the_card_of_a_bench_names_its_file_and_the_place_of_the_error(main, qtbot, error, said):
    def fail():
        raise error

    main.connect_bench(fail, Path("lab.toml"))
    qtbot.waitUntil(lambda: not main._loader.busy, timeout=60_000)
    settle(main)
    card = main.cards.card("CONNECT").text
    assert card.what == f"The bench could not be prepared: {said[0]}"
    assert card.consequence.startswith(said[1])
    assert card.next_step.startswith(said[2])
    assert "raise error" in card.details


@pytest.mark.parametrize(
    ("outcome", "true_mm", "said"),
    [
        (Outcome.PLACED, 1.5, "fine Estimate: stands, +0.1 mm."),
        (Outcome.FELL, -1.8, "fine Estimate: stands, +0.1 mm, 1.9 mm too high."),
    ],
)
def test_a_fall_after_a_good_estimate_names_the_error_of_the_estimate(outcome, true_mm, said):
    trial = TrialStory(1, 3, None)
    judged = Stability(True, 0.1, "area", np.zeros((0, 2)), (0.0, 0.0), "belief")
    trial.probes.append(ProbeStory(1, stability=judged))
    trial.finished = TrialFinished(9.0, 1, 3, outcome, "fine", 1, None, true_mm)
    head = RunStarted(0.0, "r", "pot", "short", "paper", 3, 1, simulated=True, settings="")
    assert outcome_text(trial, head).text == said
