"""Columns of a page: their edges move and their panels come and go, but only while unlocked.

An arrangement is a few numbers and names, never a blob of the toolkit: one that was written by
another version, or damaged, can be judged before it is used and cannot crash anything.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from PySide6.QtCore import QEvent, Qt, Signal
from PySide6.QtGui import QKeyEvent, QResizeEvent
from PySide6.QtWidgets import QSplitter, QSplitterHandle, QWidget

GAP_PX, NUDGE_PX = 8, 16
LEAST_SHARE = 0.02


@dataclass(frozen=True, slots=True)
class Arrangement:
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
        self.usual = Arrangement(tuple(share / total for _, share in parts))
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
        return _Edge(self)

    def arrangement(self) -> Arrangement:
        """Return how it is arranged now."""
        return self._now

    def hides(self, title: str) -> bool:
        """Whether a panel was left out by the operator."""
        return title in self._now.hidden

    def misfit(self, wanted: Arrangement) -> str:
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

    def show_arrangement(self, wanted: Arrangement) -> None:
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
        self.show_arrangement(Arrangement(self._now.shares, hidden))

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
        self._now = Arrangement(tuple(s / whole for s in shares), self._now.hidden)
        self.arranged.emit()


class _Edge(QSplitterHandle):
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
