"""The list of workspaces and their lazy construction."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

from PySide6.QtCore import QObject, QTimer
from PySide6.QtWidgets import QWidget
from shiboken6 import isValid

from touchdown.app.collect import CollectWorkspace
from touchdown.app.operate import OperateWorkspace
from touchdown.app.review import ReviewWorkspace
from touchdown.app.shell import (
    Memory,
    Workspace,
    WorkspaceContext,
    ignored_words,
)
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
FIRST = "stack"
"""In front at the first start."""
IDLE_MS = 20
"""Between two pieces of pages that are made ahead."""
AT_ONCE = 25
"""So many widgets take the style sheet in one piece: some 5 ms."""


class Workspaces(Mapping[str, Workspace]):
    """The workspaces by name. A page is made when it is first asked for.

    It then hears what the others have heard: the memory of it, the bench, the facts so far.
    ``place`` gives a page that was just made its place in the window, in pieces; ``warn`` shows a
    sentence.
    """

    def __init__(
        self,
        desk: WorkspaceContext,
        remembered: Mapping[str, Memory],
        place: Callable[[Workspace], Iterator[None]],
        warn: Callable[[str], None],
    ) -> None:
        self.all: Sequence[Workspace] = [make(desk) for make in WORKSPACES]
        """All of them; those without a page have a name and commands only."""
        self._remembered, self._place, self._warn = remembered, place, warn
        self._ready: dict[str, Workspace] = {}
        self._begun: dict[str, Iterator[None]] = {}
        self._ahead: QTimer | None = None
        self._waiting = ("", "")
        self._bench: Session | None = None
        self._facts: list[Event] = []

    def __getitem__(self, name: str) -> Workspace:
        """Return a workspace with its page; raises KeyError."""
        while name not in self._ready:
            next(self._making(name))
        return self._ready[name]

    def __contains__(self, name: object) -> bool:
        """Whether there is such a workspace, with a page or without."""
        return any(ws.name == name for ws in self.all)

    def __iter__(self) -> Iterator[str]:
        """Go through the names, in the order of the rail."""
        return (ws.name for ws in self.all)

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self.all)

    @property
    def ready(self) -> Sequence[Workspace]:
        """Those that have a page."""
        return [ws for ws in self.all if ws.name in self._ready]

    @property
    def missing(self) -> Sequence[str]:
        """The names of those that have none yet."""
        return [name for name in self if name not in self._ready]

    def make_ahead(self, parent: QObject, hold: Callable[[], bool]) -> None:
        """Make the other pages, piece by piece, so that a first visit is a quick one.

        Nothing is made while ``hold`` asks for quiet.
        """
        timer = self._ahead = QTimer(parent)

        def go_on() -> None:
            if not hold() and not self.prepare():
                timer.stop()

        timer.timeout.connect(go_on)
        timer.start(IDLE_MS)

    def prepare(self) -> bool:
        """Do one piece of the pages that are missing; False when none is."""
        name = next(iter((*self._begun, *self.missing)), None)
        if name is None:
            return False
        next(self._making(name), None)
        return True

    # -- to all that have a page; the others hear of it when theirs is made ------------------------

    def attach(self, bench: Session) -> None:
        """Take a bench that is ready."""
        self._bench = bench
        for ws in self.ready:
            ws.attach(bench)

    def take(self, fact: Event) -> None:
        """Take one fact of the bench."""
        for ws in self.ready:
            ws.take(fact)
        if self.missing:
            self._facts.append(fact)

    def show_waiting(self, word: str, why: str) -> None:
        """Say why there is no bench yet."""
        self._waiting = word, why
        for ws in self.ready:
            ws.show_waiting(word, why)

    def fit_to_theme(self) -> None:
        """Take the sizes and icons of the theme."""
        for ws in self.ready:
            ws.fit_to_theme()

    def memory(self) -> dict[str, dict[str, object]]:
        """Return what to remember of each; of those without a page what was remembered."""
        before = {name: dict(kept) for name, kept in self._remembered.items() if name in self}
        return before | {ws.name: dict(ws.memory()) for ws in self.ready}

    def close(self) -> None:
        """End what runs beside the window."""
        if self._ahead is not None:
            self._ahead.stop()
        for name in [*self._begun]:
            # What a page that is half made has begun, the whole one can end.
            self[name]
        for ws in self.ready:
            ws.close()

    # -- inside -----------------------------------------------------------------------------------

    def _making(self, name: str) -> Iterator[None]:
        """Return the making of a page, as far as it has come; raises KeyError."""
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
        for fact in self._facts:
            ws.take(fact)
        if not self.missing:
            self._facts.clear()
        parts = ws.page.findChildren(QWidget)
        for first in range(0, len(parts), AT_ONCE):
            yield
            for part in filter(isValid, parts[first : first + AT_ONCE]):
                part.ensurePolished()
        del self._begun[ws.name]
