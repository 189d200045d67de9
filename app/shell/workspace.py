"""Base class of the workspaces."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from PySide6.QtWidgets import QWidget

from touchdown.app.shell.live import LivePresenter
from touchdown.backend.bench import Session
from touchdown.backend.core import Event
from touchdown.widgets.base import Columns, Theme
from touchdown.widgets.shell import FaultCards

Memory = Mapping[str, object]  # stored settings of a workspace, JSON-ready


@dataclass(frozen=True, slots=True)
class WindowCommand:
    """One command: a row of the key sheet and an entry of the palette, with a configurable key.

    A key without Ctrl, Alt or a function key is off while a text field has the focus; "" is no key.
    ``repeats``: the command repeats while the key is held (only for commands that move nothing).
    ``beside``: the command is available while the page shows a question.
    """

    name: str
    text: str
    key: str
    run: Callable[[], object]
    repeats: bool = False
    beside: bool = False


@dataclass(frozen=True, slots=True)
class WorkspaceContext:
    """Services of the window for its workspaces. ``runs`` is the folder of the recorded runs.

    ``say`` shows a sentence in the footer, ``go`` shows a workspace by name, ``keys`` shows the key
    sheet, ``remember`` writes the settings at once, so that a crash does not lose them, ``offer``
    shows what has ended, with text and action of a next step, which moves nothing (no text: none).
    """

    theme: Theme
    cards: FaultCards
    runs: Path
    say: Callable[[str], None]
    go: Callable[[str], None]
    keys: Callable[[], None]
    remember: Callable[[], object]
    offer: Callable[[str, str, Callable[[], None]], None]


class LazyPages(Protocol):
    """A page whose parts can be added to the window one by one."""

    def take_out(self) -> None:
        """Remove the parts from the page."""

    def put_back(self) -> Iterator[None]:
        """Add the parts again, one per step."""


class Workspace:
    """One tab of the window: a page, its commands, and its reaction to the bench.

    A workspace has a name and commands from the start; its page is built when it is first needed.
    All methods are called on the thread of the window and must return at once. The defaults do
    nothing.
    """

    live: LivePresenter | None = None  # of a page with live pictures, once there is a bench
    name: str  # one word, used in files
    title: str  # text in the rail
    key: str
    page: QWidget
    commands: Sequence[WindowCommand] = ()
    # (key, text) of keys that act while they are held; the page handles them itself.
    held_keys: Sequence[tuple[str, str]] = ()
    columns: Columns | None = None  # arrangeable columns of the page, None for a fixed layout
    # Parts that are added to the window one by one, None to add the page at once.
    lazy_pages: LazyPages | None = None
    # Functions that draw the page in steps of a few ms, while it is in front.
    parts: Sequence[Callable[[], None]] = ()

    def build(self) -> Iterator[None]:
        """Create the page in steps of some ms. Called once, before the methods below."""
        yield

    def attach(self, bench: Session) -> None:
        """Connect to a bench."""

    def take(self, event: Event) -> None:
        """Handle one event of the bench, also while another page is in front."""

    def show_waiting(self, word: str, why: str) -> None:
        """Show why no bench is connected yet."""

    def enter(self) -> None:
        """Handle that the page comes to the front."""

    def leave(self) -> None:
        """Handle that another page comes to the front: end what must not go on unseen."""

    def fit_to_theme(self) -> None:
        """Apply the sizes and icons of the theme to all parts of the page."""
        for part in (self.page, *self.page.findChildren(QWidget)):
            if hasattr(part, "fit_to_theme"):
                part.fit_to_theme()

    def reset_layout(self) -> None:
        """Restore the default layout."""

    def memory(self) -> Memory:
        """Return the settings to store."""
        return {}

    def recall(self, memory: Memory) -> Sequence[str]:
        """Restore stored settings; return the names of invalid fields."""
        return ()

    def close(self) -> None:
        """End threads and timers."""
