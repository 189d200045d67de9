"""Number fields with units."""

from __future__ import annotations

from PySide6.QtWidgets import QAbstractSpinBox

INSET_PX = 6


def inset_spin_boxes(*boxes: QAbstractSpinBox) -> None:
    """Inset the figures of spin boxes; style-sheet padding does not reach them."""
    for box in boxes:
        box.lineEdit().setTextMargins(INSET_PX, 0, 0, 0)
