"""A day at the bench by keys and clicks: connect, jog, probe, collect, label, train, stack."""

import pytest
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication

from tests.app.conftest import opened
from tests.backend.bench.brisk import brisk_method
from tests.journeys.operate_desk import SteppedSession, brisk_session
from touchdown.backend.runs.requests import RunState

KEY, CTRL, SHIFT = Qt.Key, Qt.KeyboardModifier.ControlModifier, Qt.KeyboardModifier.ShiftModifier
PROBES = 2
pytestmark = pytest.mark.slow


class Day:
    """One operator at one window."""

    def __init__(self, main, qtbot):
        self.main, self._qtbot = main, qtbot

    def press(self, key, modifiers=Qt.KeyboardModifier.NoModifier):
        QTest.keyClick(self.main.window.windowHandle(), key, modifiers)

    def until(self, done, steps=8000):
        """Let bench time pass until ``done``."""
        session = self.main.bench.session
        for count in range(steps):
            session.engine.tick()
            session.advance()
            if count % 10 == 0:
                self.main.pump.tick()
                QApplication.processEvents()
                if done():
                    return
        told = [self.main.cards.card(code).text.what for code in self.main.cards.codes]
        pytest.fail(f"it did not get there: {session.status()} {told}")

    def wait(self, done):
        """Let the window's threads come to an end."""
        self._qtbot.waitUntil(lambda: self.main.pump.tick() or done(), timeout=120_000)

    def idle(self):
        return self.main.bench.status().state is RunState.IDLE


@pytest.fixture
def day(qapp, qtbot, tmp_path):
    with opened(tmp_path, active=True) as main:
        yield Day(main, qtbot)


def test_an_operators_day(day, tmp_path):
    main, pages = day.main, day.main.workspaces
    connect(day, tmp_path)
    jog_and_probe(day, pages["operate"].page)
    dataset = collect(day, pages["collect"])
    label(day, pages["collect"].label, dataset)
    train(day, pages["train"])
    stack(day, pages["stack"])
    day.press(KEY.Key_5, CTRL)
    review = pages["review"]
    day.wait(lambda: not review.presenter.recordings.describing)
    review.page.runs.choose_row(0)
    day.wait(lambda: not review.presenter.reading)
    assert review.presenter.story.outcomes == pages["stack"].presenter.story.outcomes
    assert main.cards.codes == ()
    day.press(KEY.Key_Q, CTRL)
    if main.window.isVisible():
        # A piece may still be held: then the window asks first.
        assert main.cards._question is not None
        main._stop_and_close()
    assert not main.window.isVisible()


def connect(day, tmp_path):
    day.main.connect_bench(lambda: SteppedSession(brisk_session(tmp_path, brisk_method())))
    day.wait(lambda: day.main.bench is not None)
    day.until(lambda: day.main.bar.pill.state.word == "READY")


def jog_and_probe(day, page):
    day.press(KEY.Key_1, CTRL)
    arm = day.main.bench.devices["arm"]
    before_mm = arm.pose(1.0).z_mm
    for _ in range(4):
        day.press(KEY.Key_BracketRight)
    day.until(page.jog.pads["+z"].isEnabled)
    QTest.mouseClick(page.jog.pads["+z"], Qt.MouseButton.LeftButton)
    day.until(lambda: not day.main.bench.hand.active)
    assert arm.pose(1.0).z_mm == pytest.approx(before_mm + 5.0, abs=0.1)
    day.press(KEY.Key_F5)
    day.until(lambda: day.idle() and "largest Fz" in page.probe.result.text())


def collect(day, workspace):
    day.press(KEY.Key_2, CTRL)
    page = workspace.collect_page
    person = page.target.person
    person.setFocus()
    QTest.keyClicks(person, "Ann")
    QTest.keyClick(person, KEY.Key_Return)
    page.setFocus()
    day.wait(lambda: workspace.presenter.dataset is not None)
    page.target.count.setValue(PROBES)
    page.target.per_grip.setValue(1)
    page.target.ask.setChecked(False)
    day.press(KEY.Key_F5)
    dataset = workspace.presenter.dataset
    day.until(lambda: day.idle() and len(dataset.episodes()) == PROBES)
    day.wait(lambda: not workspace.reader.busy)
    return dataset


def label(day, workspace, dataset):
    day.press(KEY.Key_L, CTRL | SHIFT)
    day.wait(lambda: workspace.presenter is not None and workspace.presenter.walk.begun)
    presenter = workspace.presenter
    for _ in range(PROBES):
        day.press(KEY.Key_Return)
        day.wait(lambda: not presenter.saving.busy and not presenter.editing.waits)
    states = [dataset.labels.head(entry.uuid).state for entry in dataset.episodes()]
    assert states == ["submitted"] * PROBES


def train(day, workspace):
    day.press(KEY.Key_3, CTRL)
    page = workspace.page

    def settled():
        return not workspace._worker.busy

    day.wait(settled)
    page.form.labels.setCurrentIndex(1)
    for name, value in {"hidden": 8, "epochs": 1, "layers": 1, "held_out": 40}.items():
        getattr(page.form, name).setValue(value)
    day.wait(lambda: settled() and page.form.start.isEnabled())
    day.press(KEY.Key_Return, CTRL)
    day.wait(lambda: workspace.presenter.thread is None and settled())
    assert len(page.runs.texts()) == 1


def stack(day, workspace):
    day.press(KEY.Key_4, CTRL)
    workspace.page.run._trials.setValue(1)
    day.press(KEY.Key_Return, CTRL)
    day.until(lambda: workspace.presenter.story.ended is not None)
    assert workspace.presenter.story.ended.ending == "finished"
    assert len(workspace.presenter.story.outcomes) == 1
