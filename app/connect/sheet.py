"""Sheet of the connection panel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

from PySide6.QtCore import QRect, Qt, Signal
from PySide6.QtWidgets import QGridLayout, QLabel, QPushButton, QWidget

from touchdown.app.shell import BenchSheet, QuestionRow
from touchdown.widgets.base import label, rule, set_property, tr

MARKS = {
    "done": "\N{CHECK MARK}",
    "now": "\N{HORIZONTAL ELLIPSIS}",
    "failed": "\N{MULTIPLICATION X}",
    "open": "\N{MIDDLE DOT}",
}
TALLEST_PX = 10_000
TONES = {"done": "good", "failed": "bad"}


@dataclass(frozen=True, slots=True)
class DeviceRowView:
    """One device: ``marks`` of its steps (done, now, failed, open), a sentence, its buttons.

    ``order`` is the action of the first button, "connect" or "disconnect"; ``extra`` that of the
    second.
    """

    title: str
    state: str
    marks: tuple[str, ...]
    text: str
    bad: bool
    order: str
    label: str
    can: bool
    extra: str = ""


@dataclass(frozen=True, slots=True)
class ConnectView:
    """State of the connection panel."""

    head: str
    text: str
    rows: tuple[DeviceRowView, ...]
    busy: bool
    can: bool


@dataclass(slots=True)
class _DeviceRow:
    name: QLabel
    state: QLabel
    marks: list[QLabel]
    text: QLabel
    button: QPushButton
    extra: QPushButton
    shown: DeviceRowView | None = field(default=None)


class ConnectSheet(BenchSheet):
    """Connection panel."""

    row_pressed = Signal(int)
    extra_pressed = Signal(int)

    def __init__(self, parent: QWidget, steps: Sequence[str]) -> None:
        super().__init__(parent, "Connect")
        self._steps = tuple(steps)
        self.head, self.text = label("", "head"), label("", wrap=True)
        self.question = QuestionRow()
        self._grid = QGridLayout()
        self._grid.setHorizontalSpacing(16)
        self._grid.setVerticalSpacing(8)
        self._grid.setColumnStretch(len(self._steps) + 2, 1)
        self._rows: list[_DeviceRow] = []
        self.connect_all = QPushButton(tr("Connect all"))
        self.connect_all.setProperty("role", "primary")
        self.cancel = QPushButton(tr("Cancel"))
        self.disconnect_all = QPushButton(tr("Disconnect all"))
        self.devices, self.limits = QPushButton(tr("Devices")), QPushButton(tr("Limits"))
        self.connect_all.setToolTip(tr("One after the other, the arm last; nothing moves"))
        self.cancel.setToolTip(tr("End connecting; what is connected stays so"))
        self.disconnect_all.setToolTip(tr("First the arm goes off; the gripper keeps its grip"))
        self.devices.setToolTip(tr("Choose makes, ports and cameras, and save the lab file"))
        foot = (self.connect_all, self.cancel, self.disconnect_all, self.devices, self.limits)
        self.arrange(
            self.head, self.text, rule(), self._grid, self.question, 1, foot=foot, spacing=10
        )
        self.give_width(64)

    def show_look(self, look: ConnectView) -> None:
        """Update the panel."""
        self.head.setText(tr(look.head))
        self.text.setText(tr(look.text))
        if len(look.rows) != len(self._rows):
            self._build(look.rows)
        for row, shown in zip(self._rows, look.rows, strict=True):
            if row.shown != shown:
                row.shown = shown
                self._show_row(row, shown)
        self.connect_all.setEnabled(look.can and not look.busy)
        self.cancel.setEnabled(look.busy)
        self.disconnect_all.setEnabled(look.can and not look.busy)

    def row(self, index: int) -> tuple[str, str, QPushButton, QPushButton]:
        """Return (state, sentence, first button, second button) of a device."""
        row = self._rows[index]
        return row.state.text(), row.text.text(), row.button, row.extra

    # -- inside -----------------------------------------------------------------------------------

    def _build(self, looks: Sequence[DeviceRowView]) -> None:
        for column, step in enumerate(self._steps):
            self._grid.addWidget(label(step, "small"), 0, column + 2)
        for index, look in enumerate(looks):
            row = _DeviceRow(
                label(look.title, "title"),
                label("", "muted"),
                [label("") for _ in self._steps],
                label("", wrap=True),
                QPushButton(tr("Connect"), autoDefault=False),
                QPushButton("", autoDefault=False),
            )
            row.button.clicked.connect(partial(self.row_pressed.emit, index))
            row.extra.clicked.connect(partial(self.extra_pressed.emit, index))
            widgets = (row.name, row.state, *row.marks, row.text, row.extra, row.button)
            for column, widget in enumerate(widgets):
                self._grid.addWidget(widget, index + 1, column)
                if isinstance(widget, QLabel) and widget in row.marks:
                    self._grid.setAlignment(widget, Qt.AlignmentFlag.AlignHCenter)
            self._rows.append(row)

    def _show_row(self, row: _DeviceRow, look: DeviceRowView) -> None:
        row.state.setText(tr(look.state))
        for mark, word, step in zip(row.marks, look.marks, self._steps, strict=True):
            mark.setText(MARKS[word])
            mark.setAccessibleName(f"{tr(look.title)}, {tr(step)}: {tr(word)}")
            set_property(mark, "tone", TONES.get(word, ""))
        row.text.setText(tr(look.text))
        # A label in a grid does not request the height of its wrapped text.
        metrics, least = self.fontMetrics(), 3 if look.bad else 2
        room = QRect(0, 0, (25 if look.extra else 30) * metrics.height(), TALLEST_PX)
        high = metrics.boundingRect(room, Qt.TextFlag.TextWordWrap, look.text).height()
        row.text.setMinimumHeight(max(high, least * metrics.lineSpacing()) + 2)
        set_property(row.text, "tone", "bad" if look.bad else "")
        row.button.setText(tr(look.label))
        row.button.setAccessibleName(f"{tr(look.label)} {tr(look.title)}")
        row.button.setEnabled(look.can)
        row.extra.setVisible(bool(look.extra))
        row.extra.setText(tr(look.extra))
        row.extra.setAccessibleName(f"{tr(look.extra)} {tr(look.title)}")
        row.extra.setEnabled(look.can)
