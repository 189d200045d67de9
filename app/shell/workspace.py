"""Base class of the workspaces."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from PySide6.QtWidgets import QWidget

from touchdown.backend.bench import Session
from touchdown.backend.core import Event
from touchdown.widgets.base import Columns, Theme
from touchdown.widgets.shell import FaultCards

Memory = Mapping[str, object]
"""What a workspace remembers from one start to the next, JSON-ready."""


@dataclass(frozen=True, slots=True)
class WindowCommand:
    """One thing to do: a row of the key sheet, an entry of the palette, a key that can be changed.

    A key without Ctrl, Alt or function key is off while a text field has the focus; "" is no key.
    ``repeats``: a held key acts again and again (only for what moves nothing). ``beside``: it acts
    also while a question stands on the page.
    """

    name: str
    text: str
    key: str
    run: Callable[[], None]
    repeats: bool = False
    beside: bool = False


@dataclass(frozen=True, slots=True)
class WorkspaceContext:
    """What the frame lends to its workspaces. ``runs`` is the folder of the recorded runs.

    ``say`` shows a sentence in the foot, ``go`` brings a workspace to the front by name, ``keys``
    shows the key sheet, ``remember`` writes the settings now: a crash does not ask first.
    """

    theme: Theme
    cards: FaultCards
    runs: Path
    say: Callable[[str], None]
    go: Callable[[str], None]
    keys: Callable[[], None]
    remember: Callable[[], None]


class LazyPages(Protocol):
    """A page whose parts can be put into the window one after the other."""

    def take_out(self) -> None:
        """Take the parts out of the page."""

    def put_back(self) -> Iterator[None]:
        """Put them back, one at a time."""


class Workspace:
    """One tab of the window: a page, its commands, and how it follows the bench.

    Until it is first asked for it has a name and commands, but no page: most visits to the window
    see one or two of them. All is called on the window's thread and must return at once. The
    defaults do nothing.
    """

    name: str
    """One word, used in files."""
    title: str
    """What the rail says."""
    key: str
    page: QWidget
    commands: Sequence[WindowCommand] = ()
    held_keys: Sequence[tuple[str, str]] = ()
    """(key, text) of keys that act while they are held; the page handles them itself."""
    columns: Columns | None = None
    """What of the page can be arranged; None: nothing."""
    pieces: LazyPages | None = None
    """What of the page is put into the window piece by piece; None: all at once, it is small."""
    parts: Sequence[Callable[[], None]] = ()
    """What draws the page, in pieces of few ms; called in turn while the page is in front."""

    def build(self) -> Iterator[None]:
        """Make the page, in pieces of some ms; called once, before anything below."""
        yield

    def attach(self, bench: Session) -> None:
        """Take a bench that is ready."""

    def take(self, fact: Event) -> None:
        """Take one fact of the bench, also while another page is in front."""

    def show_waiting(self, word: str, why: str) -> None:
        """Say why there is no bench yet."""

    def enter(self) -> None:
        """Come to the front."""

    def leave(self) -> None:
        """Go behind another page: end whatever must not go on unseen."""

    def fit_to_theme(self) -> None:
        """Take the sizes and icons of the theme, which changed."""

    def reset_layout(self) -> None:
        """Put the page back as it was at the first start."""

    def memory(self) -> Memory:
        """Return what to remember."""
        return {}

    def recall(self, memory: Memory) -> Sequence[str]:
        """Take what was remembered; return the names of fields that make no sense."""
        return ()

    def close(self) -> None:
        """End what runs beside the window."""
