"""The list of workspaces and their lazy construction."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

from PySide6.QtCore import QObject, QTimer
from PySide6.QtWidgets import QWidget
from shiboken6 import isValid

from touchdown.app.collect import CollectWorkspace
from touchdown.app.operate import OperateWorkspace
from touchdown.app.review import ReviewWorkspace
from touchdown.app.shell import Memory, Workspace, WorkspaceContext, ignored_words
from touchdown.app.stack import StackWorkspace
from touchdown.app.train import TrainWorkspace
from touchdown.backend.bench import Session
from touchdown.backend.core import Event

WORKSPACES: tuple[Callable[[WorkspaceContext], Workspace], ...] = (
    OperateWorkspace,
    CollectWorkspace,
    TrainWorkspace,
    StackWorkspace,
    ReviewWorkspace,
)
FIRST = "stack"  # in front at the first start
IDLE_MS = 20  # pause between two steps of building pages in advance
AT_ONCE = 25  # number of widgets styled in one step, which takes about 5 ms


class Workspaces(Mapping[str, Workspace]):
    """The workspaces by name. A page is built when it is first needed.

    A new page receives its stored settings, the bench and the events so far. ``place`` adds a new
    page to the window in steps; ``warn`` shows a sentence.
    """

    def __init__(
        self,
        context: WorkspaceContext,
        remembered: Mapping[str, Memory],
        place: Callable[[Workspace], Iterator[None]],
        warn: Callable[[str], None],
    ) -> None:
        # All workspaces; those without a page have a name and commands only.
        self.all: Sequence[Workspace] = [make(context) for make in WORKSPACES]
        self._remembered, self._place, self._warn = remembered, place, warn
        self._ready: dict[str, Workspace] = {}
        self._begun: dict[str, Iterator[None]] = {}
        self._ahead: QTimer | None = None
        self._waiting = ("", "")
        self._bench: Session | None = None
        self._events: list[Event] = []

    def __getitem__(self, name: str) -> Workspace:
        """Return a workspace with its page. Raises ``KeyError``."""
        while name not in self._ready:
            next(self._making(name))
        return self._ready[name]

    def __contains__(self, name: object) -> bool:
        """Return True for the name of a workspace, built or not."""
        return any(ws.name == name for ws in self.all)

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names in the order of the rail."""
        return (ws.name for ws in self.all)

    def __len__(self) -> int:
        """Return the number of workspaces."""
        return len(self.all)

    @property
    def ready(self) -> Sequence[Workspace]:
        """The workspaces with a page."""
        return [ws for ws in self.all if ws.name in self._ready]

    @property
    def missing(self) -> Sequence[str]:
        """The names of the workspaces without a page."""
        return [name for name in self if name not in self._ready]

    def make_ahead(self, parent: QObject, hold: Callable[[], bool]) -> None:
        """Build the other pages in steps, so that the first visit is fast.

        Nothing is built while ``hold`` returns True.
        """
        timer = self._ahead = QTimer(parent)

        def go_on() -> None:
            if not hold() and not self.prepare():
                timer.stop()

        timer.timeout.connect(go_on)
        timer.start(IDLE_MS)

    def prepare(self) -> bool:
        """Do one step of building; return False if all pages exist."""
        name = next(iter((*self._begun, *self.missing)), None)
        if name is None:
            return False
        next(self._making(name), None)
        return True

    # -- to all that have a page; the others hear of it when theirs is made ------------------------

    def attach(self, bench: Session) -> None:
        """Connect all pages to a bench."""
        self._bench = bench
        for ws in self.ready:
            ws.attach(bench)

    def take(self, event: Event) -> None:
        """Pass an event to all pages."""
        for ws in self.ready:
            ws.take(event)
        if self.missing:
            self._events.append(event)

    def show_waiting(self, word: str, why: str) -> None:
        """Show why no bench is connected yet."""
        self._waiting = word, why
        for ws in self.ready:
            ws.show_waiting(word, why)

    def fit_to_theme(self) -> None:
        """Apply the sizes and icons of the theme."""
        for ws in self.ready:
            ws.fit_to_theme()

    def memory(self) -> dict[str, dict[str, object]]:
        """Return the settings of all workspaces to store; unbuilt pages keep the stored ones."""
        before = {name: dict(kept) for name, kept in self._remembered.items() if name in self}
        return before | {ws.name: dict(ws.memory()) for ws in self.ready}

    def close(self) -> None:
        """Close all workspaces."""
        if self._ahead is not None:
            self._ahead.stop()
        for name in [*self._begun]:
            # Complete a half-built page, so that it can be closed.
            self[name]
        for ws in self.ready:
            ws.close()

    # -- inside -----------------------------------------------------------------------------------

    def _making(self, name: str) -> Iterator[None]:
        """Return the iterator that builds a page. Raises ``KeyError``."""
        if name not in self._begun:
            made = next((ws for ws in self.all if ws.name == name), None)
            if made is None:
                raise KeyError(name)
            self._begun[name] = self._make(made)
        return self._begun[name]

    def _make(self, ws: Workspace) -> Iterator[None]:
        yield from ws.build()
        yield from self._place(ws)
        yield
        self._ready[ws.name] = ws
        ws.fit_to_theme()
        ws.show_waiting(*self._waiting)
        if ws.name in self._remembered:
            self._warn(ignored_words(ws.recall(self._remembered[ws.name])))
        if self._bench is not None:
            ws.attach(self._bench)
        for event in self._events:
            ws.take(event)
        if not self.missing:
            self._events.clear()
        parts = ws.page.findChildren(QWidget)
        for first in range(0, len(parts), AT_ONCE):
            yield
            for part in filter(isValid, parts[first : first + AT_ONCE]):
                part.ensurePolished()
        del self._begun[ws.name]
