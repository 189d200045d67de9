"""Sheet of the calibration panel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from PySide6.QtCore import QRectF, QSize, Qt
from PySide6.QtGui import QPainter, QPen
from PySide6.QtWidgets import (
    QButtonGroup,
    QCheckBox,
    QComboBox,
    QGridLayout,
    QHBoxLayout,
    QProgressBar,
    QPushButton,
    QVBoxLayout,
    QWidget,
)

from touchdown.app.shell import BenchSheet, QuestionRow
from touchdown.backend.calibration import (
    CALIBRATION_KINDS,
    CALIBRATION_NAMES,
    CalibrationName,
    format_residual,
    format_value,
    quantity_name,
)
from touchdown.backend.core import FINGERS, CalibrationMeasured, Finger, Progress
from touchdown.backend.runs import CalibrateRequest
from touchdown.widgets.base import (
    CaptionedView,
    Theme,
    add_items,
    hbox,
    label,
    scroll_area,
    set_property,
    ui_font,
    vbox,
)
from touchdown.widgets.forms import decimal_box, field_label, inset_spin_boxes
from touchdown.widgets.plots import PictureView, draw_message
from touchdown.widgets.views import MIN_SIZE, TactileView

MOST_BARS = 126


class ResidualBars(PictureView):
    """Bar chart of residuals; the dashed line is the limit of the checked figure."""

    def __init__(self, theme: Theme) -> None:
        super().__init__(theme, "Residuals", (200, 80))
        self._sizes: tuple[float, ...] = ()
        self._limit, self._unit, self._counts = 1.0, "", ""
        self.empty = ""

    def sizeHint(self) -> QSize:
        """Return the preferred size."""
        em = round(10 * self._theme.scale)
        return QSize(36 * em, 11 * em)

    def show_residuals(self, found: CalibrationMeasured | None, counts: str, empty: str) -> None:
        """Show the magnitudes of the residuals of ``found``, or ``empty`` without one.

        The limit applies to ``counts``.
        """
        self._sizes, self._counts, self.empty = (), counts, empty
        if found is not None:
            self._sizes = tuple(abs(value) for value in found.residuals[:MOST_BARS])
            self._limit, self._unit = found.limit, found.unit
            largest = f"largest {max(self._sizes, default=0.0):.3g} {found.unit}"
            empty = f"{largest}, limit {found.limit:g} {found.unit}"
        self.setAccessibleDescription(empty)
        self.update()

    def paint(self, painter: QPainter) -> None:
        """Draw the bars."""
        painter.fillRect(self.rect(), self._theme.tokens.colour("bg"))
        painter.setFont(ui_font(self._theme.scale, 0.85))
        if self._sizes:
            self._draw(painter)
        else:
            said = "Not measured since the start", self.empty
            draw_message(painter, self.rect(), self._theme, *said)

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
        self.x_mm, self.y_mm = decimal_box(-REACH_MM, REACH_MM), decimal_box(-REACH_MM, REACH_MM)
        self.pitch_mm = decimal_box(0.5, 5.0)
        self.pitch_mm.setValue(usual.pitch_mm)
        for spin in (self.x_mm, self.y_mm, self.pitch_mm):
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
            self._titles[field] = field_label(text, field)
            field.setAccessibleName(text)
            add_items(row, self._titles[field], field)
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


STEPS: dict[CalibrationName, tuple[str, ...]] = {
    "payload": (
        "Empty the gripper and leave 60 mm of free height above it.",
        "The hand rises, leans 14° in six poses and is weighed in each.",
        "It levels again. Compare mass and centre with the data sheet, then accept.",
    ),
    "wrist": (
        "Empty the gripper and leave 60 mm of free height above it.",
        "The hand leans in six poses: gravity shows how the sensor is turned.",
        "Beyond 2° the settings are wrong: correct ft.rotation, then repeat.",
    ),
    "board": (
        "Fix the bottom. The piece waits in its jig, or is handed over.",
        "The piece touches the bottom in five places and feels each edge twice.",
        "It goes back. The residual shows if anything moved meanwhile.",
    ),
    "tool": (
        "Fix a bottom whose place is known and give it as the origin.",
        "The piece feels its four edges; three grips.",
        "It goes back. The residual is the spread of the grips.",
    ),
    "camera": (
        "Fix the bottom. The piece waits in its jig, or is handed over.",
        "The piece is pressed at the rim on four sides: it leans, the dots follow.",
        "Exchanged fingers and mirrored pictures are put right from the next start on.",
    ),
}

# Figure of the residuals that the limit applies to.
COUNTS: dict[CalibrationName, str] = {
    "payload": "largest",
    "wrist": "largest",
    "board": "rms",
    "tool": "rms",
    "camera": "rms",
}


@dataclass(frozen=True, slots=True)
class CalibrationView:
    """State of the calibration sheet.

    ``rows`` holds (condition, tone) per calibration, ``what`` is the selected one. ``found`` is its
    result that waits to be accepted; ``empty`` is shown without one. ``progress`` is set while it
    is measured. ``said`` is the last message. ``why`` is the reason why no measurement can start,
    "" if one can.
    """

    rows: tuple[tuple[str, str], ...]
    what: CalibrationName
    found: CalibrationMeasured | None
    progress: Progress | None
    live: str
    empty: str
    said: str
    busy: bool
    why: str


class CalibrateSheet(BenchSheet):
    """List on the left; steps, live values, residual and buttons on the right."""

    def __init__(self, parent: QWidget, theme: Theme, form: PlaceForm) -> None:
        super().__init__(parent, "Calibrate")
        self.form = form
        self._shown: CalibrationView | None = None
        self.choices = [QPushButton(CALIBRATION_KINDS[what].title) for what in CALIBRATION_NAMES]
        self.conditions = [label("", "small") for _ in self.choices]
        self.group = QButtonGroup(self)
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
        self.accept_it, self.identify = QPushButton("Accept"), QPushButton("Identify")
        self._pictures = QWidget()
        self.cancel.setToolTip("End in an orderly way: lift, keep the piece")
        self.accept_it.setToolTip("Keep the result as a file that expires")
        self.identify.setToolTip("Fit the simulated bench to recorded presses")
        self._arrange()

    def show_look(self, look: CalibrationView) -> None:
        """Update the sheet."""
        before, self._shown = self._shown, look
        if look == before:
            return
        for index, (words, tone) in enumerate(look.rows):
            self.conditions[index].setText(words)
            set_property(self.conditions[index], "tone", tone)
        self.choices[CALIBRATION_NAMES.index(look.what)].setChecked(True)
        self.title.setText(CALIBRATION_KINDS[look.what].title)
        now = 1 if look.progress is not None else 0 if look.found is None else 2
        for index, (step, text) in enumerate(zip(self.steps, STEPS[look.what], strict=True)):
            step.setText(f"{index + 1}  {text}")
            set_property(step, "role", "title" if index == now else "")
        self.form.setVisible(self.form.request(look.what).takes_piece)
        self.form.show_pitch(look.what == "camera")
        self._pictures.setVisible(look.what == "camera")
        self.live.setText(look.live)
        self.progress.setVisible(look.progress is not None)
        progress = look.progress or Progress(0.0, 0, 1, "")
        self.progress.setMaximum(max(progress.total, 1))
        self.progress.setValue(progress.done)
        self.progress.setFormat(progress.text)
        self._show_found(look.found, look.said)
        if before is None or (before.found, before.empty) != (look.found, look.empty):
            self.bars.show_residuals(look.found, COUNTS[look.what], look.empty)
        self._show_buttons(look)

    # -- inside -----------------------------------------------------------------------------------

    def _show_found(self, found: CalibrationMeasured | None, said: str) -> None:
        values, figure, tone = [], "", ""
        if found is not None:
            residual = format_residual(found.residual, found.limit, found.unit)
            figure = f"Residual {residual}."
            tone = "good" if found.residual <= found.limit else "bad"
            said = " ".join(text for text in (found.obstacle, found.note) if text)
            values = list(zip(found.names, found.values, found.sigmas, found.units, strict=True))
        for index, (name, value) in enumerate(zip(self.names, self.values, strict=True)):
            known = index < len(values)
            name.setText(quantity_name(values[index][0]) if known else "")
            value.setText(format_value(*values[index]) if known else "")
            for widget in (name, value):
                widget.setVisible(known)
        self.figure.setText(figure)
        set_property(self.figure, "tone", tone)
        self.note.setText(said)
        set_property(self.note, "tone", "bad" if found is not None and found.obstacle else "")

    def _show_buttons(self, look: CalibrationView) -> None:
        self.measure.setText("Measure" if look.found is None else "Repeat")
        self.measure.setEnabled(not look.busy and not look.why)
        self.measure.setToolTip(look.why or "The arm moves. STOP works as ever.")
        self.cancel.setEnabled(look.busy)
        can_accept = look.found is not None and look.found.acceptable and not look.busy
        self.accept_it.setEnabled(can_accept)
        set_property(self.accept_it, "role", "primary" if can_accept else "")
        set_property(self.measure, "role", "" if can_accept else "primary")
        for widget in (self.form, *self.choices):
            widget.setEnabled(not look.busy)

    def _arrange(self) -> None:
        body = hbox(self._left(), (scroll_area(self._right()), 1), spacing=20)
        self.arrange(
            (body, 1), foot=(self.measure, self.cancel, self.accept_it, self.identify), spacing=10
        )
        self.resize_to_em(54, 38)

    def _left(self) -> QVBoxLayout:
        left = QVBoxLayout()
        left.setSpacing(4)
        rows = zip(self.choices, self.conditions, strict=True)
        for index, (choice, condition) in enumerate(rows):
            choice.setCheckable(True)
            choice.setAutoDefault(False)
            self.group.addButton(choice, index)
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
