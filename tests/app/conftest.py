"""The window on the stand-in bench, closed and deleted after each test."""

from pathlib import Path

import pytest

from tests.app.stand_in import StandInBench
from tests.prompt_window import prompt
from touchdown.app.application import TouchdownApp
from touchdown.app.shell.errors import ErrorBox

__all__ = ["prompt"]


@pytest.fixture
def bench():
    return StandInBench()


@pytest.fixture
def main(qapp, qtbot, tmp_path: Path):
    """A window without a bench; its pump is ticked by hand."""
    made = TouchdownApp(qapp, ErrorBox(), tmp_path / "window.json", tmp_path / "runs")
    yield made
    made.close()
    made.window.deleteLater()
    made.deleteLater()


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
    from PySide6.QtWidgets import QApplication

    for _ in range(ticks):
        main.pump.tick()
        QApplication.processEvents()
