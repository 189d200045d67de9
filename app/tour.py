"""The first-run tour over the workspaces."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

from PySide6.QtCore import QEvent, QObject, QPoint, QRect
from PySide6.QtWidgets import QApplication, QScrollArea, QWidget

from touchdown.app.collect import COLLECT, CollectWorkspace
from touchdown.app.operate import OperateWorkspace
from touchdown.app.review import ReviewWorkspace
from touchdown.app.shell import MainWindow, Workspace
from touchdown.app.stack import StackWorkspace
from touchdown.app.train import TrainWorkspace
from touchdown.widgets.base import Theme
from touchdown.widgets.shell import RING_PX, Spotlight, TopBar, TourCard, TourStop

FOLLOWED = frozenset({QEvent.Type.Resize, QEvent.Type.Move, QEvent.Type.Show, QEvent.Type.Hide})


class Tour(QObject):
    """The tour of the window. ``make`` returns the stops; ``done`` is called at the end.

    Fault cards stay visible during the tour.
    """

    def __init__(
        self,
        theme: Theme,
        window: MainWindow,
        cards: QWidget,
        make: Callable[[], Sequence[TourStop]],
        go: Callable[[str], None],
        done: Callable[[], None],
    ) -> None:
        super().__init__(window)
        self._theme, self._window, self._cards, self._make = theme, window, cards, make
        self._go, self._done = go, done
        self.stops: Sequence[TourStop] = ()
        self.at = -1
        self._came_from = ""
        self._place: QWidget | None = None
        self.spotlight: Spotlight | None = None
        self.card: TourCard | None = None

    @property
    def active(self) -> bool:
        """True during the tour."""
        return self.at >= 0

    def begin(self) -> None:
        """Start with the first stop."""
        self.end()
        self.spotlight = Spotlight(self._theme, self._window)
        self.card = TourCard(self._window, self.turn, self.end)
        self.stops, self.at, self._came_from = self._make(), 0, self._window.front
        for followed in (self._window, self._cards):
            followed.installEventFilter(self)
        self._show()

    def turn(self, by: int) -> None:
        """Go to the next or previous stop; the tour ends after the last one."""
        self.at += by
        if self.at >= len(self.stops):
            self.end()
        else:
            self.at = max(self.at, 0)
            self._show()

    def end(self) -> None:
        """End the tour where it began. May be called twice."""
        if not self.active or self.card is None or self.spotlight is None:
            return
        self.at = -1
        for followed in (self._window, self._cards):
            followed.removeEventFilter(self)
        for widget in (self.card, self.spotlight):
            widget.hide()
            widget.deleteLater()
        self.card = self.spotlight = None
        if self._window.front != self._came_from:
            self._go(self._came_from)
        self._done()

    def eventFilter(self, _watched: QObject, event: QEvent) -> bool:
        """Follow changes of the window and of its cards."""
        if event.type() in FOLLOWED:
            self.fit()
        return False

    def fit(self) -> None:
        """Move to the present position of the stop."""
        if not self.active or self.card is None or self.spotlight is None:
            return
        hole = QRect() if self._place is None else self._hole(self._place)
        cards = self._hole(self._cards, 0)
        self.spotlight.show_hole(hole, cards)
        bar = self._window.findChild(TopBar)
        top = 0 if bar is None else bar.mapTo(self._window, bar.rect().bottomLeft()).y()
        self.card.fit(hole, top, self._window.height() if cards.isEmpty() else cards.top())
        self.card.raise_()

    def _show(self) -> None:
        stop = self.stops[self.at]
        if stop.workspace and stop.workspace != self._window.front:
            self._go(stop.workspace)
        # The positions are known only after the layout of the page.
        QApplication.sendPostedEvents(None, QEvent.Type.LayoutRequest)
        self._place = stop.place()
        for scroll in self._window.findChildren(QScrollArea):
            if scroll.isAncestorOf(self._place):
                scroll.ensureWidgetVisible(self._place)
        assert self.card is not None
        self.card.show_stop(stop, self.at, len(self.stops))
        self.fit()

    def _hole(self, place: QWidget, ring: int = RING_PX) -> QRect:
        if not place.isVisibleTo(self._window):
            return QRect()
        corner = place.mapTo(self._window, QPoint(0, 0))
        lit = QRect(corner, place.size()).adjusted(-ring, -ring, ring, ring)
        return lit.intersected(self._window.rect())


def tour_stops(
    window: MainWindow, bar: TopBar, workspaces: Mapping[str, Workspace]
) -> tuple[TourStop, ...]:
    """Return the stops, in the order of a working day."""
    return (
        TourStop("", lambda: bar.pill, "This bench is simulated",
                 "Fingers, wrench, arm and gripper are computed, so nothing can break. This field "
                 "shows the state of the bench. Click a device beside it for its raw values."),
        TourStop("", lambda: bar.stop, "STOP is everywhere",
                 "It halts arm and gripper at once and keeps the grip. F12 does the same from "
                 "every page, dialog and text field. Then look at the bench and press Reset."),
        TourStop("", lambda: window.rail["operate"], "Five workspaces",
                 "Operate, Collect & Label, Train, Stack, Review: Ctrl+1 to Ctrl+5."),
        TourStop("operate", lambda: _of(workspaces, OperateWorkspace).page.jog, "Move by hand",
                 "Hold a pad: the arm moves as long as you hold it, or one step a press. Every pad "
                 "says how far it may go."),
        TourStop("operate", lambda: _of(workspaces, OperateWorkspace).page.probe, "Probe once",
                 "Presses at the position of the arm and shows the result (F5)."),
        TourStop("collect", lambda: _target(workspaces), "Collect, then label",
                 "Set the number of labelled probes of one pair here. F2 changes to labelling: "
                 "Enter accepts a label and shows the next."),
        TourStop("train", lambda: _of(workspaces, TrainWorkspace).page.form, "Train a model",
                 "On the labelled probes; curves, samples and comparison are shown beside it."),
        TourStop("stack", lambda: _of(workspaces, StackWorkspace).page.run, "Stack by touch",
                 "Press Start stacking: the arm presses the piece on, shifts it, and releases it "
                 "where it will stand. Belief map and decision are updated after every probe."),
        TourStop("review", lambda: _of(workspaces, ReviewWorkspace).page.runs, "Look at it again",
                 "Every run is recorded: pictures, wrench, belief and decision on one time line."),
        TourStop("", lambda: window.rail["keys"], "Find your way",
                 "Ctrl+K finds every command, F1 shows all keys. 'Layout' arranges the columns of "
                 "a workspace. This tour is in the palette too: Ctrl+K, tour."),
    )  # fmt: skip


WorkspaceT = TypeVar("WorkspaceT", bound=Workspace)


def _of(workspaces: Mapping[str, Workspace], kind: type[WorkspaceT]) -> WorkspaceT:
    found = workspaces[kind.name]
    assert isinstance(found, kind)
    return found


def _target(workspaces: Mapping[str, Workspace]) -> QWidget:
    collect = _of(workspaces, CollectWorkspace)
    collect.page.bring(COLLECT)
    return collect.collect_page.target
