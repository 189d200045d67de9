"""Probe and gripper panels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from PySide6.QtCore import QRectF, QSize, Qt
from PySide6.QtGui import QFontMetrics, QPainter, QPaintEvent
from PySide6.QtWidgets import QGridLayout, QPushButton, QSizePolicy, QWidget

from touchdown.widgets import base
from touchdown.widgets.forms.fields import decimal_box, field_label, inset_spin_boxes

PADDING = 3  # width added to a phase name, in letters


class PhaseStrip(QWidget):
    """Phases in a row: completed ones are ticked, the present one is bold."""

    def __init__(self, theme: base.Theme, phases: Sequence[str]) -> None:
        super().__init__()
        self._theme, self.phases, self.at = theme, tuple(map(base.tr, phases)), -1
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
        self.setAccessibleName(base.tr("Phases of the probe"))

    def show_phase(self, at: int) -> None:
        """Show the present phase; -1: none yet, beyond the last: all done."""
        if at != self.at:
            self.at = at
            known = 0 <= at < len(self.phases)
            said = self.phases[at] if known else "done" if at >= 0 else "not begun"
            self.setAccessibleDescription(base.tr(said))
            self.update()

    def sizeHint(self) -> QSize:
        """Return one line of text with padding."""
        high = QFontMetrics(base.ui_font(self._theme.scale, 0.8)).height()
        return QSize(200, high + 12)

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Draw the phases as text."""
        painter, t = QPainter(self), self._theme.tokens
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        left = 0.0
        letters = sum(len(name) + PADDING for name in self.phases)
        for index, name in enumerate(self.phases):
            width = self.width() * (len(name) + PADDING) / letters
            box = QRectF(left + 1, 1, width - 2, self.height() - 2)
            left += width
            done, present = index < self.at, index == self.at
            painter.setFont(base.ui_font(self._theme.scale, 0.8, 600 if present else 400))
            painter.setPen(t.colour("focus" if present else "text" if done else "muted"))
            text = f"\N{CHECK MARK}{name}" if done else name
            room, mode = round(box.width() - 2), Qt.TextElideMode.ElideRight
            fitted = painter.fontMetrics().elidedText(text, mode, room)
            painter.drawText(box, int(Qt.AlignmentFlag.AlignCenter), fitted)


class ProbePanel(base.Panel):
    """Starts a single probe and shows its progress and result."""

    def __init__(self, theme: base.Theme, phases: Sequence[str]) -> None:
        super().__init__("Probe")
        self.values, self.model = base.label("", "small", wrap=True), self.detail
        self.strip = PhaseStrip(theme, phases)
        self._buttons: tuple[bool, bool, str] | None = None  # as shown last
        # Two lines in a narrow column, so that the page knows the height that it needs.
        self.values.setMinimumHeight(2 * self.values.fontMetrics().height())
        self.result = base.label("No probe yet.", wrap=True)
        self.probe = base.push_button("Probe once", role="primary")
        self.cancel = base.push_button("Cancel")
        base.describe(
            (self.probe, "Probe once", "Press here with these values, record, and lift (F5)"),
            (self.cancel, "Cancel the probe", "End the run: lift the arm, keep the grip"),
        )
        row = base.hbox((self.probe, 2), (self.cancel, 1))
        base.add_items(self.column, self.values, self.strip, self.result, row)

    def show_model(self, short: str, full: str) -> None:
        """Show the model in use in the header; the tool tip has the details."""
        self.model.setText(short)
        self.model.setToolTip(full)

    def show_buttons(self, *, probe: bool, cancel: bool, why: str) -> None:
        """Enable the buttons; ``why``: reason for a disabled one."""
        if (probe, cancel, why) == self._buttons:
            return
        self._buttons = probe, cancel, why
        self.probe.setEnabled(probe)
        self.cancel.setEnabled(cancel)
        self.probe.setToolTip(base.tr(why or "Press here with these values, record, and lift (F5)"))


DECISIONS: tuple[tuple[str, str, str, str], ...] = (
    ("keep", "Keep", "Enter", "Keep the probe and go on (Enter, F5)"),
    ("discard", "Discard", "Backspace",
     "Delete it; probe the same place again at the end (Backspace)"),
    ("flag", "Flag", "X", "Keep it and flag it for review (X)"),
    ("redo", "Redo", "R", "Delete it and probe the same place again at once (R)"),
    ("skip", "Skip", "S", "Delete it and skip its place (S)"),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class ProbeText:
    """Texts of a probe. ``tone``: good, bad or "". ``asking``: the run waits for a decision."""

    result: str
    tone: str = ""
    where: str = ""
    detail: str = ""
    asking: bool = False
    allowed: tuple[str, ...] = ()


class LastProbePanel(base.Panel):
    """Result and displacement of the last probe, one button per decision."""

    def __init__(self, decide: Callable[[str], None]) -> None:
        super().__init__("Probe")
        self.result = base.label("No probe yet", "head", wrap=True)
        self.where, self.words = base.ElidedLabel("small"), base.label("", "small", wrap=True)
        self.words.setAlignment(Qt.AlignmentFlag.AlignTop)
        self.words.setMinimumHeight(2 * self.fontMetrics().lineSpacing())
        self.buttons: dict[str, QPushButton] = {}
        grid = QGridLayout()
        grid.setSpacing(6)
        for at, (name, text, key, tip) in enumerate(DECISIONS):
            button = QPushButton(f"{base.tr(text)}  ({key})")
            base.describe((button, text, tip))
            button.setFocusPolicy(Qt.FocusPolicy.NoFocus)
            button.clicked.connect(lambda _=False, name=name: decide(name))
            self.buttons[name] = button
            row, column, span = (0, 3 * at, 3) if at < 2 else (1, 2 * (at - 2), 2)
            grid.addWidget(button, row, column, 1, span)
        base.add_items(self.column, self.result, self.where, self.words, grid)
        self.show_words(ProbeText("No probe yet"))

    def show_words(self, words: ProbeText) -> None:
        """Show the texts of a probe; enable the ``allowed`` decisions."""
        self.result.setText(base.tr(words.result))
        base.set_property(self.result, "tone", words.tone)
        self.where.setText(words.where)
        self.words.setText(words.detail)
        self.detail.setText(base.tr("waiting for you" if words.asking else ""))
        for name, button in self.buttons.items():
            button.setEnabled(name in words.allowed)
        said = (base.tr(words.result), words.where, words.detail)
        self.setAccessibleDescription(". ".join(said))


class PairHealthPanel(base.Panel):
    """Problems in the collected data, one per line, worst first."""

    MOST = 4

    def __init__(self) -> None:
        super().__init__("Health")
        self.words = base.label("No probe checked yet.", "small", wrap=True)
        self.words.setAlignment(Qt.AlignmentFlag.AlignTop)
        self.column.addWidget(self.words, 1)

    def show_findings(self, texts: Sequence[str], *, judged: int) -> None:
        """Show the problems of ``judged`` probes; the tool tip has all of them."""
        probes = base.count_noun(judged, "probe")
        self.detail.setText(base.tr("{} in {}", len(texts), probes) if texts else probes)
        if not judged:
            self.words.setText(base.tr("No probe checked yet."))
        elif not texts:
            self.words.setText(base.tr("\N{CHECK MARK} No problem found."))
        else:
            more = len(texts) - self.MOST
            tail = [base.tr("and {} more", more)] if more > 0 else []
            self.words.setText("\n".join([*texts[: self.MOST], *tail]))
        self.words.setToolTip("\n".join(texts[:40]))


USUAL_N, LEAST_N, MOST_N = 10.0, 1.0, 40.0


class GripperPanel(base.Panel):
    """Status of the gripper; buttons to grip and open."""

    def __init__(self) -> None:
        super().__init__("Gripper")
        self.figures = base.label("No data")
        self.force = decimal_box(LEAST_N, MOST_N, decimals=1)
        self.force.setValue(USUAL_N)
        self.force.setSuffix(" N")
        inset_spin_boxes(self.force)
        base.describe((self.force, "Grip force per finger", "Force per finger for the next grip"))
        self.grip, self.open = base.push_button("Grip"), base.push_button("Open")
        asks = "Open the jaws; asks first while a piece is held (Shift+G)"
        base.describe(
            (self.grip, "Grip the gripper", "Close on the piece with this force (G)"),
            (self.open, "Open the gripper", asks),
        )
        row = base.hbox(
            field_label("Force", self.force), (self.force, 1), (self.grip, 1), (self.open, 1)
        )
        base.add_items(self.column, self.figures, row)

    def show_status(self, width_mm: float, force_n: float, *, holding: bool, moving: bool) -> None:
        """Show width, force per finger and state."""
        word = base.tr("moving" if moving else "holding a piece" if holding else "empty")
        self.figures.setText(f"{width_mm:.1f} mm   {force_n:.1f} N   {word}")

    def show_ready(self, ready: bool) -> None:
        """Enable or disable the buttons."""
        for button in (self.grip, self.open):
            button.setEnabled(ready)
