"""Themes: chosen, or as the desktop says, also while the window is open."""

from types import SimpleNamespace

import pytest
from PySide6.QtCore import QObject, Qt
from PySide6.QtGui import QColor
from PySide6.QtWidgets import QFrame, QVBoxLayout, QWidget

from touchdown.app.shell import window as appearance
from touchdown.app.shell.window import CHOICES, Appearance, system_theme
from touchdown.widgets.base.theme import DARK, LIGHT, Theme

SCHEME, WISH = Qt.ColorScheme, getattr(Qt, "ContrastPreference", None)


def desktop(scheme, wish=None):
    hints = SimpleNamespace(colorScheme=lambda: scheme)
    if wish is not None:
        hints.accessibility = lambda: SimpleNamespace(contrastPreference=lambda: wish)
    return SimpleNamespace(styleHints=lambda: hints)


@pytest.mark.parametrize(
    ("scheme", "theme"), [(SCHEME.Light, "light"), (SCHEME.Dark, "dark"), (SCHEME.Unknown, "dark")]
)
def test_the_desktop_says_dark_or_light(scheme, theme):
    assert system_theme(desktop(scheme)) == theme


@pytest.mark.skipif(WISH is None, reason="this Qt does not tell the wish for contrast")
def test_a_wish_for_contrast_comes_first():
    assert system_theme(desktop(SCHEME.Light, WISH.HighContrast)) == "contrast"
    assert system_theme(desktop(SCHEME.Light, WISH.NoPreference)) == "light"


@pytest.fixture
def look(qapp):
    owner = QObject()
    made = Appearance(qapp, "dark", 1.0, owner)
    yield made
    made.show("dark", 1.0)
    owner.deleteLater()


def test_the_choices_come_in_turn(look):
    seen = [look.next_theme() or look.choice for _ in CHOICES]
    assert sorted(seen) == sorted(CHOICES)


@pytest.mark.promise("W9")
def test_a_desktop_that_changes_is_followed_only_if_that_is_chosen(look, qapp, monkeypatch):
    wish = ["light"]
    monkeypatch.setattr(appearance, "system_theme", lambda _: wish[0])
    look.show("system", 1.0)
    assert (look.theme.tokens.name, look.words()) == ("light", "as the system (light)")
    wish[0] = "contrast"
    qapp.styleHints().colorSchemeChanged.emit(SCHEME.Dark)
    assert look.theme.tokens.name == "contrast"
    look.show("dark", 1.0)
    qapp.styleHints().colorSchemeChanged.emit(SCHEME.Light)
    assert look.theme.tokens.name == "dark"


def window_with_rail(qtbot):
    window = QWidget()
    qtbot.addWidget(window)
    rail = QFrame()
    rail.setProperty("role", "rail")
    rail.setFixedSize(20, 20)
    QVBoxLayout(window).addWidget(rail)
    return window, rail


def test_a_second_window_takes_all_of_its_last_theme_before_it_shows(qapp, qtbot, look):
    """Beside a first one Qt kept the rules of the earlier sheet for what had been laid out."""
    first, _ = window_with_rail(qtbot)
    theme = Theme()
    theme.apply(qapp, "dark", 1.0, first)
    first.show()
    second, rail = window_with_rail(qtbot)
    for name in ("dark", "light"):
        theme.apply(qapp, name, 1.0, second)
        rail.ensurePolished()
        rail.sizeHint()
    second.show()
    seen = rail.grab().toImage().pixelColor(5, 5)
    assert seen == QColor(LIGHT.panel) != QColor(DARK.panel)
