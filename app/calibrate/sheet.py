"""Sheet of the calibration panel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from operator import attrgetter

from PySide6.QtWidgets import QButtonGroup, QCheckBox, QComboBox, QProgressBar, QVBoxLayout, QWidget

from touchdown.app.shell import BenchSheet, QuestionRow
from touchdown.backend.calibration import (
    CALIBRATION_KINDS,
    MEASUREMENT_NAMES,
    QUANTITIES,
    CalibrationName,
    DayCheck,
    format_residual,
    format_value,
    quantity_name,
)
from touchdown.backend.core import FINGERS, CalibrationMeasured, Finger, Progress
from touchdown.backend.runs import CalibrateRequest
from touchdown.widgets.base import (
    CaptionedView,
    Theme,
    hbox,
    label,
    push_button,
    scroll_area,
    set_property,
    tr,
    vbox,
)
from touchdown.widgets.forms import FormFields, decimal_box, set_entries
from touchdown.widgets.lists import FigureTable
from touchdown.widgets.plots import CurveLine, CurvePlot
from touchdown.widgets.views import MIN_SIZE, TactileView

REACH_MM = 200.0


class PlaceForm(QWidget):
    """Fields of a ``CalibrateRequest``."""

    def __init__(
        self, pieces: Sequence[str], bottoms: Sequence[str], usual: CalibrateRequest
    ) -> None:
        super().__init__()
        self.piece, self.bottom = QComboBox(), QComboBox()
        set_entries(self.piece, [(name, name) for name in pieces], usual.piece)
        set_entries(self.bottom, [(name, name) for name in bottoms], usual.bottom)
        self.x_mm, self.y_mm = decimal_box(-REACH_MM, REACH_MM), decimal_box(-REACH_MM, REACH_MM)
        self.hand_over = QCheckBox(tr("Hand the piece over (no jig)"))
        self.pitch_mm = decimal_box(0.5, 5.0)
        self.pitch_mm.setValue(usual.pitch_mm)
        x, y, pitch = self.x_mm, self.y_mm, self.pitch_mm
        for spin in (x, y, pitch):
            spin.setSuffix(" mm")
        fields = FormFields(12, 6, piece=self.piece, bottom=self.bottom, x=x, y=y, pitch=pitch)
        fields.add_halves(0, ("Piece", self.piece, ""), ("Bottom", self.bottom, ""))
        fields.add_halves(1, ("Origin x", x, ""), ("y", y, ""))
        self._pitch_title = fields.add_halves(2, ("Pitch of the dots", pitch, ""))[0]
        fields.addWidget(self.hand_over, 2, 2, 1, 2)
        vbox(fields, parent=self, margins=(0, 0, 0, 0))

    def show_pitch(self, on: bool) -> None:
        """Show or hide the dot pitch, which only camera calibrations need."""
        for widget in (self.pitch_mm, self._pitch_title):
            widget.setVisible(on)

    def request(self, what: CalibrationName) -> CalibrateRequest:
        """Return the request that the form describes."""
        x_mm, y_mm, pitch_mm = (box.value() for box in (self.x_mm, self.y_mm, self.pitch_mm))
        return CalibrateRequest(
            what, self.piece.currentText(), self.bottom.currentText(), 0, (x_mm, y_mm),
            self.hand_over.isChecked(), pitch_mm,
        )  # fmt: skip


# Names of the lines that differ from the keys of the quantities.
DAY_NAMES = {"stiffness_px_n": "marker motion", "noise_n": "wrist noise"}
DAY_COLOURS = ("axis_x", "axis_y", "axis_z", "good", "text", "scene")
AFTER_FAILED = "Then press Measure to check again."
HELD = "The gripper holds a piece: Measure first puts it back in its jig."
AFTER_HELD = "Then press Measure to check again: it first puts the held piece back in its jig."
AFTER_PASSED = "Nothing to do: check again tomorrow."
HIGHEST_SHARE = 3.0  # of a limit, in the plot


def residual_lines(found: CalibrationMeasured) -> list[CurveLine]:
    """Return the sizes of the residuals and their limit."""
    sizes = [abs(value) for value in found.residuals]
    limit = ((1.0, found.limit), (float(len(sizes)), found.limit))
    name = tr("limit" if found.what in ("payload", "wrist") else "limit of the rms")
    points = tuple((float(k), size) for k, size in enumerate(sizes, start=1))
    return [CurveLine("", points, "axis_x"), CurveLine(name, limit, "muted", dashed=True)]


def history_lines(checks: Sequence[DayCheck]) -> list[CurveLine]:
    """Return by day how far each quantity was from the middle of its limits; 1 is a limit."""
    limit = ((1.0, 1.0), (float(len(checks)), 1.0))
    lines = [CurveLine(tr("limit"), limit, "muted", dashed=True)] if checks else []
    for key, colour in zip(QUANTITIES, DAY_COLOURS, strict=True):
        points = []
        for day, check in enumerate(checks, start=1):
            shares = [check.share(n) for n in check.values if n.partition("_")[2] == key]
            points += [(float(day), min(max(shares), HIGHEST_SHARE))] if shares else []
        name = tr(DAY_NAMES.get(key, key.partition("_")[0]))
        lines.append(CurveLine(name, tuple(points), colour, dashed=key.endswith("_px")))
    return lines


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
    "day": (
        "The check begins with an empty gripper: the piece waits in its jig, or is handed over.",
        "Markers and wrist sensor rest for 20 s; then the piece is pressed four times.",
        "The result is stored. Out of limits, you are asked before each release until one passes.",
    ),
}


@dataclass(frozen=True, slots=True)
class CalibrationView:
    """State of the calibration sheet.

    ``rows`` holds (condition, tone) per calibration, ``what`` is the selected one. ``found`` is its
    result that waits to be accepted; ``empty`` is shown without one. ``progress`` is set while it
    is measured. ``said`` is the last message. ``why`` is the reason why no measurement can start,
    "" if one can. ``held``: Measure first puts a held piece back, ``opens``: the gripper can be
    opened here. ``history``: daily checks, where they are selected.
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
    held: bool = False
    opens: bool = False
    history: tuple[DayCheck, ...] = ()


class CalibrateSheet(BenchSheet):
    """List on the left; steps, live values, residual and buttons on the right."""

    def __init__(self, parent: QWidget, theme: Theme, form: PlaceForm) -> None:
        super().__init__(parent, "Calibrate")
        self.form = form
        self._shown: CalibrationView | None = None
        self.choices = [push_button(CALIBRATION_KINDS[what].title) for what in MEASUREMENT_NAMES]
        self.conditions = [label("", "small") for _ in self.choices]
        self.group = QButtonGroup(self)
        self.title = label("", "head")
        self.steps = [label("", wrap=True) for _ in range(3)]
        self.live = label("", "muted")
        self.fingers: dict[Finger, TactileView] = {f: TactileView(theme, f) for f in FINGERS}
        self.progress = QProgressBar()
        self.plot = CurvePlot(theme, "Residuals")
        self.table = FigureTable(theme, "Values", ("quantity", "value", "limits"))
        self.figure, self.note = label("", "title", wrap=True), label("", wrap=True)
        self.question = QuestionRow()
        self.measure = push_button("Measure")
        self.cancel = push_button("Cancel", "End in an orderly way: lift, keep the piece")
        tip = "Open the jaws; asks first while a piece is held"
        self.open_it = push_button("Open gripper", tip)
        self.accept_it = push_button("Accept", "Keep the result as a file that expires")
        self.identify = push_button("Identify", "Fit the simulated bench to recorded presses")
        self._pictures = QWidget()
        body = hbox(self._left(), (scroll_area(self._right()), 1), spacing=20)
        foot = self.open_it, self.measure, self.cancel, self.accept_it, self.identify
        self.arrange((body, 1), foot=foot, spacing=10)
        self.resize_to_em(54, 38)

    def show_look(self, look: CalibrationView) -> None:
        """Update the sheet."""
        before, self._shown = self._shown, look
        if look == before:
            return
        for index, (words, tone) in enumerate(look.rows):
            self.conditions[index].setText(tr(words))
            set_property(self.conditions[index], "tone", tone)
        chosen = self.choices[MEASUREMENT_NAMES.index(look.what)]
        chosen.setChecked(True)
        if self.focusWidget() in self.choices:
            chosen.setFocus()
        title = tr(CALIBRATION_KINDS[look.what].title)
        self.title.setText(tr("Calibrate: {}", title))
        now = 1 if look.progress is not None else 0 if look.found is None else 2
        # The result of today's check is seen whole: its table needs the height.
        checked = any(one.day == f"{datetime.now():%Y-%m-%d}" for one in look.history[-1:])
        for index, (step, text) in enumerate(zip(self.steps, STEPS[look.what], strict=True)):
            step.setText(f"{index + 1}  {tr(text)}")
            set_property(step, "role", "title" if index == now else "")
            step.setVisible(not checked or now == index == 1)
        self.form.setVisible(self.form.request(look.what).takes_piece)
        self.form.show_pitch(look.what == "camera")
        self._pictures.setVisible(look.what == "camera")
        self.live.setText(look.live)
        self.live.setVisible(not checked)
        self.progress.setVisible(look.progress is not None)
        progress = look.progress or Progress(0.0, 0, 1, "")
        self.progress.setMaximum(max(progress.total, 1))
        self.progress.setValue(progress.done)
        self.progress.setFormat(progress.text)
        parts = attrgetter("what", "found", "empty", "said", "why", "busy", "held", "history")
        if before is None or parts(before) != parts(look):
            self._show_result(look)
        self._show_buttons(look)

    # -- inside -----------------------------------------------------------------------------------

    def _show_result(self, look: CalibrationView) -> None:
        found, said, figure, tone = look.found, look.said, "", ""
        rows: Sequence[Sequence[str]] = ()
        lines, count = list[CurveLine](), 0
        if look.what == "day":
            lines, count = history_lines(look.history), len(look.history)
            for check in look.history[-1:]:
                out, rows = check.findings, check.rows()
                figure = tr("{}: out of limits." if out else "{}: within limits.", check.day)
                failed = AFTER_HELD if look.held else AFTER_FAILED
                tone, after = ("bad", failed) if out else ("good", AFTER_PASSED)
                again = () if look.why else (tr(after),)
                said = said or "\n".join((*out.values(), *again))
        elif found is not None:
            figure = tr("Residual {}.", format_residual(found.residual, found.limit, found.unit))
            tone = "good" if found.residual <= found.limit else "bad"
            said = " ".join(text for text in (found.obstacle, found.note) if text)
            values = zip(found.names, found.values, found.sigmas, found.units, strict=True)
            rows = [(tr(quantity_name(value[0])), format_value(*value)) for value in values]
            lines, count = residual_lines(found), len(found.residuals)
        self.plot.name = tr("Deviation, 1 = limit, by check" if look.what == "day" else "Residuals")
        self.plot.empty = look.empty
        self.plot.show_lines(lines, count)
        self.table.setVisible(bool(rows))
        self.table.show_rows(rows)
        self.table.setColumnHidden(2, look.what != "day")
        self.table.setFixedHeight(self.table.sizeHint().height())
        self.figure.setText(figure)
        self.figure.setVisible(bool(figure))
        set_property(self.figure, "tone", tone)
        why = f"{look.why}." if look.why and not look.busy else ""
        held = tr(HELD) if look.held and not look.history else ""
        self.note.setText("\n".join(filter(None, (said, why, held))))
        self.note.setVisible(bool(self.note.text()))
        set_property(self.note, "tone", "bad" if found is not None and found.obstacle else "")

    def _show_buttons(self, look: CalibrationView) -> None:
        self.measure.setText(tr("Measure" if look.found is None else "Repeat"))
        self.measure.setEnabled(not look.busy and not look.why)
        self.measure.setToolTip(look.why or tr("The arm moves. STOP works as ever."))
        self.cancel.setEnabled(look.busy)
        can_accept = look.found is not None and look.found.acceptable and not look.busy
        self.accept_it.setEnabled(can_accept)
        set_property(self.accept_it, "role", "primary" if can_accept else "")
        self.open_it.setVisible(look.opens)
        opens = look.opens and bool(look.why) and not can_accept
        set_property(self.open_it, "role", "primary" if opens else "")
        set_property(self.measure, "role", "" if can_accept or opens else "primary")
        for widget in (self.form, *self.choices):
            widget.setEnabled(not look.busy)

    def _left(self) -> QVBoxLayout:
        for index, choice in enumerate(self.choices):
            choice.setCheckable(True)
            choice.setAutoDefault(False)
            self.group.addButton(choice, index)
        rows = zip(self.choices, self.conditions, strict=True)
        return vbox(*(vbox(*row, spacing=3) for row in rows), 1, spacing=14)

    def _right(self) -> QWidget:
        for view in self.fingers.values():
            view.setFixedSize(MIN_SIZE)
        pair = (
            CaptionedView(tr("{} finger", tr(f).capitalize()), v) for f, v in self.fingers.items()
        )
        hbox(*pair, parent=self._pictures, margins=(0, 0, 0, 0))
        page, seen = QWidget(), hbox(self._pictures, (self.plot, 1))
        vbox(
            self.title, self.figure, self.note, *self.steps, self.form, self.live, self.progress,
            self.question, self.table, (seen, 1),
            parent=page, margins=(0, 0, 8, 0), spacing=8,
        )  # fmt: skip
        return page
