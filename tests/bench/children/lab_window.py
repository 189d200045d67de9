"""Child that works a real window on the devices of a lab file as its operator would.

``python -m tests.bench.children.lab_window LAB NOTE``: each line of its input, ``SPEED WAY``, is
one jog that ends in that way; it prints ``going`` when the arm moves and the fault begins. NOTE is
a file with the time of the lease's last renewal, which outlives this process.
"""

import mmap
import struct
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

from PySide6.QtCore import QPoint, Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QMessageBox, QWidget

from tests.bench.children.failing_window import Watched, say
from tests.busy_computer import STARVED
from touchdown.app.operate.workspace import OperateWorkspace
from touchdown.app.start import open_bench, tune_interpreter
from touchdown.backend.bench.session import Session
from touchdown.backend.devices.jog import JogOrder

CLEAR_MM, SPEED_MM_S = 60.0, 20.0
GOING_S, FROZEN_S, PATIENCE_S = 0.35, 3.0, 120.0
AFTER_S = 0.3  # pause before the query; the arm stores its last second
NOTE = struct.Struct("<d")


class Note:
    """One number in a file that outlives whoever wrote it."""

    def __init__(self, path: Path) -> None:
        if not path.exists():
            path.write_bytes(bytes(NOTE.size))
        with path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), NOTE.size)

    def write(self, number: float) -> None:
        NOTE.pack_into(self._memory, 0, number)

    def read(self) -> float:
        return float(NOTE.unpack_from(self._memory, 0)[0])


class LabWindow(Watched):
    """``session``: its bench, whose devices are connected by ``ready``."""

    def __init__(self, folder: Path, lab: Path) -> None:
        super().__init__(folder)
        link = open_bench(lab)
        assert isinstance(link, Session)
        self.session = link
        self.main.attach(link)
        link.interlock.override_speed(1.0)
        self.main.go("operate")
        # As after a while: no page is still being made.
        pages = self.main.workspaces
        self.pump(lambda: not pages.prepare())

    @property
    def operate(self) -> OperateWorkspace:
        found = self.main.workspaces["operate"]
        assert isinstance(found, OperateWorkspace)
        return found

    def ready(self) -> None:
        """Have the bench ready, whatever its wires did: reset and connect as the cards say."""
        session, connection = self.session, self.session.connection
        assert connection is not None
        end_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < end_s:
            self.pump(lambda: not connection.busy)
            if connection.ready and not session.interlock.latched and session.hand is not None:
                return
            codes = {fault.code for fault in session.interlock.faults}
            assert codes <= STARVED, codes
            self.main.reset()
            if not connection.ready and not connection.busy:
                connection.begin()
            self.linger(0.1)
        raise TimeoutError(f"the bench does not become ready: {connection.lines()}")

    def linger(self, for_s: float) -> None:
        end_s = time.monotonic() + for_s
        self.pump(lambda: time.monotonic() >= end_s)

    def press(self, what: str, speed_mm_s: float) -> QWidget:
        """Press a pad and keep it down; a panel over the window is closed first."""
        jog, panels = self.operate.page.jog, self.main.panels
        assert panels is not None
        panels.connect.sheet.hide()
        self.main.window.activateWindow()
        self.pump(self.main.window.isActiveWindow)
        pad = jog.pads[what]
        jog.speed.setValue(speed_mm_s)
        self.pump(lambda: pad.isEnabled() or self.session.interlock.latched)
        QTest.mousePress(pad, Qt.MouseButton.LeftButton)
        return pad

    def release(self, pad: QWidget) -> None:
        QTest.mouseRelease(pad, Qt.MouseButton.LeftButton)

    def rise(self) -> None:
        """Jog up until the arm is clear of the zone where it is slow."""
        end_s = time.monotonic() + PATIENCE_S
        while not self._at_mm(2) >= CLEAR_MM:
            assert time.monotonic() < end_s, "the arm does not rise"
            self.ready()
            pad = self.press("+z", SPEED_MM_S)
            self.linger(1.0)
            self.release(pad)

    def along(self) -> str:
        """Return the way along X that leads to the middle."""
        return "-x" if self._at_mm(0) > 0.0 else "+x"

    def _at_mm(self, axis: int) -> float:
        """Return one coordinate of the newest place of the arm; NaN before the first."""
        poses = self.session.raw.poses
        values = poses.since(poses.count - 1).values
        return float(values[-1, axis]) if len(values) else float("nan")

    def note_renewals(self, note: Note) -> None:
        """Let ``note`` hold when the jog lease was last renewed (monotonic)."""
        hand = self.session.hand
        assert hand is not None
        renew = hand.jog.renew

        def noted(order: JogOrder) -> None:
            now_s = time.monotonic()
            renew(order)
            note.write(now_s)

        hand.jog.renew = noted  # type: ignore[method-assign]


def _compute(_: LabWindow, __: QWidget) -> None:
    end_s = time.monotonic() + FROZEN_S
    while time.monotonic() < end_s:
        pass


def _other_window(window: LabWindow, _: QWidget) -> None:
    other = QWidget()
    other.show()
    other.activateWindow()
    window.linger(0.3)
    other.close()
    window.main.window.activateWindow()


def _dialog(window: LabWindow, _: QWidget) -> None:
    box = QMessageBox(QMessageBox.Icon.NoIcon, "t", "text", parent=window.main.window)
    box.open()
    window.linger(0.3)
    box.close()
    window.main.window.activateWindow()


def _page(window: LabWindow, _: QWidget) -> None:
    window.main.go("train")
    window.linger(0.3)
    window.main.go("operate")


def _minimised(window: LabWindow, _: QWidget) -> None:
    window.main.window.showMinimized()
    window.linger(0.3)
    window.main.window.showNormal()
    window.main.window.activateWindow()


def _hidden(window: LabWindow, pad: QWidget) -> None:
    pad.hide()
    window.linger(0.3)
    pad.show()


def _focus(window: LabWindow, _: QWidget) -> None:
    jog = window.operate.page.jog
    (jog.frame if jog.speed.hasFocus() else jog.speed).setFocus()


Way = Callable[[LabWindow, QWidget], object]
STALLS: dict[str, Way] = {
    "sleeps": lambda window, pad: threading.Event().wait(FROZEN_S),
    "computes": _compute,
}
# ways in which a held pad can lose its operator
LOSSES: dict[str, Way] = {
    "focus moved": _focus, "other window": _other_window, "dialog": _dialog, "other page": _page,
    "minimised": _minimised, "pad hidden": _hidden,
    "another key": lambda window, pad: QTest.keyClick(window.main.window, Qt.Key.Key_A),
    "pointer left": lambda window, pad: QTest.mouseMove(
        pad, QPoint(pad.width() + 200, pad.height() + 200)
    ),
    "released": lambda window, pad: window.release(pad),
}  # fmt: skip
# "nothing": it is this process that something happens to
WAYS = STALLS | LOSSES | {"nothing": lambda window, pad: window.linger(1.0)}


def jog(window: LabWindow, speed_mm_s: float, way: str) -> None:
    end_s, held = time.monotonic() + PATIENCE_S, False
    while not held:
        assert time.monotonic() < end_s, f"no jog goes on: {window.main.cards.codes}"
        window.ready()
        pad = window.press(window.along(), speed_mm_s)
        window.linger(GOING_S)
        held = window.operate.page.jog.hold.held
        if not held:
            window.release(pad)
    say("going")
    WAYS[way](window, pad)
    window.linger(AFTER_S)
    window.release(pad)
    say("over")


def main(lab: Path, note: Path) -> None:
    tune_interpreter()
    orders: list[str] = []
    over = threading.Event()

    def listen() -> None:
        for line in sys.stdin:
            orders.append(line)
        over.set()

    with tempfile.TemporaryDirectory() as name:
        window = LabWindow(Path(name), lab)
        window.ready()
        window.rise()
        window.note_renewals(Note(note))
        threading.Thread(target=listen, daemon=True).start()
        say("ready")
        while not over.is_set() or orders:
            if orders:
                speed, way = orders.pop(0).strip().split(" ", 1)
                jog(window, float(speed), way)
            else:
                window.linger(0.02)
        window.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
