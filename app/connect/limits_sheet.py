"""The limits of motion and force as a table; changed on purpose only."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from PySide6.QtWidgets import (
    QDialog,
    QDoubleSpinBox,
    QGridLayout,
    QHBoxLayout,
    QPushButton,
    QVBoxLayout,
    QWidget,
)

from app.connect.question import QuestionRow
from widgets.number_inset import inset
from widgets.panel import label, rule

WIDEST = 2000.0
COLUMNS = 2
FINE = "N\N{MIDDLE DOT}m"
"""Values of this unit have more decimals."""


@dataclass(frozen=True, slots=True)
class LimitRow:
    """One limit: its name in the file, what it is, value and unit as it follows the value."""

    name: str
    title: str
    value: float
    unit: str


class LimitsSheet(QDialog):
    """``offer`` tries values by name and returns "" or why they cannot be taken."""

    def __init__(self, parent: QWidget, offer: Callable[[Mapping[str, float]], str]) -> None:
        super().__init__(parent)
        self.setModal(False)
        self.setWindowTitle("Limits")
        self._offer = offer
        self.source, self.said = label("", wrap=True), label("", wrap=True)
        self.said.setProperty("tone", "bad")
        self.question = QuestionRow()
        self._grid = QGridLayout()
        self._grid.setHorizontalSpacing(20)
        # The least window shows the sheet below its bar.
        self._grid.setVerticalSpacing(2)
        self.boxes: dict[str, QDoubleSpinBox] = {}
        self._shown: dict[str, tuple[float, float]] = {}
        self.edit = QPushButton("Unlock")
        self.edit.setCheckable(True)
        self.edit.setToolTip("Let the limits be changed")
        self.take, self._close = QPushButton("Change\N{HORIZONTAL ELLIPSIS}"), QPushButton("Close")
        self.edit.toggled.connect(self._unlock)
        self.take.clicked.connect(self._taken)
        self._close.clicked.connect(self.close)
        self._arrange()

    def show_rows(self, rows: Sequence[LimitRow], source: str) -> None:
        """Show the limits that hold and where they come from; locked again."""
        if not self.boxes:
            self._build(rows)
        for row in rows:
            self.boxes[row.name].setValue(row.value)
            self._shown[row.name] = (row.value, self.boxes[row.name].value())
        self.source.setText(source)
        self.said.setText("")
        self.question.withdraw()
        self.edit.setChecked(False)
        self._unlock(False)

    # -- inside -----------------------------------------------------------------------------------

    def _arrange(self) -> None:
        foot = QHBoxLayout()
        for button in (self.edit, self.take):
            foot.addWidget(button)
        foot.addStretch(1)
        foot.addWidget(self._close)
        for button in (self.edit, self.take, self._close):
            button.setAutoDefault(False)
        column = QVBoxLayout(self)
        column.setContentsMargins(18, 14, 18, 14)
        column.setSpacing(8)
        column.addWidget(label("Limits of motion and force", "head"))
        column.addWidget(self.source)
        column.addWidget(rule())
        column.addLayout(self._grid)
        column.addWidget(self.said)
        column.addWidget(self.question)
        column.addStretch(1)
        column.addWidget(rule())
        column.addLayout(foot)
        self.setMinimumWidth(50 * self.fontMetrics().height())

    def _build(self, rows: Sequence[LimitRow]) -> None:
        high = -(-len(rows) // COLUMNS)
        for index, row in enumerate(rows):
            box = self.boxes[row.name] = QDoubleSpinBox()
            box.setRange(-WIDEST, WIDEST)
            box.setDecimals(3 if row.unit.endswith(FINE) else 1)
            box.setSuffix(row.unit)
            box.setAccessibleName(row.title)
            box.setKeyboardTracking(False)
            inset(box)
            box.setMinimumWidth(8 * self.fontMetrics().height())
            title = label(row.title, "muted")
            title.setBuddy(box)
            at, side = index % high, 2 * (index // high)
            self._grid.addWidget(title, at, side)
            self._grid.addWidget(box, at, side + 1)

    def _unlock(self, on: bool) -> None:
        for box in self.boxes.values():
            # Not disabled: locked values are there to be read, in full contrast.
            box.setReadOnly(not on)
        self.take.setEnabled(on)
        if not on:
            self.question.withdraw()

    def _taken(self) -> None:
        self.said.setText(self._offer({name: self._value(name) for name in self.boxes}))

    def _value(self, name: str) -> float:
        """Return a limit; one that nobody touched keeps the digits that its box does not show."""
        value, shown = self._shown[name]
        now = self.boxes[name].value()
        return value if now == shown else now
