"""Main window: docks, appearance, position on the screen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import datetime
from typing import Literal

from PySide6.QtCore import QEvent, QObject, QRect, QSize, Qt, QTimer
from PySide6.QtGui import QCloseEvent, QFontMetrics, QRegion, QResizeEvent
from PySide6.QtWidgets import (
    QApplication,
    QFrame,
    QMainWindow,
    QScrollArea,
    QSizePolicy,
    QStackedWidget,
    QToolButton,
    QWidget,
)

from touchdown.app.shell.bench_text import BenchCaption
from touchdown.app.shell.sheets import LEAST_WINDOW, QuestionRow
from touchdown.app.shell.workspace import Workspace
from touchdown.widgets import base
from touchdown.widgets.shell import BenchBanner, FaultCards, TopBar

LEAST_EM, MOST_EM = (
    (62, 34.5),
    (90, 48),
)  # limits of the minimum size of a page, which else scrolls
USUAL = QSize(1600, 940)
RAIL_GAP_PX, RAIL_MARGIN_PX = 4, 8
MESSAGE_PX = 420  # least width of the message in the foot
FOOT_OF_RAIL = (("bench", "Bench"), ("layouts", "Layout"), ("theme", "Theme"), ("keys", "Keys"))


class MainWindow(QMainWindow):
    """The main window. ``may_close`` decides on a close request."""

    def __init__(
        self, theme: base.Theme, bar: TopBar, cards: FaultCards, tabs: Sequence[Workspace]
    ) -> None:
        super().__init__()
        self._theme, self._bar = theme, bar
        self.may_close: Callable[[], bool] = bool
        self.front = ""
        self._stack = QStackedWidget()
        self._tabs = [tab.name for tab in tabs]
        self._pages: dict[str, QWidget] = {}
        self._scrolls: dict[str, QScrollArea] = {}
        named = [(tab.name, tab.title) for tab in tabs]
        self.rail = {name: _rail_button(text) for name, text in (*named, *FOOT_OF_RAIL)}
        self._message, self._right = base.label("", "muted", wrap=True), base.label("", "small")
        self.next_step = QuestionRow(low=True)
        self._banner = BenchBanner(theme)
        # The name is unknown until a bench is attached.
        self._banner.hide()
        self._arrange(bar, cards)
        self.setMinimumSize(LEAST_WINDOW)
        self.resize(USUAL)
        self.fit_to_theme()

    def _arrange(self, bar: TopBar, cards: FaultCards) -> None:
        body = QWidget()
        # Below the page: what is above a new card keeps its place under the hand.
        base.vbox((self._stack, 1), cards, parent=body, margins=(0, 0, 0, 0), spacing=0)
        self._rail_column = self._rail()
        self._rail_frame = base.scroll_area(self._rail_column)
        self._rail_frame.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self._rail_frame.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        middle = base.hbox(self._rail_frame, (body, 1), spacing=0)
        frame = self._frame = QWidget()
        frame.setObjectName("frame")
        self._foot_frame = QFrame()
        self._foot_frame.setProperty("role", "foot")
        message = self._message, MESSAGE_PX
        foot = cards.strip, self.next_step, message, self._banner, self._right
        base.FlowLayout(*foot, parent=self._foot_frame, margins=(12, 4, 12, 4), spacing=16)
        whole = bar, (middle, 1), self._foot_frame
        base.vbox(*whole, parent=frame, margins=(0, 0, 0, 0), spacing=0)
        self.setCentralWidget(frame)
        # Takes the initial focus, so that no control looks selected.
        frame.setFocusPolicy(Qt.FocusPolicy.ClickFocus)
        frame.setFocus()

    def _rail(self) -> QFrame:
        rail = QFrame()
        rail.setProperty("role", "rail")
        for name in self._tabs:
            self.rail[name].setCheckable(True)
        foot = [self.rail[name] for name, _ in FOOT_OF_RAIL]
        buttons: list[QWidget | int] = [*(self.rail[name] for name in self._tabs), 1, *foot]
        margins = 5, RAIL_MARGIN_PX, 5, RAIL_MARGIN_PX
        base.vbox(*buttons, parent=rail, margins=margins, spacing=RAIL_GAP_PX)
        return rail

    def add_page(self, name: str, page: QWidget) -> None:
        """Add the page of a workspace."""
        self._pages[name], self._scrolls[name] = page, base.scroll_area(page)
        self._scrolls[name].setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self._stack.addWidget(self._scrolls[name])
        page.installEventFilter(self)
        self._fit_columns(page)

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:
        """Follow the room that the views of a page need."""
        if event.type() is QEvent.Type.LayoutRequest and isinstance(watched, QWidget):
            self._give_room(watched)
        return super().eventFilter(watched, event)

    def show_page(self, name: str) -> None:
        """Show the page of a workspace."""
        focus = QApplication.focusWidget()
        if focus is not None and self._stack.isAncestorOf(focus):
            # Otherwise the first control of the page would look selected.
            self._frame.setFocus()
        self.front = name
        self._stack.setCurrentWidget(self._scrolls[name])
        self._fit_columns(self._pages[name])
        for key in self._tabs:
            self.rail[key].setChecked(key == name)

    def show_message(self, text: str) -> None:
        """Show a sentence in the footer, after the local time; an empty one clears it."""
        said = f"{datetime.now():%H:%M}  {base.tr(text)}" if text else ""
        self._message.setText(said)

    def show_right(self, text: str) -> None:
        """Show numbers at the right of the footer."""
        self._right.setText(text)

    def show_bench(self, words: BenchCaption) -> None:
        """Show the name of the bench in banner and title."""
        self._banner.show_bench(words.banner, words.tip, words.striped)
        self._banner.show()
        self.setWindowTitle(base.tr(words.title))

    def fit_to_theme(self) -> None:
        """Redraw the icons of the rail; larger text scrolls."""
        em = QFontMetrics(base.ui_font(self._theme.scale)).height()
        for button in self.rail.values():
            button.setMinimumWidth(round(3.7 * em))
        self._bar.ensurePolished()
        self._bar.fit()
        self.setMinimumWidth(max(LEAST_WINDOW.width(), self._bar.minimumSizeHint().width()))
        for name, button in self.rail.items():
            button.setIcon(base.icon(name, self._theme.tokens.colour("text"), 22))
        self._fit_rail()
        for page in self._pages.values():
            self._fit_columns(page)

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Hide the icons of the rail where there is only room for its texts."""
        super().resizeEvent(event)
        self._fit_rail()
        for page in self._pages.values():
            self._fit_columns(page)

    def _fit_rail(self) -> None:
        full = Qt.ToolButtonStyle.ToolButtonTextUnderIcon
        frame = self._rail_frame
        for style in (full, Qt.ToolButtonStyle.ToolButtonTextOnly):
            for button in self.rail.values():
                button.setToolButtonStyle(style)
            needed = sum(button.sizeHint().height() + RAIL_GAP_PX for button in self.rail.values())
            taken = self._bar.sizeHint().height() + self._foot_frame.sizeHint().height()
            fits = needed + 2 * RAIL_MARGIN_PX <= self.height() - taken
            if fits:
                break
        # Where even the texts are too high, the rail scrolls.
        bar_px = 0 if fits else frame.verticalScrollBar().sizeHint().width()
        frame.setFixedWidth(self._rail_column.sizeHint().width() + bar_px)

    def _fit_columns(self, page: QWidget) -> None:
        """Give a page room; show its controls first where it is wider than the window."""
        self._give_room(page)
        # Hidden pages have no layout yet: use the width of the window.
        room = self.width() - self._rail_frame.sizeHint().width()
        narrow = room < page.minimumWidth()
        for columns in page.findChildren(base.Columns):
            columns.lead_with_controls(narrow)

    def _give_room(self, page: QWidget) -> None:
        em, needed = QFontMetrics(base.ui_font(self._theme.scale)).height(), page.minimumSizeHint()
        sizes = zip(LEAST_EM, (needed.width(), needed.height()), MOST_EM, strict=True)
        page.setMinimumSize(
            *(int(max(least * em, min(size, most * em))) for least, size, most in sizes)
        )

    def closeEvent(self, event: QCloseEvent) -> None:
        """Close the window if allowed."""
        if self.may_close():
            event.accept()
        else:
            event.ignore()


def _rail_button(text: str) -> QToolButton:
    button = QToolButton()
    # A long name takes two lines; a single ampersand would mark a shortcut.
    button.setText(base.tr(text).replace(" & ", " &&\n"))
    button.setProperty("role", "rail")
    button.setToolButtonStyle(Qt.ToolButtonStyle.ToolButtonTextUnderIcon)
    button.setIconSize(QSize(22, 22))
    base.describe((button, text, text))
    button.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
    return button


STEP = 0.1
SETTLE_MS = 80  # key presses within this time change the window once, so that STOP need not wait
ThemeChoice = base.ThemeName | Literal["system"]
CHOICES: tuple[ThemeChoice, ...] = (*base.THEMES, "system")
_WORDS: dict[ThemeChoice, str] = {
    "dark": "dark", "light": "light", "contrast": "high contrast", "system": "as the system",
}  # fmt: skip


class Appearance(QObject):
    """Holds the theme; ``refit`` is called after each change. "system" follows the desktop."""

    def __init__(
        self, application: QApplication, choice: ThemeChoice, scale: float, parent: QObject
    ) -> None:
        super().__init__(parent)
        self._application = application
        self.choice: ThemeChoice = choice
        self.theme = base.Theme()
        self.refit: Callable[[], None] = lambda: None
        self.theme.choose(application, self._name(), scale)
        self._wanted_scale = self.theme.scale
        self._window: QWidget | None = None
        self._settled = QTimer(self, singleShot=True, interval=SETTLE_MS)
        self._settled.timeout.connect(lambda: self.show(self.choice, self._wanted_scale))
        application.styleHints().colorSchemeChanged.connect(self._follow)

    def dress(self, window: QWidget) -> None:
        """Apply the theme to a new window."""
        self._window = window
        self.show(self.choice, self.theme.scale)

    def show(self, choice: ThemeChoice, scale: float) -> None:
        """Change theme and font scale (0.8 to 2)."""
        self.choice = choice
        self.theme.apply(self._application, self._name(), scale, self._window)
        self._wanted_scale = self.theme.scale
        self.refit()

    def next_theme(self) -> None:
        """Change to the next theme."""
        at = CHOICES.index(self.choice)
        self.choice = CHOICES[(at + 1) % len(CHOICES)]
        self._settled.start()

    def words(self) -> str:
        """Return the chosen theme; for "system" also that of the desktop."""
        if self.choice != "system":
            return base.tr(_WORDS[self.choice])
        return f"{base.tr(_WORDS[self.choice])} ({base.tr(_WORDS[self._name()])})"

    def larger(self) -> None:
        """Enlarge all text by a tenth of the base size."""
        self._step(STEP)

    def smaller(self) -> None:
        """Reduce all text by a tenth of the base size."""
        self._step(-STEP)

    def _step(self, step: float) -> None:
        self._wanted_scale = min(max(self._wanted_scale + step, base.MIN_SCALE), base.MAX_SCALE)
        self._settled.start()

    def _name(self) -> base.ThemeName:
        return system_theme(self._application) if self.choice == "system" else self.choice

    def _follow(self, _scheme: Qt.ColorScheme) -> None:
        if self.choice == "system":
            self.show("system", self.theme.scale)


def system_theme(application: QApplication) -> base.ThemeName:
    """Return the theme of the desktop; dark if unknown."""
    hints = application.styleHints()
    # Qt reports high contrast since 6.10.
    if hasattr(hints, "accessibility"):
        wish = hints.accessibility().contrastPreference()
        if wish is Qt.ContrastPreference.HighContrast:
            return "contrast"
    return "light" if hints.colorScheme() is Qt.ColorScheme.Light else "dark"


GRIP_PX = QSize(120, 30)  # part of the upper edge that must be on a screen


def move_on_screen(window: QRect, screens: Sequence[QRect]) -> QRect:
    """Return ``window``, moved to the nearest screen if it cannot be reached.

    This includes a window larger than all screens.
    """
    if not screens:
        return window
    upper = QRect(window.left(), window.top(), window.width(), GRIP_PX.height())
    room = QRegion()
    for screen in screens:
        room += screen
    whole = room.boundingRect().size()
    fits = window.width() <= whole.width() and window.height() <= whole.height()
    for screen in screens if fits else ():
        seen = screen.intersected(upper)
        if (
            seen.width() >= min(GRIP_PX.width(), window.width())
            and seen.height() >= GRIP_PX.height()
        ):
            return window
    middle = window.center()
    nearest = min(screens, key=lambda screen: (screen.center() - middle).manhattanLength())
    width, height = min(window.width(), nearest.width()), min(window.height(), nearest.height())
    x = min(max(window.left(), nearest.left()), nearest.left() + nearest.width() - width)
    y = min(max(window.top(), nearest.top()), nearest.top() + nearest.height() - height)
    return QRect(x, y, width, height)
