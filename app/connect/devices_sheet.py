"""The devices of a lab file as a form: who each one is and where it answers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from PySide6.QtCore import QSize, Qt
from PySide6.QtGui import QShowEvent
from PySide6.QtWidgets import (
    QComboBox,
    QDialog,
    QGridLayout,
    QHBoxLayout,
    QLineEdit,
    QPushButton,
    QScrollArea,
    QVBoxLayout,
    QWidget,
)

from widgets.panel import label, rule, set_property


@dataclass(frozen=True, slots=True)
class DeviceField:
    """One value of the file: its dotted key, the device it belongs to, what it is called.

    ``chosen``: there is something to choose from; what is not in sight can be typed as well.
    ``empty``: what it means to leave it empty.
    """

    key: str
    device: str
    title: str
    chosen: bool = False
    empty: str = ""


@dataclass(frozen=True, slots=True)
class DeviceIntents:
    """What the operator can ask for."""

    look: Callable[[], None]
    swap: Callable[[], None]
    save: Callable[[], None]


class DevicesSheet(QDialog):
    """Shows and hands back texts; what they mean is the presenter's."""

    def __init__(
        self, parent: QWidget, fields: Sequence[DeviceField], intents: DeviceIntents
    ) -> None:
        super().__init__(parent)
        self.setModal(False)
        self.setWindowTitle("Devices")
        self.source, self.said = label("", wrap=True), label("", wrap=True)
        self._form = QWidget()
        self.editors: dict[str, QComboBox | QLineEdit] = {}
        self.look, self.swap = QPushButton("Look again"), QPushButton("Exchange left and right")
        self.save, self._close = QPushButton("Save"), QPushButton("Close")
        self.save.setProperty("role", "primary")
        self.look.setToolTip("Look for serial ports and cameras that are plugged in")
        self.swap.setToolTip("Each camera to the other finger")
        self.save.setToolTip("Write the lab file; nothing is connected or moved")
        self.look.clicked.connect(intents.look)
        self.swap.clicked.connect(intents.swap)
        self.save.clicked.connect(intents.save)
        self._close.clicked.connect(self.close)
        self._arrange(parent, fields)

    def values(self) -> dict[str, str]:
        """Return what stands in the form, by key."""
        return {key: _text(editor).strip() for key, editor in self.editors.items()}

    def set_values(self, values: Mapping[str, str]) -> None:
        """Show ``values`` by key."""
        for key, text in values.items():
            editor = self.editors[key]
            if isinstance(editor, QComboBox):
                editor.setCurrentText(text)
            else:
                editor.setText(text)

    def offer(self, choices: Mapping[str, Sequence[str]]) -> None:
        """Show what can be chosen; what stands in the form stays."""
        for key, texts in choices.items():
            editor = self.editors.get(key)
            if isinstance(editor, QComboBox):
                kept = editor.currentText()
                editor.clear()
                editor.addItems(list(texts))
                editor.setCurrentText(kept)

    def say(self, text: str, *, bad: bool) -> None:
        """Say what came of the last order."""
        self.said.setText(text)
        set_property(self.said, "tone", "bad" if bad else "")

    def showEvent(self, event: QShowEvent) -> None:
        """Keep the rows as high as their text wants: a scrolled form else squeezes them first."""
        super().showEvent(event)
        self._form.setMinimumHeight(self._form.sizeHint().height())

    # -- inside -----------------------------------------------------------------------------------

    def _arrange(self, parent: QWidget, fields: Sequence[DeviceField]) -> None:
        grid, device = QGridLayout(), ""
        grid.setHorizontalSpacing(16)
        grid.setVerticalSpacing(4)
        grid.setColumnStretch(2, 1)
        for at, one in enumerate(fields):
            editor = self.editors[one.key] = QComboBox() if one.chosen else QLineEdit()
            if isinstance(editor, QComboBox):
                editor.setEditable(True)
                editor.setInsertPolicy(QComboBox.InsertPolicy.NoInsert)
            else:
                editor.setPlaceholderText(one.empty)
            editor.setAccessibleName(f"{one.device}: {one.title}")
            title = label(one.title, "muted")
            title.setBuddy(editor)
            if one.device != device:
                grid.addWidget(label(one.device, "title"), at, 0)
            device = one.device
            grid.addWidget(title, at, 1)
            grid.addWidget(editor, at, 2)
        foot = QHBoxLayout()
        for button in (self.save, self.look, self.swap):
            button.setAutoDefault(False)
            foot.addWidget(button)
        foot.addStretch(1)
        self._close.setAutoDefault(False)
        foot.addWidget(self._close)
        column = QVBoxLayout(self)
        column.setContentsMargins(18, 14, 18, 14)
        column.setSpacing(8)
        column.addWidget(label("Devices of this bench", "head"))
        column.addWidget(self.source)
        column.addWidget(rule())
        column.addWidget(self._scrolled(grid), 1)
        column.addWidget(self.said)
        column.addWidget(rule())
        column.addLayout(foot)
        em = self.fontMetrics().height()
        self.resize(QSize(48 * em, 44 * em).boundedTo(parent.size()))

    def _scrolled(self, grid: QGridLayout) -> QScrollArea:
        """Return the form so that it fits small screens and large text."""
        scroll = QScrollArea()
        grid.setContentsMargins(0, 0, 0, 0)
        self._form.setLayout(grid)
        scroll.setWidget(self._form)
        scroll.setWidgetResizable(True)
        scroll.setFrameShape(QScrollArea.Shape.NoFrame)
        scroll.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        return scroll


def _text(editor: QComboBox | QLineEdit) -> str:
    return editor.currentText() if isinstance(editor, QComboBox) else editor.text()
