"""An operator stacks in the window: the real bench, stepped by hand instead of by its thread."""

import numpy as np
import pytest
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest

from tests.app.conftest import opened, settle
from tests.backend.bench.brisk import brisk_method
from tests.journeys import operate_desk
from tests.journeys.operate_desk import SteppedSession, brisk_session
from touchdown.backend.bench import assembly
from touchdown.backend.core import ContactPatch, Outcome, RefusedError
from touchdown.backend.geometry.outlines import face_points
from touchdown.backend.learning.checkpoint import load_card
from touchdown.backend.runs.requests import ProbeRequest, RunState
from touchdown.widgets.forms.run_form import RunForm

BOTTOM_RADIUS_MM = 10.0


class KnowsTheBottom:
    """Estimates the contact of a face on the short bottom from the offset alone (no training)."""

    base_rate = 0.3
    calibration = None

    def __init__(self, piece):
        self._points = face_points(piece.face)
        self.card = load_card(assembly.shipped_model(piece.name))

    def prepare(self, early):
        """Nothing to prepare."""

    def estimate(self, episode):
        inside = BOTTOM_RADIUS_MM - np.hypot(*(self._points + episode.offset_mm).T)
        return ContactPatch(self._points.copy(), 1 / (1 + np.exp(-np.clip(1.2 * inside, -4, 4))))


@pytest.fixture
def desk(qapp, qtbot, tmp_path, monkeypatch):
    monkeypatch.setattr(
        assembly.Estimator, "load", staticmethod(lambda path, piece: KnowsTheBottom(piece))
    )
    link = SteppedSession(brisk_session(tmp_path, brisk_method()))
    with opened(tmp_path, link) as main:
        main.window.show()
        qtbot.waitExposed(main.window, timeout=60_000)
        settle(main)
        yield main, link


def turn_until(main, link, done):
    """Turn bench and window together until ``done``."""
    operate_desk.turn_until(main, link, done, steps=1500, every=2)


@pytest.mark.promise("W15")
@pytest.mark.slow
def test_stack_look_back_and_review(desk, qtbot, tmp_path):
    main, link = desk
    main.workspaces["stack"].page.run.show_form(RunForm(seed=7, trials=1))
    main.workspaces["stack"].page.run.start.click()
    turn_until(main, link, lambda: main.workspaces["stack"].presenter.story.ended is not None)
    assert main.workspaces["stack"].presenter.story.ended.ending == "finished"
    assert main.workspaces["stack"].presenter.story.outcomes == (Outcome.PLACED,)
    trial = main.workspaces["stack"].presenter.story.trial
    assert len(trial.probes) >= 2
    assert main.workspaces["stack"].page.score._count.text() == "1 of 1 placed"
    assert "Placed" in main.workspaces["stack"].page.decision._result.text()
    truth = main.workspaces["stack"].page.belief.scene.truth
    assert truth is not None
    assert main.workspaces["stack"].page.tactile["left"].seen()[1] == 63
    assert main.workspaces["stack"].page.force.buckets.largest() > 4.0
    # The hull of the estimate lies over the true overlap: offsets of the map are understood.
    hull = trial.probes[-1].stability.hull_mm
    assert np.linalg.norm(hull.mean(axis=0) - truth.mean(axis=0)) < 2.5
    # Every run is kept and can be looked at again.
    main.actions.action("review").trigger()
    review = main.workspaces["review"]
    qtbot.waitUntil(lambda: not review.presenter.recordings.describing, timeout=60_000)
    review.page.runs.setCurrentIndex(review.page.runs.model().index(0, 0))
    qtbot.waitUntil(lambda: not review.presenter.reading, timeout=60_000)
    assert review.page.trials.count() == 1
    assert len(review.page.strip.thumbnails) == len(trial.probes)
    reviewed = review.presenter.story.trial.probes[-1]
    assert reviewed.stability.margin_mm == pytest.approx(trial.probes[-1].stability.margin_mm)


@pytest.mark.promise("W15")
@pytest.mark.slow
def test_approve_then_stop_then_reset(desk, qtbot):
    main, link = desk
    main.workspaces["stack"].page.run.show_form(RunForm(seed=7, trials=1, mode="approve"))
    main.workspaces["stack"].page.run.start.click()
    turn_until(main, link, lambda: link.status().awaiting is not None)
    assert main.bar.pill.state.word == "YOUR TURN"
    probe = link.status().probe
    QTest.keyClick(main.window, Qt.Key.Key_A)
    turn_until(main, link, lambda: link.status().probe > probe and link.hand.pressing_n > 2.0)
    QTest.keyClick(main.window.windowHandle(), Qt.Key.Key_Space)
    assert link.interlock.latched
    turn_until(main, link, lambda: link.status().state is RunState.IDLE)
    assert main.workspaces["stack"].presenter.story.ended.ending == "stopped"
    assert main.bar.pill.state.word == "STOPPED"
    main.cards.card("STOPPED")._act()
    # The piece still presses: no start before it is lifted, and the way out is told.
    turn_until(main, link, lambda: main.bar.pill.state.word == "IN CONTACT")
    assert "jog +Z" in main.bar.pill.state.note
    start = main.workspaces["stack"].page.run.start
    assert not start.isEnabled()
    assert "lift first" in start.toolTip()
    assert "lift first" in main.window._message.text()
    with pytest.raises(RefusedError, match=r"presses with \d\.\d N: lift"):
        link.start(ProbeRequest())
    main.go("operate")
    jog = main.workspaces["operate"].page.jog
    turn_until(main, link, jog.lift.isVisible)
    assert jog.lift.text() == "Lift 5 mm"
    main.stop()
    turn_until(main, link, lambda: jog.lift.text() == "Reset and lift 5 mm")
    offer = main.cards.card("STOPPED").offer
    assert offer.isVisible()
    assert offer.text() == jog.lift.text()
    low_mm = link.devices["arm"].pose(1.0).z_mm
    offer.click()
    turn_until(main, link, lambda: main.bar.pill.state.word == "READY" and not link.hand.active)
    assert link.devices["arm"].pose(1.0).z_mm == pytest.approx(low_mm + 5.0, abs=0.2)
    turn_until(main, link, jog.lift.isHidden)
    assert "mm above the surface" in jog._note.text()
    main.go("stack")
    turn_until(main, link, start.isEnabled)
    assert main.cards.codes == ()
