"""Which piece over which bottom, and where its centre should be."""

from __future__ import annotations

from collections.abc import Sequence

from PySide6.QtWidgets import (
    QCheckBox,
    QComboBox,
    QDoubleSpinBox,
    QHBoxLayout,
    QVBoxLayout,
    QWidget,
)

from backend.calibration.kinds import What
from backend.runs.requests import CalibrateRequest
from widgets.number_inset import inset
from widgets.panel import label

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
            inset(spin)
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
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        for row in (first, second):
            row.addStretch(1)
            column.addLayout(row)

    def show_pitch(self, on: bool) -> None:
        """Show the pitch of the dots, which cameras alone are measured by."""
        for widget in (self.pitch_mm, self._titles[self.pitch_mm]):
            widget.setVisible(on)

    def request(self, what: What) -> CalibrateRequest:
        """Return what the fields say."""
        return CalibrateRequest(
            what,
            self.piece.currentText(),
            self.bottom.currentText(),
            origin_mm=(self.x_mm.value(), self.y_mm.value()),
            hand_over=self.hand_over.isChecked(),
            pitch_mm=self.pitch_mm.value(),
        )
