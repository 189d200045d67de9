"""One probe: the paper's values, the phases as they come, and what was felt."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from PySide6.QtCore import QRectF, QSize, Qt
from PySide6.QtGui import QFontMetrics, QPainter, QPaintEvent, QPen
from PySide6.QtWidgets import QHBoxLayout, QPushButton, QSizePolicy, QWidget

from widgets.elided import ElidedLabel
from widgets.panel import Panel, label
from widgets.theme import Theme, ui_font

PADDING = 3
"""Room round a phase's name, in letters."""


class PhaseStrip(QWidget):
    """Phases in a row: those done are filled and ticked, the present one is framed and bold."""

    def __init__(self, theme: Theme, phases: Sequence[str]) -> None:
        super().__init__()
        self._theme, self.phases, self.at = theme, tuple(phases), -1
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
        self.setAccessibleName("Phases of the probe")

    def show_phase(self, at: int) -> None:
        """Show the phase in progress; -1: none yet, beyond the last: all done."""
        if at != self.at:
            self.at = at
            known = 0 <= at < len(self.phases)
            said = self.phases[at] if known else "done" if at >= 0 else "not begun"
            self.setAccessibleDescription(said)
            self.update()

    def sizeHint(self) -> QSize:
        """Return one line of text with room round it."""
        high = QFontMetrics(ui_font(self._theme.scale, 0.8)).height()
        return QSize(200, high + 12)

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Draw the phases as boxes."""
        painter, t = QPainter(self), self._theme.tokens
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        left = 0.0
        letters = sum(len(name) + PADDING for name in self.phases)
        for index, name in enumerate(self.phases):
            width = self.width() * (len(name) + PADDING) / letters
            box = QRectF(left + 1, 1, width - 2, self.height() - 2)
            left += width
            done, present = index < self.at, index == self.at
            painter.setPen(QPen(t.colour("focus" if present else "border"), 2 if present else 1))
            painter.setBrush(t.colour("raised" if done or present else "bg"))
            painter.drawRoundedRect(box, 4, 4)
            painter.setPen(t.colour("text" if done or present else "muted"))
            painter.setFont(ui_font(self._theme.scale, 0.8, 600 if present else 400))
            text = f"\N{CHECK MARK}{name}" if done else name
            fitted = painter.fontMetrics().elidedText(
                text, Qt.TextElideMode.ElideRight, round(box.width() - 2)
            )
            painter.drawText(box, int(Qt.AlignmentFlag.AlignCenter), fitted)


class ProbePanel(Panel):
    """Probe once, with its progress and result."""

    def __init__(
        self,
        theme: Theme,
        phases: Sequence[str],
        on_probe: Callable[[], None],
        on_cancel: Callable[[], None],
    ) -> None:
        super().__init__("Probe")
        self.values, self.model = label("", "small", wrap=True), ElidedLabel("small")
        self.strip = PhaseStrip(theme, phases)
        self.result = label("No probe yet.", wrap=True)
        self.probe, self.cancel = QPushButton("Probe once"), QPushButton("Cancel")
        self.probe.setProperty("role", "primary")
        self.probe.setAccessibleName("Probe once")
        self.probe.setToolTip("Press here with these values, feel, and lift (F5)")
        self.cancel.setAccessibleName("Cancel the probe")
        self.cancel.setToolTip("End in an orderly way: lift, keep the piece")
        self.probe.clicked.connect(on_probe)
        self.cancel.clicked.connect(on_cancel)
        row = QHBoxLayout()
        row.addWidget(self.probe, 2)
        row.addWidget(self.cancel, 1)
        self.column.addWidget(self.values)
        self.column.addWidget(self.model)
        self.column.addWidget(self.strip)
        self.column.addWidget(self.result)
        self.column.addLayout(row)

    def show_model(self, short: str, full: str) -> None:
        """Say which model reads the probe, with all about it in the tool tip."""
        self.model.setText(short)
        self.model.setToolTip(full)

    def show_buttons(self, *, probe: bool, cancel: bool, why: str) -> None:
        """Enable what is allowed now."""
        if self.probe.isEnabled() != probe:
            self.probe.setEnabled(probe)
        if self.cancel.isEnabled() != cancel:
            self.cancel.setEnabled(cancel)
        self.probe.setToolTip(why or "Press here with these values, feel, and lift (F5)")
