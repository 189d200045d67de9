"""The workspaces of the window, in the order of the rail, each made when it is first asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

from app.collect.workspace import CollectWorkspace
from app.link import Link
from app.operate.workspace import OperateWorkspace
from app.review.workspace import ReviewWorkspace
from app.settings import ignored_words
from app.stack.workspace import StackWorkspace
from app.train.workspace import TrainWorkspace
from app.workspace import Desk, Memory, Workspace
from backend.core.facts import Fact

WORKSPACES: tuple[Callable[[Desk], Workspace], ...] = (
    OperateWorkspace,
    CollectWorkspace,
    TrainWorkspace,
    StackWorkspace,
    ReviewWorkspace,
)
FIRST = "stack"
"""In front at the first start."""


class Workspaces(Mapping[str, Workspace]):
    """The workspaces by name. A page is made when it is first asked for.

    It then hears what the others have heard: the memory of it, the bench, the facts so far.
    ``place`` gives a page that was just made its place in the window; ``warn`` shows a sentence.
    """

    def __init__(
        self,
        desk: Desk,
        remembered: Mapping[str, Memory],
        place: Callable[[Workspace], None],
        warn: Callable[[str], None],
    ) -> None:
        self.all: Sequence[Workspace] = [make(desk) for make in WORKSPACES]
        """All of them; those without a page have a name and commands only."""
        self._remembered, self._place, self._warn = remembered, place, warn
        self._ready: dict[str, Workspace] = {}
        self._waiting = ("", "")
        self._link: Link | None = None
        self._facts: list[Fact] = []

    def __getitem__(self, name: str) -> Workspace:
        """Return a workspace with its page; raises KeyError."""
        ready = self._ready.get(name)
        return self._made(name) if ready is None else ready

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

    # -- to all that have a page; the others hear of it when theirs is made ------------------------

    def attach(self, link: Link) -> None:
        """Take a bench that is ready."""
        self._link = link
        for ws in self.ready:
            ws.attach(link)

    def take(self, fact: Fact) -> None:
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
        for ws in self.ready:
            ws.close()

    # -- inside -----------------------------------------------------------------------------------

    def _made(self, name: str) -> Workspace:
        made = next((ws for ws in self.all if ws.name == name), None)
        if made is None:
            raise KeyError(name)
        made.build()
        self._ready[name] = made
        self._place(made)
        made.fit_to_theme()
        made.show_waiting(*self._waiting)
        if name in self._remembered:
            self._warn(ignored_words(made.recall(self._remembered[name])))
        if self._link is not None:
            made.attach(self._link)
        for fact in self._facts:
            made.take(fact)
        if not self.missing:
            self._facts.clear()
        return made
