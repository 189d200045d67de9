"""The Stack page asks the operator of a trial on devices; keys and buttons answer."""

import pytest
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest

from tests.app.conftest import settle
from touchdown.backend.core.events import (
    HandOverAwaited,
    OutcomeAwaited,
    PhaseEntered,
    PhotoKept,
    SetUpAwaited,
    TrialFinished,
)
from touchdown.backend.core.values import Outcome
from touchdown.backend.runs.requests import RunState

PNG = b"\x89PNG\r\n\x1a\n" + bytes(40)
ASKED = OutcomeAwaited(3.0, Outcome.FELL, "The opening fingers met a lateral force of 2.4 N.")


@pytest.fixture
def stack(live, bench):
    live.go("stack")
    bench.tell_start()
    bench.set_state(RunState.RUNNING, trial=1, trials=1)
    settle(live)
    return live.workspaces["stack"]


def press(main, key):
    QTest.keyClick(main.window.windowHandle(), key)


def test_the_scene_is_pictured_and_a_key_says_that_it_is_set(live, bench, stack):
    trial = stack.page.trial
    assert not trial.isVisible()
    bench.events.publish(SetUpAwaited(0.0, "pot", "short", (6.2, -3.4), holds=False))
    settle(live)
    assert trial.isVisible()
    assert trial.picture.scene.offset_mm == (6.2, -3.4)
    assert "+6.2" in trial.text.text()
    assert not stack.page.belief_panel.isVisible()
    press(live, Qt.Key.Key_Y)
    assert bench.answers == [True]
    assert not trial.isVisible()
    assert stack.page.belief_panel.isVisible()
    press(live, Qt.Key.Key_Y)
    assert bench.answers == [True], "nothing is asked any more"
    bench.events.publish(HandOverAwaited(1.0, "pot", gives=True))
    settle(live)
    trial.no.click()
    assert bench.answers == [True, False]


def ask(live, bench):
    bench.prompt.ask()
    bench.events.publish(ASKED)
    settle(live)


@pytest.mark.parametrize(
    ("key", "seen"),
    [
        (Qt.Key.Key_1, Outcome.PLACED),
        (Qt.Key.Key_2, Outcome.FELL),
        (Qt.Key.Key_3, Outcome.KNOCKED_OVER),
        (Qt.Key.Key_Y, ASKED.proposed),
    ],
)
def test_one_key_says_what_became_of_it(live, bench, stack, key, seen):
    ask(live, bench)
    roles = {o: b.property("role") for o, b in stack.page.trial.outcomes.items()}
    assert [o for o, role in roles.items() if role == "primary"] == [ASKED.proposed]
    press(live, key)
    assert bench.prompt.seen == (seen, "")
    assert not stack.page.trial.isVisible()


def test_a_void_trial_needs_its_reason_and_is_listed(live, bench, stack):
    ask(live, bench)
    press(live, Qt.Key.Key_4)
    assert bench.prompt.seen is None
    trial = stack.page.trial
    assert trial.reason.hasFocus()
    QTest.keyClicks(trial.reason, "2 hands were in the way")
    assert bench.prompt.seen is None, "keys of a text field judge nothing"
    QTest.keyClick(trial.reason, Qt.Key.Key_Return)
    assert bench.prompt.seen == (Outcome.ABORTED, "2 hands were in the way")
    why = "Void: 2 hands were in the way."
    bench.events.publish(TrialFinished(4.0, 1, 7, Outcome.ABORTED, why, 3, None, None))
    settle(live)
    assert "0 of 1 placed" in stack.page.score.words
    assert f"Trial 1: {why}" in stack.page.score.words


def test_a_picture_goes_beside_the_journal(live, bench, stack, tmp_path, qtbot):
    bench.run_folder = tmp_path / "run"
    ask(live, bench)
    told = []
    bench.events.subscribe(lambda fact: told.append(fact) if isinstance(fact, PhotoKept) else None)
    for name, content in (("a.png", PNG), ("b.png", PNG), ("c.png", b"text")):
        (tmp_path / name).write_bytes(content)
        stack.attended.add_photo(tmp_path / name)
    qtbot.waitUntil(lambda: not stack.attended._files.busy, timeout=60_000)
    assert [fact.path for fact in told] == ["trial-001-1.png", "trial-001-2.png"]
    assert (tmp_path / "run" / "photos" / "trial-001-2.png").read_bytes() == PNG
    assert "no picture" in live.cards.card("PHOTO").text.what


def test_what_is_asked_goes_when_the_run_goes_on(live, bench, stack):
    ask(live, bench)
    bench.events.publish(PhaseEntered(5.0, "lift", 1))
    settle(live)
    assert not stack.page.trial.isVisible()
    press(live, Qt.Key.Key_1)
    assert bench.prompt.seen is None
