"""Arrows and Page keys drive the arm while they are armed, whatever has the focus but a text field.

They go where the pads of the chosen frame go: along the axes, about them, or one joint.

Arming ends when the window or the focus is lost, when another page comes to the front, and after
30 s without use.
"""

from __future__ import annotations

from PySide6.QtCore import QEvent, QObject, Qt, QTimer
from PySide6.QtGui import QKeyEvent, QWindow
from PySide6.QtWidgets import QApplication, QWidget

from app.stop_key import typing
from widgets.jog_pad import JOINTS, JogPad

IDLE_MS = 30_000
KEYS: dict[int, str] = {
    Qt.Key.Key_Right: "+x",
    Qt.Key.Key_Left: "-x",
    Qt.Key.Key_Up: "+y",
    Qt.Key.Key_Down: "-y",
    Qt.Key.Key_PageUp: "+z",
    Qt.Key.Key_PageDown: "-z",
}
JOINT_KEYS: dict[int, int] = {int(Qt.Key.Key_1) + joint: joint + 1 for joint in range(JOINTS)}
"""Digits choose the joint that the arrows drive; they move nothing."""
ROWS = (
    ("Left", "Jog \N{MINUS SIGN}X while held (keys armed)"),
    ("Right", "Jog +X while held (keys armed)"),
    ("Up", "Jog +Y while held (keys armed)"),
    ("Down", "Jog \N{MINUS SIGN}Y while held (keys armed)"),
    ("PgUp", "Jog +Z while held (keys armed)"),
    ("PgDown", "Jog \N{MINUS SIGN}Z while held (keys armed)"),
    ("1", "Choose J1 for the arrows, 2 to 6 the others (keys armed, JOINT)"),
)


class JogKeys(QObject):
    """Event filter of the application while armed."""

    def __init__(self, page: QWidget, pad: JogPad) -> None:
        super().__init__(page)
        self._page, self._pad = page, pad
        self._down: set[int] = set()
        self.armed = False
        self._idle = QTimer(self)
        self._idle.setSingleShot(True)
        self._idle.setInterval(IDLE_MS)
        self._idle.timeout.connect(self.disarm)

    def arm(self, on: bool) -> None:
        """Arm or disarm."""
        if on == self.armed:
            return
        application = QApplication.instance()
        assert isinstance(application, QApplication)
        self.armed = on
        self._down.clear()
        if on:
            self._page.setFocus()
            application.installEventFilter(self)
            application.focusChanged.connect(self._focus_changed)
            self._idle.start()
        else:
            application.removeEventFilter(self)
            application.focusChanged.disconnect(self._focus_changed)
            self._idle.stop()
            self._pad.hold.end("the keys were disarmed")
        self._pad.show_armed(on)

    def disarm(self) -> None:
        """Disarm."""
        self.arm(False)

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:
        """Take the jog keys as the window system delivers them."""
        if not isinstance(event, QKeyEvent) or not isinstance(watched, QWindow):
            return False
        joint = self._pad.frame.currentText() == "JOINT" and event.key() in JOINT_KEYS
        if not (joint or event.key() in KEYS) or typing():
            return False
        # Before a press the same key comes as ShortcutOverride: claimed, so that no shortcut takes
        # it, and no press of its own.
        if event.type() is not QEvent.Type.ShortcutOverride and not event.isAutoRepeat():
            self._take(event)
        event.accept()
        return True

    def _take(self, event: QKeyEvent) -> None:
        self._idle.start()
        key = event.key()
        if key in JOINT_KEYS:
            if event.type() is QEvent.Type.KeyPress:
                self._pad.choose_joint(JOINT_KEYS[key])
            return
        if event.type() is QEvent.Type.KeyRelease:
            self._down.discard(key)
            self._pad.hold.release(key)
            return
        alone = not self._down
        self._down.add(key)
        if alone:
            self._pad.press_key(self._page, KEYS[key], key)
        else:
            self._pad.hold.end("a second key was pressed")

    def _focus_changed(self, _old: QWidget | None, now: QWidget | None) -> None:
        if (
            now is None
            or not now.isVisible()
            or now.window() is not self._page.window()
            or typing()
        ):
            self.disarm()
