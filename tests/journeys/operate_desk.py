"""The real window on the real simulated bench, whose time the test turns."""

import pytest
from PySide6.QtCore import QEvent, Qt
from PySide6.QtGui import QKeyEvent
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication

from tests.app.conftest import opened, settle
from tests.backend.bench.brisk import brisk_bench
from touchdown.backend.bench.assembly import simulated_session
from touchdown.backend.core.values import Pose
from touchdown.backend.runs import RecordingOptions, SceneChoice

STEP_S = 0.02


def brisk_session(folder, method=None):
    """Return a simulated bench with its first scene, whose runs are kept without episodes."""
    keep = RecordingOptions(folder / "runs", episodes=False)
    session = simulated_session(brisk_bench(), keep=keep, method=method)
    session.prepare(SceneChoice())
    return session


class SteppedSession:
    """A session whose time the test turns; everything else is the session itself."""

    def __init__(self, session):
        object.__setattr__(self, "session", session)

    def __getattr__(self, name):
        return getattr(self.session, name)

    def __setattr__(self, name, value):
        setattr(self.session, name, value)

    def open(self):
        """No thread."""

    def step(self):
        self.session.engine.tick()
        self.session.advance()


@pytest.fixture
def desk(qapp, qtbot, tmp_path):
    session = brisk_session(tmp_path)
    motion = session._stage.arm.move_to(Pose(0.0, 0.0, 80.0), 50.0)
    while not motion.done:
        session.advance()
    with opened(tmp_path, SteppedSession(session)) as main:
        main.go("operate")
        main.window.show()
        main.window.activateWindow()
        assert QTest.qWaitForWindowActive(main.window, 60_000)
        turn(main, session, 0.1)
        yield main, session


def turn(main, session, seconds, held=False):
    """Let bench time pass; a held button beats every 100 ms of it."""
    hold = main.workspaces["operate"].page.jog.hold
    hold._timer.stop()
    for count in range(round(seconds / STEP_S)):
        if held and count % 5 == 4:
            hold._beat()
        session.engine.tick()
        session.advance()
        if count % 2:
            main.pump.tick()
    for _ in range(12):
        main.pump.tick()


def turn_until(main, session, done, steps=20_000, every=20):
    """Let bench time pass until ``done``, which is looked at after so many steps."""
    for count in range(steps):
        session.engine.tick()
        session.advance()
        if count % every == 0:
            main.pump.tick()
            QApplication.processEvents()
            if done():
                settle(main)
                return
    told = [main.cards.card(code).text for code in main.cards.codes]
    pytest.fail(f"it did not get there: {session.status()} {told}")


def place(session):
    return session._stage.arm._world.drive.command_mm


def window_key(main, kind, key, repeat=False):
    event = QKeyEvent(kind, key, Qt.KeyboardModifier.NoModifier, autorep=repeat)
    QApplication.sendEvent(main.window.windowHandle(), event)


def press(main, key, repeat=False):
    window_key(main, QEvent.Type.KeyPress, key, repeat)


def release(main, key):
    window_key(main, QEvent.Type.KeyRelease, key)
