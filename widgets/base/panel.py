"""Panels, columns, notes and headers."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

from PySide6.QtCore import QCoreApplication, QEvent, QRect, QRectF, QSize, Qt, Signal
from PySide6.QtGui import QKeyEvent, QPainter, QPaintEvent, QResizeEvent
from PySide6.QtWidgets import (
    QBoxLayout,
    QComboBox,
    QFrame,
    QHBoxLayout,
    QLabel,
    QLayout,
    QLayoutItem,
    QPushButton,
    QScrollArea,
    QSizePolicy,
    QSplitter,
    QSplitterHandle,
    QToolButton,
    QVBoxLayout,
    QWidget,
)

_Box = TypeVar("_Box", bound=QBoxLayout)
CONTEXT = "touchdown"  # of all texts in files of translations
GAP_PX, NUDGE_PX = 8, 16
LEAST_SHARE = 0.02


@dataclass(frozen=True, slots=True)
class ColumnArrangement:
    """Column widths as ``shares`` of the page (sum 1), and titles of the ``hidden`` panels."""

    shares: tuple[float, ...]
    hidden: frozenset[str] = frozenset()


class Columns(QSplitter):
    """Splitter of the columns of a page.

    ``parts``: (column, default share) from the left. ``panels``: panels that can be hidden, by
    title.
    """

    # A panel was shown or hidden, or an edge was moved.
    arranged = Signal()

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
        """Return an edge that can be moved with the keyboard too."""
        return _ColumnEdge(self)

    def arrangement(self) -> ColumnArrangement:
        """Return the present arrangement."""
        return self._now

    def hides(self, title: str) -> bool:
        """Return True if the operator has hidden this panel."""
        return title in self._now.hidden

    def misfit(self, wanted: ColumnArrangement) -> str:
        """Return "" if ``wanted`` fits this page, else the reason."""
        shares = wanted.shares
        if len(shares) != len(self._parts):
            return tr("{} columns instead of {}", len(shares), len(self._parts))
        if not all(math.isfinite(s) and s >= LEAST_SHARE for s in shares):
            return tr("a column without width")
        if abs(sum(shares) - 1.0) > 0.01:
            return tr("widths that do not fill the page")
        unknown = sorted(wanted.hidden - set(self.panels))
        return tr("no panel '{}' here", unknown[0]) if unknown else ""

    def show_arrangement(self, wanted: ColumnArrangement) -> None:
        """Apply an arrangement; raises ValueError if it does not fit."""
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
        """Hide one panel or show it again; raises KeyError for an unknown title."""
        self.panels[title]
        hidden = self._now.hidden - {title} if shown else self._now.hidden | {title}
        self.show_arrangement(ColumnArrangement(self._now.shares, hidden))

    def lock(self, locked: bool) -> None:
        """Lock or unlock the edges."""
        self.locked = locked
        for index in range(1, self.count()):
            edge = self.handle(index)
            edge.setEnabled(not locked)
            edge.setFocusPolicy(Qt.FocusPolicy.NoFocus if locked else Qt.FocusPolicy.TabFocus)
            shape = Qt.CursorShape.ArrowCursor if locked else Qt.CursorShape.SplitHCursor
            edge.setCursor(shape)

    def take_out(self) -> None:
        """Detach the columns, so that the page can be added to a window without them."""
        for part in self._parts:
            part.setParent(None)

    def put_back(self) -> Iterator[None]:
        """Attach the columns again, one per step; each takes over the style sheet of the window."""
        for at in self._order():
            self.addWidget(self._parts[at])
            yield
        self.lock(self.locked)
        self._apply()

    def lead_with_controls(self, lead: bool) -> None:
        """Show the column of controls first or, if not ``lead``, at its default place, last."""
        if self._controls_last and lead != self._leading:
            self._leading = lead
            self.insertWidget(0 if lead else self.count() - 1, self._parts[-1])
            self.lock(self.locked)
            self._apply()

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Keep the shares at the new width."""
        super().resizeEvent(event)
        self._apply()

    def _order(self) -> list[int]:
        usual = list(range(len(self._parts)))
        return [usual[-1], *usual[:-1]] if self._leading else usual

    def _apply(self) -> None:
        shares = self._now.shares
        self.setSizes([max(1, round(1e5 * shares[k])) for k in self._order()])

    def _moved(self) -> None:
        """Read the widths set by the operator; a hidden column keeps its share."""
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
    """Edge between two columns; the arrow keys move it while it has the focus."""

    def __init__(self, columns: Columns) -> None:
        super().__init__(Qt.Orientation.Horizontal, columns)
        self.setAccessibleName(tr("Edge between columns"))

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Move the edge by one step."""
        steps = {Qt.Key.Key_Left: -NUDGE_PX, Qt.Key.Key_Right: NUDGE_PX}
        step = steps.get(Qt.Key(event.key()))
        if step is None:
            super().keyPressEvent(event)
        else:
            self.moveSplitter(self.x() + step)

    def changeEvent(self, event: QEvent) -> None:
        """Show the tool tip only while the edge can be moved."""
        super().changeEvent(event)
        if event.type() is QEvent.Type.EnabledChange:
            tip = tr("Drag, or Tab to it and press the arrows")
            self.setToolTip(tip if self.isEnabled() else "")


def _children(part: QWidget) -> list[QWidget]:
    """Return the panels of a column; a column that is a panel itself is its only one."""
    if part.property("role") == "card":
        return [part]
    return [c for c in part.children() if isinstance(c, QWidget)]


class ElidedLabel(QLabel):
    """Label that adapts to its width: a text cut off ends with an ellipsis."""

    def __init__(self, role: str) -> None:
        super().__init__()
        self.setTextFormat(Qt.TextFormat.PlainText)
        self.setProperty("role", role)
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)

    def minimumSizeHint(self) -> QSize:
        """Return no width; the row decides."""
        return QSize(0, super().minimumSizeHint().height())

    def shown(self) -> str:
        """Return the text as drawn at the present width."""
        mode = Qt.TextElideMode.ElideRight
        return self.fontMetrics().elidedText(self.text(), mode, self.width())

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Draw the text elided to the width."""
        painter = QPainter(self)
        painter.setPen(self.palette().color(self.foregroundRole()))
        painter.drawText(QRectF(self.rect()), int(self.alignment()), self.shown())


def tr(text: str, *values: object) -> str:
    """Return a text in the language of the window, with ``values`` in its braces.

    The widgets and functions here translate the names, titles and tool tips that they are given.
    """
    shown = QCoreApplication.translate(CONTEXT, text) if text else ""
    return shown.format(*values) if values else shown


def count_noun(count: int, noun: str) -> str:
    """Return a number with its noun: "1 probe", "1,200 probes".

    Files of translations hold the forms of ``%n probes``.
    """
    source = f"%n {noun}s"
    shown = QCoreApplication.translate(CONTEXT, source, None, count)
    if shown == source.replace("%n", str(count)):  # no translation
        return f"{count:,} {noun}" if count == 1 else f"{count:,} {noun}s"
    return shown


def describe(*rows: tuple[QWidget, str, str]) -> None:
    """Set the accessible name and the tool tip of each widget."""
    for widget, name, tip in rows:
        widget.setAccessibleName(tr(name))
        widget.setToolTip(tr(tip))


def _detail() -> ElidedLabel:
    made = ElidedLabel("small")
    made.setAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
    return made


HEADER_PX = 28  # height of every header, so that titles of neighbouring panels align


class Panel(QFrame):
    """Card with a header round one view. ``detail`` is the text at the right of the header."""

    def __init__(self, title: str, body: QWidget | None = None) -> None:
        super().__init__()
        self.setProperty("role", "card")
        self.setAccessibleName(tr(title))
        self._title, self.detail = label(title, "title"), _detail()
        self.header = hbox(self._title, (self.detail, 1))
        self.header.addStrut(HEADER_PX)
        self.column = vbox(self.header, parent=self, margins=(10, 2, 10, 10), spacing=6)
        if body is not None:
            self.column.addWidget(body, 1)

    def rename(self, title: str) -> None:
        """Change the title."""
        self._title.setText(tr(title))
        self.setAccessibleName(self._title.text())


class CaptionedView(QWidget):
    """View below a line with its name at the left and live details at the right."""

    def __init__(self, title: str, body: QWidget) -> None:
        super().__init__()
        self.detail = _detail()
        line = hbox(label(title, "muted"), (self.detail, 1))
        vbox(line, (body, 1), parent=self, margins=(0, 0, 0, 0), spacing=4)


Margins = tuple[int, int, int, int]
Item = QWidget | QLayout | int | tuple[QWidget | QLayout, int]


def hbox(
    *items: Item,
    parent: QWidget | None = None,
    margins: Margins | None = None,
    spacing: int | None = None,
) -> QHBoxLayout:
    """Return a row of widgets and layouts; ``(item, n)`` sets a stretch, ``n`` alone adds one."""
    return _fill(QHBoxLayout() if parent is None else QHBoxLayout(parent), items, margins, spacing)


def vbox(
    *items: Item,
    parent: QWidget | None = None,
    margins: Margins | None = None,
    spacing: int | None = None,
) -> QVBoxLayout:
    """Return a column of widgets and layouts, with items as in ``hbox``."""
    return _fill(QVBoxLayout() if parent is None else QVBoxLayout(parent), items, margins, spacing)


def add_items(box: QBoxLayout, *items: Item) -> None:
    """Append items to a row or column, with items as in ``hbox``."""
    _fill(box, items, None, None)


def _fill(box: _Box, items: Sequence[Item], margins: Margins | None, spacing: int | None) -> _Box:
    if margins is not None:
        box.setContentsMargins(*margins)
    if spacing is not None:
        box.setSpacing(spacing)
    for item in items:
        part, stretch = item if isinstance(item, tuple) else (item, 0)
        if isinstance(part, int):
            box.addStretch(part)
        elif isinstance(part, QWidget):
            box.addWidget(part, stretch)
        else:
            box.addLayout(part, stretch)
    return box


class FlowLayout(QLayout):
    """Row that wraps to more lines where its width ends.

    Items are widgets, or ``(widget, n)``: at least ``n`` px wide, takes the rest of its line.
    """

    def __init__(
        self, *items: QWidget | tuple[QWidget, int], parent: QWidget | None = None,
        margins: Margins = (0, 0, 0, 0), spacing: int = GAP_PX,
    ) -> None:  # fmt: skip
        super().__init__(*(() if parent is None else (parent,)))
        self._items, self._least_px = list[QLayoutItem](), dict[QWidget | None, int]()
        self.setContentsMargins(*margins)
        self.setSpacing(spacing)
        for item in items:
            widget, least_px = item if isinstance(item, tuple) else (item, 0)
            self.addWidget(widget)
            if least_px:
                self._least_px[widget] = least_px

    def addItem(self, item: QLayoutItem, /) -> None:
        """Append an item."""
        self._items.append(item)

    def count(self) -> int:
        """Return the number of items."""
        return len(self._items)

    def itemAt(self, index: int, /) -> QLayoutItem | None:
        """Return an item, None outside of the row."""
        return self._items[index] if 0 <= index < len(self._items) else None

    def takeAt(self, index: int, /) -> QLayoutItem | None:
        """Remove an item."""
        return self._items.pop(index) if 0 <= index < len(self._items) else None

    def hasHeightForWidth(self) -> bool:
        """Return True."""
        return True

    def heightForWidth(self, width: int, /) -> int:
        """Return the height of all lines at this width."""
        return self._place(QRect(0, 0, width, 0), move=False)

    def setGeometry(self, rect: QRect, /) -> None:
        """Place the items."""
        super().setGeometry(rect)
        self._place(rect, move=True)

    def sizeHint(self) -> QSize:
        """Return the size of one line."""
        shown = self._shown()
        width = sum(width + self.spacing() for _, width, _ in shown) - self.spacing()
        # A text that wraps hints at several lines.
        sizes = (i.minimumSize() if i.hasHeightForWidth() else i.sizeHint() for i, *_ in shown)
        height = max((size.height() for size in sizes), default=0)
        return QSize(max(width, 0), height).grownBy(self.contentsMargins())

    def minimumSize(self) -> QSize:
        """Return the size of the widest item; other lines come from ``heightForWidth``."""
        size = QSize(0, 0)
        for item, *_ in self._shown():
            size = size.expandedTo(item.minimumSize())
        return size.grownBy(self.contentsMargins())

    def _shown(self) -> list[tuple[QLayoutItem, int, bool]]:
        """Return item, wanted width and True if it takes the rest of its line, per shown item."""
        least_px = self._least_px
        return [
            (item, least_px.get(item.widget(), item.sizeHint().width()), item.widget() in least_px)
            for item in self._items
            if not item.isEmpty()
        ]

    def _place(self, rect: QRect, *, move: bool) -> int:
        """Fill line after line; return the height."""
        room = rect.marginsRemoved(self.contentsMargins())
        lines, left = list[list[tuple[QLayoutItem, int, bool]]](), 0
        for shown in self._shown():
            if not lines or shown[1] > left:
                lines.append([])
                left = room.width()
            lines[-1].append(shown)
            left -= shown[1] + self.spacing()
        y = room.y()
        for line in lines:
            x, taken = room.x(), sum(width + self.spacing() for _, width, _ in line)
            rest = max(room.width() + self.spacing() - taken, 0)
            widths = [min(width + rest * grows, room.width()) for _, width, grows in line]
            heights = [_height(item, width) for (item, *_), width in zip(line, widths, strict=True)]
            for (item, *_), width, high in zip(line, widths, heights, strict=True):
                if move:
                    at_top = item.alignment() & Qt.AlignmentFlag.AlignTop
                    below = 0 if at_top else (max(heights) - high) // 2
                    item.setGeometry(QRect(x, y + below, width, high))
                x += width + self.spacing()
            y += max(heights) + self.spacing() // 2
        return y - room.y() - (self.spacing() // 2 if lines else 0) + rect.height() - room.height()


def _height(item: QLayoutItem, width: int) -> int:
    return item.heightForWidth(width) if item.hasHeightForWidth() else item.sizeHint().height()


def label(text: str, role: str = "", *, wrap: bool = False) -> QLabel:
    """Return a plain-text label with a role of the style sheet."""
    made = QLabel(tr(text))
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
    """Set a style-sheet property; restyle the widget only if the value changed."""
    if widget.property(name) == value:
        return
    widget.setProperty(name, value)
    widget.style().unpolish(widget)
    widget.style().polish(widget)


def scroll_area(widget: QWidget | None = None) -> QScrollArea:
    """Return a scroll area without a frame; ``widget`` takes its width."""
    made = QScrollArea()
    made.setWidgetResizable(True)
    made.setFrameShape(QFrame.Shape.NoFrame)
    if widget is not None:
        made.setWidget(widget)
    return made


LEAST_LINES = 2


class ScrollingNote(QScrollArea):
    """Label in a scroll area, so that a long text does not overlap its neighbours."""

    def __init__(self, name: str) -> None:
        super().__init__()
        self._label = label("", "small", wrap=True)
        self._label.setAlignment(Qt.AlignmentFlag.AlignTop)
        self._label.setAccessibleName(tr(name))
        self.setWidget(self._label)
        self.setWidgetResizable(True)
        self.setFrameShape(QFrame.Shape.NoFrame)
        self.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Preferred)

    def text(self) -> str:
        """Return the text."""
        return self._label.text()

    def setText(self, text: str) -> None:
        """Set the text and scroll to its start."""
        if text != self.text():
            self._label.setText(text)
            self.setToolTip(text)
            self.verticalScrollBar().setValue(0)
            self._fit()

    def sizeHint(self) -> QSize:
        """Return the size of the whole text at the present width."""
        return QSize(120, self._needed())

    def minimumSizeHint(self) -> QSize:
        """Return the size of the first two lines."""
        least = LEAST_LINES * self._label.fontMetrics().lineSpacing() + 2
        return QSize(60, min(least, self._needed()))

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Fit the height to the new width."""
        super().resizeEvent(event)
        if event.size().width() != event.oldSize().width():
            self._fit()
        cut = self.height() % self._label.fontMetrics().lineSpacing()
        below = cut if self.height() < self._needed() else 0  # whole lines
        if below != self.viewportMargins().bottom():
            self.setViewportMargins(0, 0, 0, below)

    def _needed(self) -> int:
        if not self.text():
            return 0
        return max(self._label.heightForWidth(max(self.viewport().width(), 60)), 0) + 2

    def _fit(self) -> None:
        self.setMaximumHeight(self._needed())
        self.updateGeometry()


def compact_combo_box(texts: Sequence[str], name: str) -> QComboBox:
    """Return a small combo box; ``name`` is its accessible name and tool tip."""
    made = QComboBox()
    made.addItems([tr(text) for text in texts])
    made.setProperty("role", "compact")
    describe((made, name, name))
    return made


def push_button(
    text: str = "", tip: str = "", *, role: str = "", checkable: bool = False
) -> QPushButton:
    """Return a button with a role of the style sheet."""
    made = QPushButton(tr(text))
    made.setToolTip(tr(tip))
    made.setCheckable(checkable)
    if role:
        made.setProperty("role", role)
    return made


def flat_button(text: str, tip: str, *, checkable: bool = False) -> QToolButton:
    """Return a flat button."""
    made = QToolButton()
    made.setText(tr(text))
    made.setProperty("role", "plain")
    describe((made, tip, tip))
    made.setCheckable(checkable)
    return made
