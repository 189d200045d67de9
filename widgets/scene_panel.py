"""What stands on the simulated bench: piece and bottom, set anew by a button."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from PySide6.QtWidgets import QComboBox, QHBoxLayout, QPushButton

from widgets.panel import Panel

Entries = Sequence[tuple[str, str]]
"""(name, title) of pieces."""


class ScenePanel(Panel):
    """Two choices and a button; ``on_set`` gets the names."""

    def __init__(self, on_set: Callable[[str, str], None]) -> None:
        super().__init__("Bench")
        self._on_set = on_set
        self.piece, self.bottom = QComboBox(), QComboBox()
        self.set = QPushButton("Set")
        row = QHBoxLayout()
        for combo, name, tip in (
            (self.piece, "Piece", "The piece between the jaws"),
            (self.bottom, "Bottom", "What stands below it"),
        ):
            combo.setAccessibleName(name)
            combo.setToolTip(tip)
            combo.setMinimumContentsLength(6)
            combo.setSizeAdjustPolicy(
                QComboBox.SizeAdjustPolicy.AdjustToMinimumContentsLengthWithIcon
            )
            row.addWidget(combo, 1)
        self.set.setAccessibleName("Set the bench")
        self.set.setToolTip("Put both back to their places on the simulated bench (Ctrl+N)")
        self.set.clicked.connect(self.ask)
        row.addWidget(self.set)
        self.column.addLayout(row)

    def show_catalogue(self, pieces: Entries, bottoms: Entries, chosen: tuple[str, str]) -> None:
        """Offer these; ``chosen`` names a piece and a bottom."""
        for combo, entries, name in (
            (self.piece, pieces, chosen[0]),
            (self.bottom, bottoms, chosen[1]),
        ):
            combo.clear()
            for key, title in entries:
                combo.addItem(title, key)
            combo.setCurrentIndex(max(combo.findData(name), 0))

    def show_ready(self, ready: bool) -> None:
        """Switch the controls."""
        for widget in (self.piece, self.bottom, self.set):
            if widget.isEnabled() != ready:
                widget.setEnabled(ready)

    def ask(self) -> None:
        """Ask for what is chosen."""
        piece, bottom = self.piece.currentData(), self.bottom.currentData()
        if piece and bottom:
            self._on_set(str(piece), str(bottom))
