"""An operator collects: the real window, the real bench and dataset, its clock wound by hand."""

import pytest
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest

from tests.app.conftest import opened, settle
from tests.backend.bench.brisk import brisk_method
from tests.journeys import operate_desk
from tests.journeys.operate_desk import SteppedSession, brisk_session
from touchdown.backend.annotations import Dataset, EpisodeFilter
from touchdown.backend.runs.requests import RunState

KEY = Qt.Key
pytestmark = pytest.mark.slow


@pytest.fixture
def desk(qapp, qtbot, tmp_path, isolated_settings):
    session = brisk_session(tmp_path, brisk_method())
    with opened(tmp_path, SteppedSession(session), active=True) as main:
        press(main, KEY.Key_2, Qt.KeyboardModifier.ControlModifier)
        collect = main.workspaces["collect"]
        person = collect.collect_page.target.person
        person.setFocus()
        QTest.keyClicks(person, "Ann")
        QTest.keyClick(person, KEY.Key_Return)
        collect.collect_page.setFocus()
        qtbot.waitUntil(lambda: collect.presenter.dataset is not None, timeout=60_000)
        yield main, session, collect


def press(main, key, modifiers=Qt.KeyboardModifier.NoModifier):
    QTest.keyClick(main.window.windowHandle(), key, modifiers)


def turn_until(desk, qtbot, done):
    """Let bench time pass until ``done``; results of the reader are waited for."""
    main, session, collect = desk
    operate_desk.turn_until(main, session, done)
    qtbot.waitUntil(lambda: not collect.reader.busy, timeout=60_000)
    settle(main)


def test_collect_discard_and_go_on_after_a_stop(desk, qtbot, isolated_settings):
    main, session, collect = desk
    page, presenter = collect.collect_page, collect.presenter
    page.target.count.setValue(2)

    def asked():
        return page.probe.detail.text() == "waiting for you"

    press(main, KEY.Key_F5)
    turn_until(desk, qtbot, asked)
    dataset = presenter.dataset
    (first,) = dataset.episodes()
    assert first.person == "Ann"
    offset = dataset.labels.head(first.uuid).label.offset_mm
    assert page.distribution.scene.points_mm == pytest.approx(offset[None])
    assert page.coverage.scene.bins.counts.sum() == 1

    press(main, KEY.Key_Backspace)
    turn_until(desk, qtbot, lambda: asked() and len(presenter.probes.harvest) == 2)
    assert dataset.entry(first.uuid).deleted
    assert page.target.bar.value() == 1
    assert len(page.distribution.scene.points_mm) == 1

    # STOP is not held up by the question, and nothing that was recorded is lost.
    press(main, KEY.Key_Space)
    turn_until(desk, qtbot, lambda: session.status().state is RunState.IDLE)
    assert session.interlock.latched
    assert len(dataset.episodes()) == 1
    main.reset()
    turn_until(desk, qtbot, lambda: page.target.go_on.isEnabled())

    press(main, KEY.Key_F5, Qt.KeyboardModifier.ShiftModifier)
    turn_until(desk, qtbot, lambda: asked() and len(presenter.probes.harvest) == 3)
    press(main, KEY.Key_Return)
    turn_until(desk, qtbot, lambda: session.status().state is RunState.IDLE)
    assert page.target.bar.value() == page.target.bar.maximum() == 2
    assert "2 of 2 probes are collected" in page.target.eta.text()
    assert not page.target.go_on.isEnabled()
    kept = dataset.episodes()
    assert sorted(e.plan_item for e in kept) == [0, 1]
    assert page.table.rows()[0].uuid == kept[-1].uuid

    press(main, KEY.Key_F5)
    turn_until(desk, qtbot, lambda: session.status().phase == "press")
    main.close()
    with Dataset.open(isolated_settings / "data" / "dataset", person="Bob") as again:
        assert again.notices == ()
        assert len(again.episodes(EpisodeFilter(deleted=None))) == 3
