"""Theme and font scale, switched live for the whole application."""

from __future__ import annotations

from collections.abc import Callable

from PySide6.QtWidgets import QApplication

from widgets.theme import THEMES, Theme, ThemeName

STEP = 0.1


class Appearance:
    """Holds the theme; ``refit`` is called after each change."""

    def __init__(self, application: QApplication, name: ThemeName, scale: float) -> None:
        self._application = application
        self.theme = Theme()
        self.theme.apply(application, name, scale)
        self.refit: Callable[[], None] = _nothing_yet

    def show(self, name: ThemeName, scale: float) -> None:
        """Switch to a theme and a font scale (0.8 to 2)."""
        self.theme.apply(self._application, name, scale)
        self.refit()

    def next_theme(self) -> None:
        """Switch to the next theme."""
        at = THEMES.index(self.theme.tokens.name)
        self.show(THEMES[(at + 1) % len(THEMES)], self.theme.scale)

    def larger(self) -> None:
        """Enlarge all text by a tenth of the base size."""
        self.show(self.theme.tokens.name, self.theme.scale + STEP)

    def smaller(self) -> None:
        """Make all text smaller by a tenth of the base size."""
        self.show(self.theme.tokens.name, self.theme.scale - STEP)


def _nothing_yet() -> None:
    """Refit nothing: there is no window yet."""
