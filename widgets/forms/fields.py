"""Number fields with units."""

from __future__ import annotations

from PySide6.QtWidgets import QAbstractSpinBox

INSET_PX = 6


def inset_spin_boxes(*boxes: QAbstractSpinBox) -> None:
    """Keep the figures off the frame: the style sheet has no say inside a spin box."""
    for box in boxes:
        box.lineEdit().setTextMargins(INSET_PX, 0, 0, 0)
