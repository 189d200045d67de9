"""The fall is drawn as it was recorded; the story keeps what was told, in any order of repeats."""

import numpy as np
import pytest

from app.run_story import RunStory
from app.side import SidePresenter, tilt_about_y
from backend.core.facts import Released, RunStarted, StabilityJudged, TrialStarted
from backend.core.flow import Fall
from tests.app.conftest import settle
from tests.app.stand_in import stability
from widgets.panel import Panel
from widgets.side_view import SideView


@pytest.mark.parametrize("angle", [0.0, 0.3, -1.2, 1.57, 2.5])
def test_tilt_of_a_turn_about_y(angle):
    turn = np.array([np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0])
    assert tilt_about_y(turn) == pytest.approx(angle)


def test_a_turn_about_the_vertical_is_no_tilt():
    assert tilt_about_y(np.array([np.cos(0.4), 0.0, 0.0, np.sin(0.4)])) == pytest.approx(0.0)


def fall():
    t_s = np.linspace(0, 1, 11)
    angle = 1.5 * t_s
    pose = np.zeros((11, 2, 7))
    pose[:, 0, 3] = 1.0
    pose[:, 1, 0] = 0.004 + 0.010 * t_s
    pose[:, 1, 2] = -0.020 * t_s
    pose[:, 1, 3], pose[:, 1, 5] = np.cos(angle / 2), np.sin(angle / 2)
    return Fall(t_s, pose, ("short", "pot"))


def test_the_piece_follows_its_recorded_fall(bench, qtbot):
    now_s = [50.0]
    view = SideView(_theme())
    panel = Panel("side", view)
    qtbot.addWidget(panel)
    panel.show()
    qtbot.waitExposed(panel)
    side = SidePresenter(bench, view, panel, lambda: now_s[0])
    bench.turn(0.04)
    side.take(RunStarted(0.0, "r", "pot", "short", "paper", 7, 1, True, "{}"))
    side.take(TrialStarted(0.0, 1, 7, None))
    _draw(side)
    assert view.scene.jaws_mm is not None
    side.take(Released(1.0, 1, False, -2.0, fall()))
    now_s[0] += 0.5
    _draw(side)
    piece = view.scene.piece
    assert view.scene.jaws_mm is None
    assert piece.x_mm == pytest.approx(9.0, abs=0.01)
    assert piece.z_mm == pytest.approx(-10.0, abs=0.01)
    assert piece.tilt_rad == pytest.approx(0.75, abs=1e-3)
    now_s[0] += 60.0
    _draw(side)
    assert view.scene.piece.tilt_rad == pytest.approx(1.5, abs=1e-3)
    side.take(TrialStarted(0.0, 2, 8, None))
    _draw(side)
    assert view.scene.piece.tilt_rad == 0.0


def _draw(side):
    side.draw()
    side.draw()


def _theme():
    from widgets.theme import Theme

    return Theme()


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


def test_a_new_run_forgets_the_old_one(live, bench):
    bench.tell_start()
    bench.tell_probe(1, (7.2, 3.1), -3.4)
    settle(live)
    bench.tell_start(piece="barrel")
    settle(live)
    assert live.stack.story.head.piece == "barrel"
    assert len(live.stack.story.trials) == 1
    assert live.page.strip.thumbnails == []
