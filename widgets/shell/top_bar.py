"""Top bar of the window."""

from __future__ import annotations

from collections.abc import Callable

from PySide6.QtCore import QPointF, QRectF, QSize, Qt, QTimer
from PySide6.QtGui import QColor, QPainter, QPaintEvent, QPen, QPolygonF, QResizeEvent
from PySide6.QtWidgets import QFrame, QPushButton, QSizePolicy, QSpinBox, QVBoxLayout, QWidget

from touchdown.widgets.base import Theme, fit_icon, hbox, icon, label, tr, ui_font, vbox
from touchdown.widgets.shell.devices import DeviceChip
from touchdown.widgets.shell.state import StatePill


class BenchBanner(QWidget):
    """Name of the bench; striped while no hardware moves."""

    def __init__(self, theme: Theme, word: str = "SIMULATED BENCH") -> None:
        super().__init__()
        self._theme, self._word, self._striped = theme, word, True
        self.setSizePolicy(QSizePolicy.Policy.Fixed, QSizePolicy.Policy.Fixed)
        self.show_bench(word, "No hardware is connected. All data are simulated.", True)

    def show_bench(self, word: str, tip: str, striped: bool) -> None:
        """Set name, tool tip and stripes."""
        self._word, self._striped = tr(word), striped
        self.setAccessibleName(f"{self._word}: {tr(tip)}")
        self.setToolTip(tr(tip))
        self.updateGeometry()
        self.update()

    def sizeHint(self) -> QSize:
        """Return room for the name and stripes on both sides."""
        self.setFont(ui_font(self._theme.scale, 0.86, 600))
        metrics = self.fontMetrics()
        return QSize(metrics.horizontalAdvance(self._word) + 84, metrics.height() + 6)

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Draw stripes and name."""
        painter = QPainter(self)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        t = self._theme.tokens
        painter.setFont(ui_font(self._theme.scale, 0.86, 600))
        if not self._striped:
            painter.setPen(QPen(t.colour("border")))
            painter.drawRect(self.rect().adjusted(0, 0, -1, -1))
            painter.setPen(QPen(t.colour("text")))
            painter.drawText(self.rect(), int(Qt.AlignmentFlag.AlignCenter), self._word)
            return
        painter.fillRect(self.rect(), t.colour("pill_yellow"))
        painter.setPen(Qt.PenStyle.NoPen)
        painter.setBrush(t.colour("on_light"))
        height = self.height()
        for x in range(-height, self.width() + height, 14):
            xs = ((x, height), (x + 7, height), (x + 7 + height, 0), (x + height, 0))
            painter.drawPolygon(QPolygonF([QPointF(*corner) for corner in xs]))
        plate = QRectF(30, 2, self.width() - 60, height - 4)
        painter.setBrush(t.colour("pill_yellow"))
        painter.drawRect(plate)
        painter.setPen(QPen(t.colour("on_light")))
        painter.drawText(plate, int(Qt.AlignmentFlag.AlignCenter), self._word)


HELD_MS = 1000
ON_TIP = "Motors on. Press to switch them off; any motion stops."
OFF_TIP = "Motors off. Hold for 1 s to switch them on."


class ServoButton(QPushButton):
    """Button that switches the motors; ``ordered`` gets the requested state."""

    def __init__(self) -> None:
        super().__init__("\N{EN DASH}")
        self.setProperty("role", "compact")
        self.ordered: Callable[[bool], None] = lambda _on: None
        self._on: bool | None = None
        self._held = QTimer(self, singleShot=True, interval=HELD_MS)
        self._held.timeout.connect(self._switch_on)
        self.pressed.connect(self._press)
        self.released.connect(self._held.stop)
        self.show_state(None)
        self.setAccessibleName(tr("Servo: unknown"))

    def show_state(self, on: bool | None, *, busy: bool = False) -> None:
        """Show on, off, or None for unknown."""
        word = "\N{EN DASH}" if on is None else "..." if busy else "on" if on else "off"
        self._on = on
        if self.text() != tr(word) or self.isEnabled() == (on is None or busy):
            self.setText(tr(word))
            self.setEnabled(on is not None and not busy)
            self.setToolTip(tr("" if on is None else ON_TIP if on else OFF_TIP))
            self.setAccessibleName(tr("Servo: {}", tr("unknown" if on is None else word)))
            self.setAccessibleDescription(self.toolTip())

    def _press(self) -> None:
        if self._on:
            self.ordered(False)
        else:
            self._held.start()

    def _switch_on(self) -> None:
        if self.isDown() and self._on is False:
            self.ordered(True)


MARGIN, GAP, CHIP_GAP = 8, 8, 4
OVERRIDE_PAD_PX = 20  # frame and padding beside the figures of the override
OVERRIDE = (10, 100)  # range, %
USUAL_MODE = "Robot: Program"
STOP_TEXTS = "STOP motion (software)", "STOP (software)"  # usual, and where the room ends
DEVICE_CHIPS = (
    ("arm", "Arm"),
    ("gripper", "Gripper"),
    ("force_torque", "F/T"),
    ("tactile_left", "Tactile L"),
    ("tactile_right", "Tactile R"),
)


class TopBar(QFrame):
    """Bar of one row, or two if narrow; ``on_stop`` is called when STOP is pressed down.

    State and STOP are first; where the room ends with them, the modes of the arm are left out.
    """

    def __init__(self, theme: Theme, on_stop: Callable[[], None]) -> None:
        super().__init__()
        self.setProperty("role", "bar")
        self.pill = StatePill(theme)
        self._robot = label("Robot: unknown", "small")
        self._safety = label("Safety: unknown", "small")
        self.chips = {key: DeviceChip(theme, name) for key, name in DEVICE_CHIPS}
        least, most = OVERRIDE
        self.override = QSpinBox(
            minimum=least, maximum=most, value=most, singleStep=10, suffix=" %"
        )
        self.override.setKeyboardTracking(False)
        self.override.setAccessibleName(tr("Speed override"))
        self.override.setToolTip(
            tr(
                "Speed override (OVRD) of all moves in air, by hand and in runs. "
                "The speed of presses is not changed."
            )
        )
        self.override.setProperty("role", "compact")
        self._override_title = label("OVRD", "small")
        self._override_title.setBuddy(self.override)
        self.servo = ServoButton()
        self._servo_title = label("Servo", "small")
        self._servo_title.setBuddy(self.servo)
        self._estop_title = label("HW E-stop", "small")
        self._estop = label("unknown", "small")
        self.stop = QPushButton(tr(STOP_TEXTS[0]))
        self.stop.setProperty("role", "stop")
        self.stop.setIcon(icon("stop", QColor("#FFFFFF")))
        self.stop.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self.stop.setSizePolicy(QSizePolicy.Policy.Fixed, QSizePolicy.Policy.Preferred)
        self.stop.setAccessibleName(tr("STOP motion, software stop"))
        self.stop.setToolTip(
            tr(
                "Stops arm and gripper at once and ends the run; the grip is kept. Keys: F12, or "
                "Space during motion. This is not the robot's emergency stop."
            )
        )
        self.stop.pressed.connect(on_stop)
        self._least_px = 0
        self._arrange()

    def _arrange(self) -> None:
        modes = _two(self._robot, self._safety)
        estop = _two(self._estop_title, self._estop)
        self._modes = QWidget()
        hbox(modes, estop, parent=self._modes, margins=(0, 0, 0, 0), spacing=GAP)
        self._row = hbox(self.pill, self.stop, self._modes, 1, spacing=GAP)
        self._devices = QWidget()
        chips = hbox(*self.chips.values(), parent=self._devices, margins=(0, 0, 0, 0),
                     spacing=CHIP_GAP)  # fmt: skip
        chips.addSpacing(GAP - CHIP_GAP)
        chips.addLayout(_two(self._override_title, self.override))
        chips.addSpacing(GAP - CHIP_GAP)
        chips.addLayout(_two(self._servo_title, self.servo))
        self._row.insertWidget(3, self._devices)
        self._second = hbox()
        rows = vbox(self._row, self._second, parent=self, margins=(MARGIN, 7, MARGIN, 7), spacing=6)
        rows.setSizeConstraint(rows.SizeConstraint.SetNoConstraint)  # ``fit`` leaves out parts
        self._layouts = chips, rows
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Fixed)

    def minimumSizeHint(self) -> QSize:
        """Return the width without the chips, which move to a second row if needed."""
        return QSize(self._least_px, super().minimumSizeHint().height())

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Fit the chips to the width."""
        super().resizeEvent(event)
        self.fit()

    def fit(self) -> None:
        """Show the chips in full, else their names only, else in full on a second row."""
        chips, room = tuple(self.chips.values()), self.width()
        fit_icon(self.stop)
        beside = self.pill.sizeHint().width() + 3 * GAP
        usual, self._least_px = (beside + self._stop_px(tr(text)) for text in STOP_TEXTS)
        self.stop.setText(tr(STOP_TEXTS[usual > room]))
        # Constant width for common modes, so that the chips do not jump when the arm starts.
        self._robot.setMinimumWidth(self._robot.fontMetrics().horizontalAdvance(tr(USUAL_MODE)))
        figures = self.override.fontMetrics().horizontalAdvance("100 %")
        self.override.setFixedWidth(figures + OVERRIDE_PAD_PX)
        for short in (False, True):
            for chip in chips:
                chip.show_short(short)
            one_row = self._needed(chips) <= room
            if one_row:
                break
        else:
            for chip in chips:
                chip.show_short(False)
                chip.show_short(self._devices_px(chips) + 2 * MARGIN > room)
        if one_row and self._second.count():
            self._second.removeWidget(self._devices)
            self._second.takeAt(0)
            self._row.insertWidget(3, self._devices)
        elif not one_row and not self._second.count():
            self._row.removeWidget(self._devices)
            self._second.addWidget(self._devices)
            self._second.addStretch(1)
        self._modes.setVisible(self._needed(()) <= room)
        for layout in self._layouts:
            layout.activate()  # else figures are elided until the next event
        self.updateGeometry()

    def _stop_px(self, text: str) -> int:
        advance = self.stop.fontMetrics().horizontalAdvance
        return self.stop.sizeHint().width() + advance(text) - advance(self.stop.text())

    def _needed(self, chips: tuple[DeviceChip, ...]) -> int:
        modes = max(self._robot.sizeHint().width(), self._safety.sizeHint().width())
        estop = max(self._estop_title.sizeHint().width(), self._estop.sizeHint().width())
        fixed = self.pill.sizeHint().width() + modes + estop + self.stop.sizeHint().width()
        return fixed + (self._devices_px(chips) if chips else 0) + 5 * GAP + 2 * MARGIN

    def _devices_px(self, chips: tuple[DeviceChip, ...]) -> int:
        override = max(self._override_title.sizeHint().width(), self.override.width())
        servo = max(self._servo_title.sizeHint().width(), self.servo.sizeHint().width())
        return override + servo + 2 * GAP + sum(c.sizeHint().width() + CHIP_GAP for c in chips)

    def show_modes(self, robot: str, safety: str) -> None:
        """Show robot mode and safety mode of the arm."""
        texts = (tr("Robot: {}", robot), tr("Safety: {}", safety))
        if texts != (self._robot.text(), self._safety.text()):
            self._robot.setText(texts[0])
            self._safety.setText(texts[1])
            self.fit()

    def show_hardware_stop(self, text: str) -> None:
        """Show the hardware emergency stop as reported by the controller, or "unknown"."""
        text = tr(text)
        if text == self._estop.text():
            return
        self._estop.setText(text)
        self._estop.setAccessibleName(tr("Hardware emergency stop: {}", text))
        self.fit()


def _two(upper: QWidget, lower: QWidget) -> QVBoxLayout:
    return vbox(1, upper, lower, 1, spacing=0)
