"""Theme and font scale, switched live for the whole application."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from PySide6.QtCore import QObject, Qt, QTimer
from PySide6.QtWidgets import QApplication, QWidget

from widgets.theme import LEAST, MOST, THEMES, Theme, ThemeName

STEP = 0.1
SETTLE_MS = 80
"""Keys pressed within this time change the window once. STOP must not wait for eight changes."""
Choice = ThemeName | Literal["system"]
CHOICES: tuple[Choice, ...] = (*THEMES, "system")
_WORDS: dict[Choice, str] = {
    "dark": "dark", "light": "light", "contrast": "high contrast", "system": "as the system",
}  # fmt: skip


class Appearance(QObject):
    """Holds the theme; ``refit`` is called after each change. "system" follows the desktop."""

    def __init__(
        self, application: QApplication, choice: Choice, scale: float, parent: QObject
    ) -> None:
        super().__init__(parent)
        self._application = application
        self.choice: Choice = choice
        self.theme = Theme()
        self.refit: Callable[[], None] = _nothing_yet
        self.theme.choose(application, self._name(), scale)
        self._wanted_scale = self.theme.scale
        self._window: QWidget | None = None
        self._settled = QTimer(self)
        self._settled.setSingleShot(True)
        self._settled.setInterval(SETTLE_MS)
        self._settled.timeout.connect(self._show_wanted)
        application.styleHints().colorSchemeChanged.connect(self._follow)

    def dress(self, window: QWidget) -> None:
        """Show the theme on a window that was just made."""
        self._window = window
        self.show(self.choice, self.theme.scale)

    def show(self, choice: Choice, scale: float) -> None:
        """Switch to a theme and a font scale (0.8 to 2)."""
        self.choice = choice
        self.theme.apply(self._application, self._name(), scale, self._window)
        self._wanted_scale = self.theme.scale
        self.refit()

    def next_theme(self) -> None:
        """Switch to the next theme."""
        at = CHOICES.index(self.choice)
        self.choice = CHOICES[(at + 1) % len(CHOICES)]
        self._settled.start()

    def words(self) -> str:
        """Return what is chosen, and what the desktop asks for if that is followed."""
        if self.choice != "system":
            return _WORDS[self.choice]
        return f"{_WORDS[self.choice]} ({_WORDS[self._name()]})"

    def larger(self) -> None:
        """Enlarge all text by a tenth of the base size."""
        self._step(STEP)

    def smaller(self) -> None:
        """Make all text smaller by a tenth of the base size."""
        self._step(-STEP)

    def _step(self, step: float) -> None:
        self._wanted_scale = min(max(self._wanted_scale + step, LEAST), MOST)
        self._settled.start()

    def _show_wanted(self) -> None:
        self.show(self.choice, self._wanted_scale)

    def _name(self) -> ThemeName:
        return system_theme(self._application) if self.choice == "system" else self.choice

    def _follow(self, _scheme: Qt.ColorScheme) -> None:
        if self.choice == "system":
            self.show("system", self.theme.scale)


def system_theme(application: QApplication) -> ThemeName:
    """Return what the desktop asks for; dark where it says nothing."""
    hints = application.styleHints()
    # Qt tells the wish for contrast since 6.10.
    if hasattr(hints, "accessibility"):
        wish = hints.accessibility().contrastPreference()
        if wish is Qt.ContrastPreference.HighContrast:
            return "contrast"
    return "light" if hints.colorScheme() is Qt.ColorScheme.Light else "dark"


def _nothing_yet() -> None:
    """Refit nothing: there is no window yet."""
