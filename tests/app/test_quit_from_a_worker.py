"""Quitting is for the thread of the window: whoever else calls it hangs the program for good."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
LEAVING = re.compile(r"(?<!sys)(?<!parser)\.(quit|exit)\(")
LIMIT_S = 60.0
ASKED = """
import sys, threading
from PySide6.QtCore import QMetaObject, Qt
from PySide6.QtWidgets import QApplication, QWidget
from touchdown.app.shell.cards import exit_after_timeout

app = QApplication([])
window = QWidget()
window.show()

def ask():
    QMetaObject.invokeMethod(app, "quit", Qt.ConnectionType.QueuedConnection)

workers = [threading.Thread(target=ask) for _ in range(8)]
for worker in workers:
    worker.start()
status = app.exec()
for worker in workers:
    worker.join()
# Only now: a thread that hangs must not keep what has ended.
threading.Thread(target=threading.Event().wait).start()
exit_after_timeout(0.1)
sys.exit(2 + status)
"""


@pytest.mark.promise("P5")
def test_no_part_that_runs_on_workers_ends_the_program() -> None:
    found = {
        str(path.relative_to(ROOT))
        for folder in ("backend", "widgets", "app")
        for path in (ROOT / folder).rglob("*.py")
        if LEAVING.search(path.read_text())
    }
    # The window alone, on its own thread.
    assert found == {"app/application.py"}


@pytest.mark.promise("P5")
def test_asked_for_through_the_queue_the_end_comes_whoever_asks_and_whatever_hangs() -> None:
    command = [sys.executable, "-c", ASKED]
    done = subprocess.run(command, cwd=ROOT, timeout=LIMIT_S, check=False)
    assert done.returncode == 1, "ended by force, after the event loop had ended by itself"
