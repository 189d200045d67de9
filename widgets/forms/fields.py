"""Helpers of forms: labels, combo boxes, spin boxes and icons of buttons."""

from __future__ import annotations

from collections.abc import Iterable

from PySide6.QtWidgets import QAbstractButton, QAbstractSpinBox, QComboBox, QLabel, QWidget

from touchdown.widgets.base import Theme, fit_icon, icon, label

INSET_PX = 6


def field_label(text: str, field: QWidget) -> QLabel:
    """Return the muted label of a field."""
    made = label(text, "muted")
    made.setBuddy(field)
    return made


def inset_spin_boxes(*boxes: QAbstractSpinBox) -> None:
    """Inset the figures of spin boxes; style-sheet padding does not reach them."""
    for box in boxes:
        box.lineEdit().setTextMargins(INSET_PX, 0, 0, 0)


def let_shrink(*combos: QComboBox, letters: int = 8) -> None:
    """Let combo boxes be narrower than their longest entry."""
    for combo in combos:
        combo.setMinimumContentsLength(letters)
        combo.setSizeAdjustPolicy(QComboBox.SizeAdjustPolicy.AdjustToMinimumContentsLengthWithIcon)


def set_entries(combo: QComboBox, entries: Iterable[tuple[str, str]]) -> None:
    """Replace the (key, title) entries of a combo box."""
    combo.clear()
    for key, title in entries:
        combo.addItem(title, key)


def select_key(combo: QComboBox, key: str) -> None:
    """Select the entry of this key; an unknown key changes nothing."""
    index = combo.findData(key)
    if index >= 0:
        combo.setCurrentIndex(index)


def draw_run_icons(theme: Theme, start: QAbstractButton, *others: QAbstractButton) -> None:
    """Draw the icons of Start and, if given, Pause or Resume and Cancel in the theme's colours."""
    tokens = theme.tokens
    start.setIcon(icon("play", tokens.colour("panel" if start.isEnabled() else "disabled")))
    for button, name in zip(others, ("pause", "cancel"), strict=False):
        name = "play" if button.text() == "Resume" else name
        button.setIcon(icon(name, tokens.colour("text" if button.isEnabled() else "disabled")))
    fit_icon(start, *others)
