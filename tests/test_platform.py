"""The canary: does this PySide6 keep reference counts on this CPython?

6.12.0 loses references to True, False and None on CPython below 3.12 until the process aborts.
"""

import json
import subprocess
import sys

import pytest

COUNTS = """
import json, sys
from PySide6.QtCore import QObject, Signal
from PySide6.QtWidgets import QApplication, QWidget

spare = [[value] * 200_000 for value in (True, False, None)]  # a loss reports instead of aborting

class Sender(QObject):
    said = Signal()

def emit():
    sender.said.emit()

def join_and_leave():
    sender.said.connect(emit)
    sender.said.disconnect(emit)

def update():
    widget.update()

app = QApplication([])
sender, widget = Sender(), QWidget()
lost = {}
for name, call in (("emit", emit), ("connect", join_and_leave), ("update", update)):
    call()
    before = [sys.getrefcount(value) for value in (True, False, None)]
    for _ in range(300):
        call()
    after = [sys.getrefcount(value) for value in (True, False, None)]
    lost[name] = max(abs(b - a) for a, b in zip(before, after)) / 300
json.dump(lost, sys.stdout)
"""


@pytest.mark.skipif(sys.version_info >= (3, 12), reason="these objects are immortal from 3.12 on")
def test_no_reference_to_true_false_none_is_lost():
    done = subprocess.run(
        [sys.executable, "-c", COUNTS], capture_output=True, text=True, timeout=100, check=False
    )
    assert done.returncode == 0, done.stderr
    assert max(json.loads(done.stdout).values()) <= 0.3, done.stdout
