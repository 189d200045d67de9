"""Small controls for the header of a panel."""

from __future__ import annotations

from collections.abc import Sequence

from PySide6.QtWidgets import QComboBox, QToolButton


def chooser(texts: Sequence[str], name: str) -> QComboBox:
    """Return a compact choice; ``name`` is said to screen readers and by the tip."""
    made = QComboBox()
    made.addItems(list(texts))
    made.setProperty("role", "compact")
    made.setAccessibleName(name)
    made.setToolTip(name)
    return made


def tool(text: str, tip: str, *, checkable: bool = False) -> QToolButton:
    """Return a flat button."""
    made = QToolButton()
    made.setText(text)
    made.setProperty("role", "plain")
    made.setToolTip(tip)
    made.setAccessibleName(tip)
    made.setCheckable(checkable)
    return made
