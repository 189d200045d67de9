"""Panels, columns, notes and headers."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from PySide6.QtCore import QEvent, QRectF, QSize, Qt, Signal
from PySide6.QtGui import QKeyEvent, QPainter, QPaintEvent, QResizeEvent
from PySide6.QtWidgets import (
    QComboBox,
    QFrame,
    QHBoxLayout,
    QLabel,
    QScrollArea,
    QSizePolicy,
    QSplitter,
    QSplitterHandle,
    QToolButton,
    QVBoxLayout,
    QWidget,
)

GAP_PX, NUDGE_PX = 8, 16
LEAST_SHARE = 0.02


@dataclass(frozen=True, slots=True)
class ColumnArrangement:
    """``shares`` of the width by column, sum 1; ``hidden``: titles of the panels left out."""

    shares: tuple[float, ...]
    hidden: frozenset[str] = frozenset()


class Columns(QSplitter):
    """``parts``: (column, usual share) from the left; ``panels`` by title can be left out."""

    arranged = Signal()
    """Panels came or went, or an edge was moved."""

    def __init__(
        self,
        parts: Sequence[tuple[QWidget, float]],
        panels: Mapping[str, QWidget],
        *,
        controls_last: bool = False,
    ) -> None:
        super().__init__(Qt.Orientation.Horizontal)
        self.setObjectName("columns")
        self._parts, self.panels = [part for part, _ in parts], dict(panels)
        total = sum(share for _, share in parts)
        self.usual = ColumnArrangement(tuple(share / total for _, share in parts))
        self._now = self.usual
        self.locked, self._leading, self._controls_last = True, False, controls_last
        self.setHandleWidth(GAP_PX)
        for part in self._parts:
            self.addWidget(part)
        self.setChildrenCollapsible(False)
        self.splitterMoved.connect(self._moved)
        self.lock(True)

    def createHandle(self) -> QSplitterHandle:
        """Return an edge that keys can move too."""
        return _ColumnEdge(self)

    def arrangement(self) -> ColumnArrangement:
        """Return how it is arranged now."""
        return self._now

    def hides(self, title: str) -> bool:
        """Whether a panel was left out by the operator."""
        return title in self._now.hidden

    def misfit(self, wanted: ColumnArrangement) -> str:
        """Return "" if ``wanted`` can be shown here, else why not."""
        shares = wanted.shares
        if len(shares) != len(self._parts):
            return f"{len(shares)} columns instead of {len(self._parts)}"
        if not all(math.isfinite(s) and s >= LEAST_SHARE for s in shares):
            return "a column without width"
        if abs(sum(shares) - 1.0) > 0.01:
            return "widths that do not fill the page"
        unknown = sorted(wanted.hidden - set(self.panels))
        return f"no panel '{unknown[0]}' here" if unknown else ""

    def show_arrangement(self, wanted: ColumnArrangement) -> None:
        """Arrange the page so; raises ValueError for one that does not fit."""
        wrong = self.misfit(wanted)
        if wrong:
            raise ValueError(wrong)
        self._now = wanted
        for title, panel in self.panels.items():
            panel.setVisible(title not in wanted.hidden)
        left_out = {self.panels[title] for title in wanted.hidden}
        for part in self._parts:
            part.setVisible(any(child not in left_out for child in _children(part)))
        self._apply()
        self.arranged.emit()

    def show_panel(self, title: str, *, shown: bool) -> None:
        """Leave out one panel, or bring it back; raises KeyError."""
        self.panels[title]
        hidden = self._now.hidden - {title} if shown else self._now.hidden | {title}
        self.show_arrangement(ColumnArrangement(self._now.shares, hidden))

    def lock(self, locked: bool) -> None:
        """Hold the edges, or let them be moved."""
        self.locked = locked
        for index in range(1, self.count()):
            edge = self.handle(index)
            edge.setEnabled(not locked)
            edge.setFocusPolicy(Qt.FocusPolicy.NoFocus if locked else Qt.FocusPolicy.TabFocus)
            shape = Qt.CursorShape.ArrowCursor if locked else Qt.CursorShape.SplitHCursor
            edge.setCursor(shape)

    def take_out(self) -> None:
        """Take the columns out, so that the page is put into a window without them."""
        for part in self._parts:
            part.setParent(None)

    def put_back(self) -> Iterator[None]:
        """Put the columns back, one at a time: each takes the window's style sheet then."""
        for at in self._order():
            self.addWidget(self._parts[at])
            yield
        self.lock(self.locked)
        self._apply()

    def lead_with_controls(self, lead: bool) -> None:
        """Show the controls first, where they are the last column; or in their usual place."""
        if self._controls_last and lead != self._leading:
            self._leading = lead
            self.insertWidget(0 if lead else self.count() - 1, self._parts[-1])
            self.lock(self.locked)
            self._apply()

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Keep the shares, whatever the width."""
        super().resizeEvent(event)
        self._apply()

    # -- inside -----------------------------------------------------------------------------------

    def _order(self) -> list[int]:
        """Return the numbers of the columns from the left."""
        usual = list(range(len(self._parts)))
        return [usual[-1], *usual[:-1]] if self._leading else usual

    def _apply(self) -> None:
        shares = self._now.shares
        self.setSizes([max(1, round(1e5 * shares[k])) for k in self._order()])

    def _moved(self) -> None:
        """Take the widths that the operator made; a hidden column keeps its share."""
        sizes = dict(zip(self._order(), self.sizes(), strict=True))
        seen = [k for k, size in sizes.items() if size > 0]
        room = sum(self._now.shares[k] for k in seen)
        total = max(sum(sizes[k] for k in seen), 1)
        shares = list(self._now.shares)
        for k in seen:
            shares[k] = max(room * sizes[k] / total, LEAST_SHARE)
        whole = sum(shares)
        self._now = ColumnArrangement(tuple(s / whole for s in shares), self._now.hidden)
        self.arranged.emit()


class _ColumnEdge(QSplitterHandle):
    """One edge. With the focus the arrows move it."""

    def __init__(self, columns: Columns) -> None:
        super().__init__(Qt.Orientation.Horizontal, columns)
        self.setAccessibleName("Edge between columns")
        self.setToolTip("Drag, or Tab to it and press the arrows")

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Move by one nudge."""
        steps = {Qt.Key.Key_Left: -NUDGE_PX, Qt.Key.Key_Right: NUDGE_PX}
        step = steps.get(Qt.Key(event.key()))
        if step is None:
            super().keyPressEvent(event)
        else:
            self.moveSplitter(self.x() + step)

    def changeEvent(self, event: QEvent) -> None:
        """Say by the tip whether it can be moved."""
        super().changeEvent(event)
        if event.type() is QEvent.Type.EnabledChange:
            tip = "Drag, or Tab to it and press the arrows"
            self.setToolTip(tip if self.isEnabled() else "")


def _children(part: QWidget) -> list[QWidget]:
    """Return the widgets that stand in a column, or the column itself if it is a panel."""
    if part.property("role") == "card":
        return [part]
    return [c for c in part.children() if isinstance(c, QWidget)]


class ElidedLabel(QLabel):
    """Takes the width it is given; a cut text says so and is whole in the tool tip."""

    def __init__(self, role: str) -> None:
        super().__init__()
        self.setTextFormat(Qt.TextFormat.PlainText)
        self.setProperty("role", role)
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)

    def minimumSizeHint(self) -> QSize:
        """Return no width: the row decides."""
        return QSize(0, super().minimumSizeHint().height())

    def shown(self) -> str:
        """Return the text as it is drawn at the present width."""
        mode = Qt.TextElideMode.ElideRight
        return self.fontMetrics().elidedText(self.text(), mode, self.width())

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Draw as much as there is room for."""
        painter = QPainter(self)
        painter.setPen(self.palette().color(self.foregroundRole()))
        painter.drawText(QRectF(self.rect()), int(self.alignment()), self.shown())


HEADER_PX = 28
"""Least height of every header, the room of its tools: the titles of neighbours are in line."""


class Panel(QFrame):
    """Frame round one view. ``detail`` is the right-hand text of the header."""

    def __init__(self, title: str, body: QWidget | None = None) -> None:
        super().__init__()
        self.setProperty("role", "card")
        self.setAccessibleName(title)
        self._title = label(title, "title")
        self.detail = ElidedLabel("small")
        self.detail.setAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
        header = QHBoxLayout()
        header.addStrut(HEADER_PX)
        header.addWidget(self._title)
        header.addWidget(self.detail, 1)
        self.header = header
        self.column = QVBoxLayout(self)
        self.column.setContentsMargins(10, 2, 10, 10)
        self.column.setSpacing(6)
        self.column.addLayout(header)
        if body is not None:
            self.column.addWidget(body, 1)

    def rename(self, title: str) -> None:
        """Give the panel another title."""
        if title != self._title.text():
            self._title.setText(title)
            self.setAccessibleName(title)


class CaptionedView(QWidget):
    """A view under a line with its name and, at the right, live details."""

    def __init__(self, title: str, body: QWidget) -> None:
        super().__init__()
        self.detail = ElidedLabel("small")
        self.detail.setAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
        line = QHBoxLayout()
        line.addWidget(label(title, "muted"))
        line.addWidget(self.detail, 1)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.setSpacing(4)
        column.addLayout(line)
        column.addWidget(body, 1)


def label(text: str, role: str = "", *, wrap: bool = False) -> QLabel:
    """Return a plain-text label with a role of the style sheet."""
    made = QLabel(text)
    made.setTextFormat(Qt.TextFormat.PlainText)
    made.setWordWrap(wrap)
    if role:
        made.setProperty("role", role)
    return made


def rule() -> QFrame:
    """Return a thin horizontal line."""
    line = QFrame()
    line.setProperty("role", "rule")
    return line


def set_property(widget: QWidget, name: str, value: str) -> None:
    """Set a style-sheet property and restyle, only if it changed."""
    if widget.property(name) == value:
        return
    widget.setProperty(name, value)
    widget.style().unpolish(widget)
    widget.style().polish(widget)


LEAST_LINES = 2


class ScrollingNote(QScrollArea):
    """A label in a scroll area; never over its neighbours."""

    def __init__(self, name: str) -> None:
        super().__init__()
        self._label = label("", "small", wrap=True)
        self._label.setAlignment(Qt.AlignmentFlag.AlignTop)
        self._label.setAccessibleName(name)
        self.setWidget(self._label)
        self.setWidgetResizable(True)
        self.setFrameShape(QFrame.Shape.NoFrame)
        self.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Preferred)

    def text(self) -> str:
        """Return the words."""
        return self._label.text()

    def setText(self, text: str) -> None:
        """Show these words; their beginning stays in sight."""
        if text != self.text():
            self._label.setText(text)
            self.setToolTip(text)
            self.verticalScrollBar().setValue(0)
            self._fit()

    def sizeHint(self) -> QSize:
        """Return the room of all lines at the present width."""
        return QSize(120, self._needed())

    def minimumSizeHint(self) -> QSize:
        """Return the room of the first lines."""
        least = LEAST_LINES * self._label.fontMetrics().lineSpacing() + 2
        return QSize(60, min(least, self._needed()))

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Take the lines of the new width."""
        super().resizeEvent(event)
        if event.size().width() != event.oldSize().width():
            self._fit()

    def _needed(self) -> int:
        if not self.text():
            return 0
        return max(self._label.heightForWidth(max(self.viewport().width(), 60)), 0) + 2

    def _fit(self) -> None:
        self.setMaximumHeight(self._needed())
        self.updateGeometry()


def compact_combo_box(texts: Sequence[str], name: str) -> QComboBox:
    """Return a compact choice; ``name`` is said to screen readers and by the tip."""
    made = QComboBox()
    made.addItems(list(texts))
    made.setProperty("role", "compact")
    made.setAccessibleName(name)
    made.setToolTip(name)
    return made


def flat_button(text: str, tip: str, *, checkable: bool = False) -> QToolButton:
    """Return a flat button."""
    made = QToolButton()
    made.setText(text)
    made.setProperty("role", "plain")
    made.setToolTip(tip)
    made.setAccessibleName(tip)
    made.setCheckable(checkable)
    return made
