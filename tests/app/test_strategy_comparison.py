"""Both strategies on the same seed: what is missing is run in turn, what went wrong ends it."""

import pytest

from tests.app.conftest import settle
from touchdown.app.stack.comparison import MAX_QUESTIONS, StrategyRuns, stack_question
from touchdown.backend.core.events import RunFinished, RunStarted
from touchdown.backend.core.values import Outcome
from touchdown.backend.runs.requests import RunState, StackRequest

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
    assert felt.rate.text() == "100 % success, 95 % interval 21 to 100 %"
    assert felt.trial.text().startswith("Placed after 3 probes.")
    assert felt.belief.scene.belief.probes == 2
    assert blind.trial.text().startswith("Fell")
    assert blind.belief.scene.belief is None
    assert sheet.run.text() == "Run both again"


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
