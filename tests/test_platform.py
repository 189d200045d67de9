"""The canary: does this PySide6 keep reference counts on this CPython, and draw curves?

6.12.0 loses references to True, False and None on CPython below 3.12 until the process aborts;
6.9.1 draws no pyqtgraph curves (pyqtgraph issue 3326).
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

EMITS = """
from PySide6.QtCore import QCoreApplication, QObject, Signal

class Sender(QObject):
    said = Signal()

app = QCoreApplication([])
sender = Sender()
for _ in range(5_000):
    sender.said.emit()
"""


def _child(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=100, check=False
    )


@pytest.mark.skipif(sys.version_info >= (3, 12), reason="these objects are immortal from 3.12 on")
def test_no_reference_to_true_false_none_is_lost():
    done = _child(COUNTS)
    assert done.returncode == 0, done.stderr
    assert max(json.loads(done.stdout).values()) <= 0.3, done.stdout


def test_five_thousand_emits_survive():
    done = _child(EMITS)
    assert done.returncode == 0, done.stderr


def test_a_curve_is_drawn_and_the_view_stays(qtbot):
    import pyqtgraph as pg
    from PySide6.QtGui import QImage

    plot = pg.PlotWidget(background="k")
    qtbot.addWidget(plot)
    plot.resize(400, 300)
    plot.plot(range(100), [(i * 7) % 23 for i in range(100)], pen=pg.mkPen("#ff00ff", width=3))
    with qtbot.waitExposed(plot, timeout=60_000):
        plot.show()
    qtbot.wait(50)  # the axes find their width, which moves the range once
    first = plot.viewRange()
    image = plot.grab().toImage().convertToFormat(QImage.Format.Format_RGB888)
    coloured = sum(
        image.pixelColor(x, y).name() == "#ff00ff"
        for x in range(image.width())
        for y in range(image.height())
    )
    qtbot.wait(50)
    assert coloured >= 100
    assert plot.viewRange() == first
