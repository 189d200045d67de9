"""The window on the stand-in bench, closed and deleted after each test."""

import time
from contextlib import contextmanager
from pathlib import Path

import pytest
from PySide6.QtCore import QMimeData, QPoint, QPointF, Qt, QUrl
from PySide6.QtGui import QDragEnterEvent, QDropEvent
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication

from tests.app.stand_in import StandInBench
from tests.prompt_window import prompt
from touchdown.app.application import TouchdownApp
from touchdown.app.shell.errors import ErrorBox

__all__ = ["prompt"]


@contextmanager
def opened(folder: Path, bench=None, *, active=False):
    """Open a window with its files in ``folder``; it is closed and deleted afterwards.

    ``active``: shown with the keyboard focus. Its pump is ticked by hand.
    """
    application = QApplication.instance()
    made = TouchdownApp(application, ErrorBox(), folder / "window.json", folder / "runs")
    try:
        if bench is not None:
            made.attach(bench)
        if active:
            made.window.show()
            made.window.activateWindow()
            assert QTest.qWaitForWindowActive(made.window, 60_000)
        yield made
    finally:
        made.close()
        made.window.deleteLater()
        made.deleteLater()
        QApplication.processEvents()


@pytest.fixture
def bench():
    return StandInBench()


@pytest.fixture
def far_east(monkeypatch):
    """A local time of 5:45 h before UTC."""
    with monkeypatch.context() as patch:
        patch.setenv("TZ", "NPT-5:45")
        time.tzset()
        yield
    time.tzset()


@pytest.fixture
def main(qapp, qtbot, tmp_path: Path):
    """A window without a bench; its pump is ticked by hand."""
    with opened(tmp_path) as made:
        yield made


@pytest.fixture
def live(main, bench, qtbot):
    """The window with the stand-in bench attached and shown."""
    main.attach(bench)
    with qtbot.waitActive(main.window, timeout=60_000):
        main.window.show()
        main.window.activateWindow()
    bench.turn(0.2)
    settle(main)
    return main


def settle(main, ticks=12):
    """Turn the pump until everything waiting is shown."""
    for _ in range(ticks):
        main.pump.tick()
        QApplication.processEvents()


def drop(widget, *paths):
    """Drop files on a widget as the window system does; return if they were accepted."""
    data = QMimeData()
    data.setUrls([QUrl.fromLocalFile(str(path)) for path in paths])
    left, none = Qt.MouseButton.LeftButton, Qt.KeyboardModifier.NoModifier
    enter = QDragEnterEvent(QPoint(5, 5), Qt.DropAction.CopyAction, data, left, none)
    enter.ignore()
    QApplication.sendEvent(widget, enter)
    event = QDropEvent(QPointF(5, 5), Qt.DropAction.CopyAction, data, left, none)
    if enter.isAccepted():
        QApplication.sendEvent(widget, event)
    return enter.isAccepted()
