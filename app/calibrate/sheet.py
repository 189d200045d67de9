"""Sheet of the calibration panel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from PySide6.QtCore import QRectF, QSize, Qt, Signal
from PySide6.QtGui import QPainter, QPaintEvent, QPen
from PySide6.QtWidgets import (
    QButtonGroup,
    QCheckBox,
    QComboBox,
    QDoubleSpinBox,
    QFrame,
    QGridLayout,
    QHBoxLayout,
    QProgressBar,
    QPushButton,
    QScrollArea,
    QSizePolicy,
    QVBoxLayout,
    QWidget,
)

from touchdown.app.shell import BenchSheet, QuestionRow
from touchdown.backend.calibration import CalibrationName
from touchdown.backend.core import FINGERS, Finger
from touchdown.backend.runs import CalibrateRequest
from touchdown.widgets.base import CaptionedView, Theme, hbox, label, set_property, ui_font, vbox
from touchdown.widgets.forms import inset_spin_boxes
from touchdown.widgets.plots import draw_message
from touchdown.widgets.views import MIN_SIZE, TactileView

MOST_BARS = 126


class ResidualBars(QWidget):
    """Bar chart of residuals; the dashed line is the limit of the checked figure."""

    def __init__(self, theme: Theme) -> None:
        super().__init__()
        self._theme = theme
        self._sizes: tuple[float, ...] = ()
        self._limit, self._unit, self._counts = 1.0, "", ""
        self.empty = ""
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Expanding)
        self.setAccessibleName("Residuals")

    def sizeHint(self) -> QSize:
        """Return the preferred size."""
        em = round(10 * self._theme.scale)
        return QSize(36 * em, 11 * em)

    def minimumSizeHint(self) -> QSize:
        """Return the smallest size in which bars can be distinguished."""
        return QSize(200, 80)

    def show_residuals(
        self, residuals: Sequence[float], limit: float, unit: str, counts: str
    ) -> None:
        """Show the magnitudes of ``residuals``; the limit applies to ``counts``."""
        self._sizes = tuple(abs(value) for value in residuals[:MOST_BARS])
        self._limit, self._unit, self._counts = limit, unit, counts
        largest = max(self._sizes, default=0.0)
        self.setAccessibleDescription(f"largest {largest:.3g} {unit}, limit {limit:g} {unit}")
        self.update()

    def show_empty(self, text: str) -> None:
        """Show ``text`` while there is nothing to draw."""
        if text != self.empty:
            self.empty = text
            if not self._sizes:
                self.setAccessibleDescription(text)
            self.update()

    def paintEvent(self, event: QPaintEvent) -> None:
        """Draw the bars."""
        painter = QPainter(self)
        try:
            painter.fillRect(self.rect(), self._theme.tokens.colour("bg"))
            painter.setFont(ui_font(self._theme.scale, 0.85))
            if not self._sizes:
                draw_message(
                    painter, self.rect(), self._theme, "Not measured since the start", self.empty
                )
                return
            self._draw(painter)
        finally:
            painter.end()

    def _draw(self, painter: QPainter) -> None:
        tokens, metrics = self._theme.tokens, painter.fontMetrics()
        line = metrics.height()
        area = QRectF(self.rect()).adjusted(8, line + 6, -8, -(line + 6))
        top = 1.15 * max(self._limit, *self._sizes)
        step = area.width() / len(self._sizes)
        for index, size in enumerate(self._sizes):
            high = area.height() * size / top
            bar = QRectF(
                area.left() + index * step + 0.12 * step, area.bottom() - high, 0.76 * step, high
            )
            beyond = self._counts == "largest" and size > self._limit
            painter.fillRect(bar, tokens.colour("bad" if beyond else "axis_x"))
        y = area.bottom() - area.height() * self._limit / top
        painter.setPen(QPen(tokens.colour("text"), 1.5, Qt.PenStyle.DashLine))
        painter.drawLine(area.left(), y, area.right(), y)  # type: ignore[call-overload]
        painter.setPen(tokens.colour("muted"))
        painter.drawLine(area.bottomLeft(), area.bottomRight())
        painter.drawText(8, line, f"limit of the {self._counts}: {self._limit:g} {self._unit}")
        painter.drawText(8, self.height() - 5, f"{len(self._sizes)} residuals")


REACH_MM = 200.0


class PlaceForm(QWidget):
    """Fields of a ``CalibrateRequest``."""

    def __init__(
        self, pieces: Sequence[str], bottoms: Sequence[str], usual: CalibrateRequest
    ) -> None:
        super().__init__()
        self.piece, self.bottom = QComboBox(), QComboBox()
        for box, names, name in (
            (self.piece, pieces, usual.piece), (self.bottom, bottoms, usual.bottom),
        ):  # fmt: skip
            box.addItems(list(names))
            box.setCurrentText(name)
        self.x_mm, self.y_mm, self.pitch_mm = (QDoubleSpinBox() for _ in range(3))
        for spin in (self.x_mm, self.y_mm):
            spin.setRange(-REACH_MM, REACH_MM)
        self.pitch_mm.setRange(0.5, 5.0)
        self.pitch_mm.setValue(usual.pitch_mm)
        for spin in (self.x_mm, self.y_mm, self.pitch_mm):
            spin.setDecimals(2)
            spin.setSuffix(" mm")
            inset_spin_boxes(spin)
        self.hand_over = QCheckBox("Hand the piece over (no jig)")
        first, second = QHBoxLayout(), QHBoxLayout()
        self._titles: dict[QWidget, QWidget] = {}
        for row, text, field in (
            (first, "Piece", self.piece),
            (first, "Bottom", self.bottom),
            (first, "Pitch of the dots", self.pitch_mm),
            (second, "Origin x", self.x_mm),
            (second, "y", self.y_mm),
        ):
            title = label(text, "muted")
            title.setBuddy(field)
            self._titles[field] = title
            field.setAccessibleName(text)
            row.addWidget(title)
            row.addWidget(field)
        second.addWidget(self.hand_over)
        for row in (first, second):
            row.addStretch(1)
        vbox(first, second, parent=self, margins=(0, 0, 0, 0))

    def show_pitch(self, on: bool) -> None:
        """Show or hide the dot pitch, which only camera calibrations need."""
        for widget in (self.pitch_mm, self._titles[self.pitch_mm]):
            widget.setVisible(on)

    def request(self, what: CalibrationName) -> CalibrateRequest:
        """Return the request that the form describes."""
        return CalibrateRequest(
            what,
            self.piece.currentText(),
            self.bottom.currentText(),
            origin_mm=(self.x_mm.value(), self.y_mm.value()),
            hand_over=self.hand_over.isChecked(),
            pitch_mm=self.pitch_mm.value(),
        )


MOST_VALUES = 10
VALUE_COLUMNS = 2


@dataclass(frozen=True, slots=True)
class CalibrationView:
    """State of the calibration sheet.

    ``rows`` holds (condition, tone) per calibration and ``chosen`` the index of the selected one.
    ``step`` is the index of the current step, -1 for none. ``figure`` is the residual as text and
    ``within`` tells if it is inside its limit, None without a limit. ``kind`` names the checked
    figure of the residuals. ``empty`` is shown while there are no residuals. ``why`` is the reason
    why no measurement can start, "" if one can.
    """

    rows: tuple[tuple[str, str], ...]
    chosen: int
    title: str
    steps: tuple[str, ...]
    step: int
    takes_piece: bool
    shows_fingers: bool
    live: str
    done: int
    total: int
    progress: str
    values: tuple[tuple[str, str], ...]
    residuals: tuple[float, ...]
    limit: float
    unit: str
    kind: str
    figure: str
    empty: str
    within: bool | None
    note: str
    note_bad: bool
    running: bool
    busy: bool
    can_accept: bool
    why: str


class CalibrateSheet(BenchSheet):
    """List on the left; steps, live values, residual and buttons on the right."""

    calibration_chosen = Signal(int)
    measure_requested = Signal()
    cancel_requested = Signal()
    accept_requested = Signal()

    def __init__(
        self, parent: QWidget, theme: Theme, titles: Sequence[str], form: PlaceForm
    ) -> None:
        super().__init__(parent, "Calibrate")
        self.form = form
        self._shown: CalibrationView | None = None
        self.choices = [QPushButton(title) for title in titles]
        self.conditions = [label("", "small") for _ in titles]
        self._group = QButtonGroup(self)
        self.title = label("", "head")
        self.steps = [label("", wrap=True) for _ in range(3)]
        self.live = label("", "muted")
        self.fingers: dict[Finger, TactileView] = {f: TactileView(theme, f) for f in FINGERS}
        self.progress = QProgressBar()
        self.bars = ResidualBars(theme)
        self.names = [label("", "muted") for _ in range(MOST_VALUES)]
        self.values = [label("") for _ in range(MOST_VALUES)]
        self.figure, self.note = label("", "title", wrap=True), label("", wrap=True)
        self.question = QuestionRow()
        self.measure, self.cancel = QPushButton("Measure"), QPushButton("Cancel")
        self.accept_it = QPushButton("Accept")
        self._pictures = QWidget()
        self._arrange()
        self._wire()

    def show_look(self, look: CalibrationView) -> None:
        """Update the sheet."""
        before, self._shown = self._shown, look
        if look == before:
            return
        for index, (words, tone) in enumerate(look.rows):
            self.conditions[index].setText(words)
            set_property(self.conditions[index], "tone", tone)
        self.choices[look.chosen].setChecked(True)
        self.title.setText(look.title)
        for index, step in enumerate(self.steps):
            step.setText(f"{index + 1}  {look.steps[index]}")
            set_property(step, "role", "title" if index == look.step else "")
        self.form.setVisible(look.takes_piece)
        self.form.show_pitch(look.shows_fingers)
        self._pictures.setVisible(look.shows_fingers)
        self.live.setText(look.live)
        self.progress.setVisible(look.running)
        self.progress.setMaximum(max(look.total, 1))
        self.progress.setValue(look.done)
        self.progress.setFormat(look.progress)
        self._show_values(look)
        if before is None or before.residuals != look.residuals:
            self.bars.show_residuals(look.residuals, look.limit, look.unit, look.kind)
        self.bars.show_empty(look.empty)
        self._show_buttons(look)

    # -- inside -----------------------------------------------------------------------------------

    def _show_values(self, look: CalibrationView) -> None:
        for index in range(MOST_VALUES):
            name, value = look.values[index] if index < len(look.values) else ("", "")
            for widget, text in ((self.names[index], name), (self.values[index], value)):
                widget.setText(text)
                widget.setVisible(bool(name))
        self.figure.setText(look.figure)
        tone = "" if look.within is None else "good" if look.within else "bad"
        set_property(self.figure, "tone", tone)
        self.note.setText(look.note)
        set_property(self.note, "tone", "bad" if look.note_bad else "")

    def _show_buttons(self, look: CalibrationView) -> None:
        self.measure.setText("Measure" if look.within is None else "Repeat")
        self.measure.setEnabled(not look.busy and not look.why)
        self.measure.setToolTip(look.why or "The arm moves. STOP works as ever.")
        self.cancel.setEnabled(look.busy)
        self.accept_it.setEnabled(look.can_accept)
        for button, leads in (
            (self.accept_it, look.can_accept),
            (self.measure, not look.can_accept),
        ):
            set_property(button, "role", "primary" if leads else "")
        self.form.setEnabled(not look.busy)
        for choice in self.choices:
            choice.setEnabled(not look.busy)

    def _arrange(self) -> None:
        scroll = QScrollArea()
        scroll.setFrameShape(QFrame.Shape.NoFrame)
        scroll.setWidgetResizable(True)
        scroll.setWidget(self._right())
        body = hbox(self._left(), (scroll, 1), spacing=20)
        self.arrange((body, 1), foot=(self.measure, self.cancel, self.accept_it), spacing=10)
        self.resize_to_em(54, 38)

    def _left(self) -> QVBoxLayout:
        left = QVBoxLayout()
        left.setSpacing(4)
        rows = zip(self.choices, self.conditions, strict=True)
        for index, (choice, condition) in enumerate(rows):
            choice.setCheckable(True)
            choice.setAutoDefault(False)
            self._group.addButton(choice, index)
            left.addWidget(choice)
            left.addWidget(condition)
            left.addSpacing(6)
        left.addStretch(1)
        return left

    def _right(self) -> QWidget:
        for view in self.fingers.values():
            view.setFixedSize(MIN_SIZE)
        pair = (CaptionedView(f"{f.capitalize()} finger", v) for f, v in self.fingers.items())
        hbox(*pair, parent=self._pictures, margins=(0, 0, 0, 0))
        page, seen = QWidget(), hbox(self._pictures, (self.bars, 1))
        vbox(
            self.title, *self.steps, self.form, self.live, self.progress, self.question, (seen, 1),
            self.figure, self.note, self._value_grid(),
            parent=page, margins=(0, 0, 8, 0), spacing=8,
        )  # fmt: skip
        return page

    def _value_grid(self) -> QGridLayout:
        grid = QGridLayout()
        grid.setHorizontalSpacing(16)
        high = -(-MOST_VALUES // VALUE_COLUMNS)
        for index, (name, value) in enumerate(zip(self.names, self.values, strict=True)):
            at, side = index % high, 2 * (index // high)
            grid.addWidget(name, at, side)
            grid.addWidget(value, at, side + 1)
            value.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        for side in range(VALUE_COLUMNS):
            grid.setColumnStretch(2 * side + 1, 1)
        return grid

    def _wire(self) -> None:
        self.question.no.clicked.connect(self.cancel_requested)
        self.cancel.setToolTip("End in an orderly way: lift, keep the piece")
        self.accept_it.setToolTip("Keep the result as a file that expires")
        for index, choice in enumerate(self.choices):
            choice.clicked.connect(partial(self.calibration_chosen.emit, index))
        self.measure.clicked.connect(self.measure_requested)
        self.cancel.clicked.connect(self.cancel_requested)
        self.accept_it.clicked.connect(self.accept_requested)
