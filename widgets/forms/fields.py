"""Fields of forms: numbers with units, buttons that act after a hold."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from PySide6.QtCore import QEvent, QObject, QPoint, QPointF, QSignalBlocker, Qt, QTimer
from PySide6.QtGui import QGuiApplication, QKeyEvent, QMouseEvent, QTouchEvent, QWindow
from PySide6.QtWidgets import (
    QAbstractButton,
    QApplication,
    QCheckBox,
    QComboBox,
    QDoubleSpinBox,
    QGridLayout,
    QLabel,
    QPushButton,
    QSizePolicy,
    QSpinBox,
    QToolTip,
    QWidget,
)

from touchdown.widgets.base import Theme, describe, fit_icon, icon, label, set_property, tr

INSET_PX = 6
Field = QCheckBox | QComboBox | QDoubleSpinBox | QSpinBox
# title, field, tool tip; accessible name, if it is not the title
TitledField = tuple[str, QWidget, str] | tuple[str, QWidget, str, str]


def field_label(text: str, field: QWidget) -> QLabel:
    """Return the muted label of a field."""
    made = label(text, "muted")
    made.setBuddy(field)
    return made


NumberBox = QSpinBox | QDoubleSpinBox


def inset_spin_boxes(*boxes: NumberBox) -> None:
    """Inset the figures of spin boxes, and refuse wrong numbers visibly.

    Style-sheet padding does not reach the figures. A typed number that the box cannot hold leaves
    the former one, with a frame around it and the allowed range beside it.
    """
    for box in boxes:
        box.lineEdit().setTextMargins(INSET_PX, 0, 0, 0)
        _RefusedEntry(box)


class _RefusedEntry(QObject):
    """Keeps the value of a spin box, and says so, while it cannot hold what is typed."""

    def __init__(self, box: NumberBox) -> None:
        super().__init__(box)
        self._box, self._typed, self._before = box, "", box.value()
        # The validator would drop single letters: "-5e9" would become a wrong number.
        box.lineEdit().setValidator(None)  # type: ignore[arg-type]
        box.lineEdit().textEdited.connect(self._edit)
        box.editingFinished.connect(self._finish)
        box.valueChanged.connect(self._accept)

    def _edit(self, typed: str) -> None:
        box, edit = self._box, self._box.lineEdit()
        if not self._typed:
            self._before = box.value()
        self._typed = typed or " "
        wrong = self._is_wrong()
        if wrong and box.value() != self._before:
            at = edit.cursorPosition()
            box.setValue(self._before)  # type: ignore[arg-type]
            with QSignalBlocker(edit):
                edit.setText(typed)
                edit.setCursorPosition(at)
        set_property(box, "refused", "yes" if wrong else "no")

    def _accept(self) -> None:
        if not self._typed:  # an arrow or another form gave a number that fits
            set_property(self._box, "refused", "no")

    def _finish(self) -> None:
        if self._typed and self._is_wrong():
            box = self._box
            place, words = box.mapToGlobal(box.rect().bottomLeft()), self._words()
            QTimer.singleShot(0, box, lambda: QToolTip.showText(place, words, box))
        self._typed = ""

    @property
    def _decimals(self) -> int:
        return self._box.decimals() if isinstance(self._box, QDoubleSpinBox) else 0

    def _is_wrong(self) -> bool:
        box = self._box
        figures = self._typed.removeprefix(box.prefix()).removesuffix(box.suffix()).strip()
        number, is_number = box.locale().toDouble(figures)
        if box.specialValueText() and self._typed.strip() == box.specialValueText():
            return False
        fits = box.minimum() <= number <= box.maximum() and number == round(number, self._decimals)
        return not (is_number and fits)

    def _words(self) -> str:
        box = self._box
        low, high = (f"{value:.{self._decimals}f}" for value in (box.minimum(), box.maximum()))
        return tr(
            "{} is refused: {} to {}{} is allowed.", self._typed.strip(), low, high, box.suffix()
        )


def let_shrink(*combos: QComboBox, letters: int = 8) -> None:
    """Let combo boxes be narrower than their longest entry."""
    for combo in combos:
        combo.setMinimumContentsLength(letters)
        combo.setSizeAdjustPolicy(QComboBox.SizeAdjustPolicy.AdjustToMinimumContentsLengthWithIcon)


def set_entries(
    combo: QComboBox, entries: Iterable[tuple[str, str]], chosen: str | None = None
) -> None:
    """Replace the (key, title) entries of a combo box; select ``chosen``, else the first."""
    combo.clear()
    for key, title in entries:
        combo.addItem(tr(title), key)
    if chosen is not None and combo.count():
        combo.setCurrentIndex(max(combo.findData(chosen), 0))


def whole_box(low: int, high: int, auto: str = "") -> QSpinBox:
    """Return a spin box for whole numbers; ``auto`` is the text of the lowest one."""
    box = QSpinBox()
    box.setRange(low, high)
    box.setSpecialValueText(tr(auto))
    return box


def decimal_box(low: float, high: float, decimals: int = 2, step: float = 1.0) -> QDoubleSpinBox:
    """Return a spin box for decimal numbers."""
    return QDoubleSpinBox(decimals=decimals, minimum=low, maximum=high, singleStep=step)


class FormFields(QGridLayout):
    """Grid of the fields of a form. Each field holds the attribute of a dataclass with its name.

    A row has one wide field or two halves.
    """

    def __init__(self, horizontal_px: int, vertical_px: int, **fields: Field) -> None:
        super().__init__()
        self.setHorizontalSpacing(horizontal_px)
        self.setVerticalSpacing(vertical_px)
        self.setColumnStretch(1, 1)
        self.setColumnStretch(3, 1)
        self._fields = fields
        for field in fields.values():
            if isinstance(field, QComboBox):
                let_shrink(field)
            elif isinstance(field, NumberBox):
                inset_spin_boxes(field)
            if not isinstance(field, QCheckBox):
                field.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)

    def add_wide(self, row: int, *fields: TitledField) -> None:
        """Add a field a row from ``row`` on."""
        for at, (title, field, tip, *name) in enumerate(fields, start=row):
            describe((field, name[0] if name else title, tip))
            self.addWidget(field_label(title, field), at, 0)
            self.addWidget(field, at, 1, 1, 3)

    def add_halves(self, row: int, *fields: TitledField) -> list[QLabel]:
        """Add two fields a row from ``row`` on; return their labels."""
        titles = []
        for at, (title, field, tip, *name) in enumerate(fields):
            describe((field, name[0] if name else title, tip))
            titles.append(field_label(title, field))
            self.addWidget(titles[-1], row + at // 2, 2 * (at % 2))
            self.addWidget(field, row + at // 2, 2 * (at % 2) + 1)
        return titles

    def fill(self, form: object) -> None:
        """Show the attributes of ``form``; unknown entries of combo boxes change nothing."""
        for name, field in self._fields.items():
            value = getattr(form, name)
            if isinstance(field, QComboBox):
                index = field.findData(value)
                if index >= 0:
                    field.setCurrentIndex(index)
            elif isinstance(field, QCheckBox):
                field.setChecked(value)
            else:
                field.setValue(value)

    def read(self) -> dict[str, Any]:
        """Return the values by name, without empty combo boxes."""
        values: dict[str, Any] = {}
        for name, field in self._fields.items():
            if isinstance(field, QComboBox):
                values[name] = field.currentData()
            else:
                values[name] = field.isChecked() if isinstance(field, QCheckBox) else field.value()
        return {name: value for name, value in values.items() if value is not None}

    def set_enabled(self, enabled: bool) -> None:
        """Enable or disable every field."""
        for field in self._fields.values():
            field.setEnabled(enabled)


def draw_run_icons(theme: Theme, start: QAbstractButton, *others: QAbstractButton) -> None:
    """Draw the icons of Start and, if given, Pause or Resume and Cancel in the theme's colours."""
    tokens, ground = theme.tokens, "panel" if start.property("role") == "primary" else "text"
    start.setIcon(icon("play", tokens.colour(ground if start.isEnabled() else "disabled")))
    for button, name in zip(others, ("pause", "cancel"), strict=False):
        name = "play" if button.text() == tr("Resume") else name
        button.setIcon(icon(name, tokens.colour("text" if button.isEnabled() else "disabled")))
    fit_icon(start, *others)


RENEW_MS = 50  # half a lease period: a window late by one beat does not stop the arm
SLACK_PX = 20  # distance the pointer may leave the button
LEAST_PX = 44
MOUSE, TOUCH = -1, -2  # sources of a hold; positive numbers are key codes
_LOST = frozenset({QEvent.Type.Hide, QEvent.Type.Close, QEvent.Type.UngrabMouse,
                   QEvent.Type.TouchCancel})  # fmt: skip
_WINDOW_LOST = frozenset({QEvent.Type.WindowDeactivate, QEvent.Type.WindowBlocked,
                          QEvent.Type.Close, QEvent.Type.Hide})  # fmt: skip


class HoldState(QObject):
    """Hold shared by the buttons and keys of one pad; at most one at a time.

    ``renew`` is called at once and every 50 ms with the held action; False ends the hold. ``ended``
    is called once with the cause.
    """

    def __init__(
        self, parent: QWidget, renew: Callable[[str], bool], ended: Callable[[str], None]
    ) -> None:
        super().__init__(parent)
        self._renew, self._ended = renew, ended
        self.what = ""
        self._source = 0
        self._widget: QWidget | None = None
        self._timer = QTimer(self, timerType=Qt.TimerType.PreciseTimer, interval=RENEW_MS)
        self._timer.timeout.connect(self._beat)
        parent.destroyed.connect(self._timer.stop)

    @property
    def held(self) -> bool:
        """True while something is held."""
        return self._widget is not None

    def press(self, widget: QWidget, what: str, source: int) -> None:
        """Start a hold of ``what`` on ``widget``; a second hold ends both."""
        if self.held:
            self.end("a second one was pressed")
            return
        window = widget.window()
        if not (widget.isEnabled() and widget.isVisible() and window.isActiveWindow()):
            return
        self._widget, self.what, self._source = widget, what, source
        self._watch()
        if not self._renew(what):
            self.end("refused")
            return
        if self.held:
            self._timer.start()
            self._look(down=True)

    def release(self, source: int) -> None:
        """End the hold if it was started by ``source``."""
        if self.held and source == self._source:
            self.end("released")

    def end(self, cause: str) -> None:
        """End the hold; may be called repeatedly."""
        if not self.held:
            return
        self._look(down=False)
        self._timer.stop()
        application = QApplication.instance()
        if application is not None:
            application.removeEventFilter(self)
        self._widget = None
        self._ended(cause)

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:
        """End the hold when the button, its window or the program loses the operator."""
        widget, kind = self._widget, event.type()
        if widget is None:
            return False
        if watched is widget and kind in _LOST:
            self.end("the button was lost")
        elif watched is widget and kind is QEvent.Type.EnabledChange and not widget.isEnabled():
            self.end("switched off")
        elif watched is widget.window() and kind in _WINDOW_LOST:
            self.end("the window was lost")
        elif kind is QEvent.Type.ApplicationDeactivate:
            self.end("another program is active")
        elif isinstance(event, QKeyEvent):
            self._key(event, at_window=isinstance(watched, QWindow))
        return False

    def _key(self, event: QKeyEvent, *, at_window: bool) -> None:
        if event.isAutoRepeat():
            return
        if event.type() is QEvent.Type.KeyRelease:
            self.release(event.key())
        elif (
            # A key press addressed to the window can be STOP; let it through.
            event.type() is QEvent.Type.KeyPress and not at_window and event.key() != self._source
        ):
            self.end("another key was pressed")

    def _watch(self) -> None:
        application = QApplication.instance()
        assert isinstance(application, QApplication)
        application.installEventFilter(self)
        application.applicationStateChanged.connect(
            self._state_changed, Qt.ConnectionType.UniqueConnection
        )
        application.focusChanged.connect(self._focus_changed, Qt.ConnectionType.UniqueConnection)

    def _state_changed(self, state: Qt.ApplicationState) -> None:
        if state is not Qt.ApplicationState.ApplicationActive:
            self.end("another program is active")

    def _focus_changed(self, _old: QWidget | None, _new: QWidget | None) -> None:
        self.end("the focus moved")

    def _beat(self) -> None:
        if QGuiApplication.applicationState() is not Qt.ApplicationState.ApplicationActive:
            self.end("another program is active")
        elif self.held and not self._renew(self.what):
            self.end("refused")

    def _look(self, *, down: bool) -> None:
        if isinstance(self._widget, HoldButton):
            self._widget.setDown(down)


class HoldButton(QPushButton):
    """Button that starts and ends a hold; takes no focus, so that Space cannot press it."""

    def __init__(
        self,
        text: str,
        what: str,
        name: str,
        hold: HoldState,
        step: Callable[[str], bool] = lambda _: False,
    ) -> None:
        """``step`` handles a press in place of a hold; it returns False to let the hold start."""
        super().__init__(tr(text))
        self._what, self._hold, self._step = what, hold, step
        self.setProperty("role", "hold")
        self.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self.setMinimumSize(LEAST_PX, LEAST_PX)
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Expanding)
        self.setAttribute(Qt.WidgetAttribute.WA_AcceptTouchEvents)
        describe((self, name, name))

    def begin(self, source: int) -> None:
        """Step, or start the hold."""
        if not self._step(self._what):
            self._hold.press(self, self._what, source)

    def event(self, event: QEvent) -> bool:
        """Handle touches like the mouse."""
        kind = event.type()
        if isinstance(event, QTouchEvent):
            if kind is QEvent.Type.TouchBegin:
                self.begin(TOUCH)
            elif kind is QEvent.Type.TouchUpdate:
                self._follow(event.points()[0].position())
            elif kind in (QEvent.Type.TouchEnd, QEvent.Type.TouchCancel):
                self._hold.release(TOUCH)
            event.accept()
            return True
        return super().event(event)

    def mousePressEvent(self, event: QMouseEvent) -> None:
        """Start the hold."""
        if event.button() is Qt.MouseButton.LeftButton:
            self.begin(MOUSE)

    def mouseMoveEvent(self, event: QMouseEvent) -> None:
        """End the hold when the pointer leaves by more than the slack."""
        self._follow(event.position())

    def mouseReleaseEvent(self, event: QMouseEvent) -> None:
        """End the hold."""
        if event.button() is Qt.MouseButton.LeftButton:
            self._hold.release(MOUSE)

    def mouseDoubleClickEvent(self, event: QMouseEvent) -> None:
        """Handle the second press of a double click like any other."""
        self.mousePressEvent(event)

    def _follow(self, at: QPointF) -> None:
        reach = self.rect().adjusted(-SLACK_PX, -SLACK_PX, SLACK_PX, SLACK_PX)
        if self._hold.held and not reach.contains(QPoint(round(at.x()), round(at.y()))):
            self._hold.end("the pointer left the button")
