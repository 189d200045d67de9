"""Colours, fonts and palettes of the themes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cache
from importlib.resources import files
from string import Template
from typing import Literal

import numpy as np
import pyqtgraph as pg
from numpy.typing import NDArray
from PySide6.QtCore import QByteArray, QDir, QLocale, QRectF, QSize, Qt, QTranslator
from PySide6.QtGui import (
    QColor,
    QFont,
    QFontDatabase,
    QIcon,
    QPainter,
    QPalette,
    QPixmap,
    QPixmapCache,
)
from PySide6.QtSvg import QSvgRenderer
from PySide6.QtWidgets import QAbstractButton, QApplication, QWidget

ThemeName = Literal["dark", "light", "contrast"]
THEMES: tuple[ThemeName, ...] = ("dark", "light", "contrast")
BASE_POINTS = 10.0
MIN_SCALE, MAX_SCALE = 0.8, 2.0  # range of the font scale
STYLED = "touchdown-styled"  # property of an application whose style is set
FONTS = "touchdown-fonts"  # property of an application with the bundled fonts


@dataclass(frozen=True, slots=True)
class Tokens:
    """Colours of one theme as ``#rrggbb``; those of states and actions are equal in all themes."""

    name: ThemeName
    bg: str
    panel: str
    raised: str
    hover: str
    text: str
    muted: str
    border: str
    hairline: str
    grid: str
    focus: str
    selection: str
    selection_text: str
    axis_x: str
    axis_y: str
    axis_z: str
    good: str
    bad: str
    scene: str  # position seen by the scene camera
    disabled: str
    pill_grey: str = "#5A6570"
    pill_blue: str = "#1565C0"
    pill_green: str = "#57C785"
    pill_yellow: str = "#F9C800"
    pill_red: str = "#B3261E"
    on_light: str = "#14181C"
    on_dark: str = "#FFFFFF"
    stop: str = "#C62828"
    reset: str = "#1565C0"

    def colour(self, token: str) -> QColor:
        """Return the colour of a token by name; raises AttributeError for an unknown one."""
        return QColor(getattr(self, token))


DARK = Tokens(
    name="dark", bg="#14181C", panel="#1C2127", raised="#262D35", hover="#303943",
    text="#E3E8ED", muted="#A3AEBA", border="#7A8794", hairline="#2E363F", grid="#2A323A",
    focus="#7CC4FF", selection="#1F6FB2", selection_text="#FFFFFF",
    axis_x="#4FA8FF", axis_y="#F0E442", axis_z="#FF6E5E", good="#6CEAAB", bad="#FF8370",
    scene="#7CF2FF", disabled="#7A8794",
)  # fmt: skip
LIGHT = Tokens(
    name="light", bg="#FFFFFF", panel="#F2F4F6", raised="#FFFFFF", hover="#E6EAEE",
    text="#1B2127", muted="#55606B", border="#76818C", hairline="#D5DBE0", grid="#E2E7EB",
    focus="#0B5CAD", selection="#1F6FB2", selection_text="#FFFFFF",
    axis_x="#005FCC", axis_y="#C04A00", axis_z="#3A0D3F", good="#11784D", bad="#AA180E",
    scene="#0284C7", disabled="#76818C",
)  # fmt: skip
CONTRAST = Tokens(
    name="contrast", bg="#000000", panel="#000000", raised="#000000", hover="#2B2B2B",
    text="#FFFFFF", muted="#FFFFFF", border="#FFFFFF", hairline="#FFFFFF", grid="#4A4A4A",
    focus="#FFFF00", selection="#FFFF00", selection_text="#000000",
    axis_x="#00C8FF", axis_y="#FFFF00", axis_z="#FF8A7A", good="#68D9A1", bad="#F37B68",
    scene="#7CF2FF", disabled="#808080",
)  # fmt: skip
TOKENS: dict[ThemeName, Tokens] = {"dark": DARK, "light": LIGHT, "contrast": CONTRAST}


class Theme:
    """Current tokens and font scale. Widgets keep it and read ``theme.tokens`` when they paint."""

    def __init__(self, name: ThemeName = "dark", scale: float = 1.0) -> None:
        self.tokens, self.scale = TOKENS[name], scale

    def choose(self, application: QApplication, name: ThemeName, scale: float) -> None:
        """Set theme and font scale before widgets are made; call ``apply`` afterwards.

        With a style sheet in force, Qt polishes every widget again when it enters a layout. Without
        one a window is built in half the time.
        """
        self._take(application, name, scale)
        if application.styleSheet():
            application.setStyleSheet("")

    def apply(
        self,
        application: QApplication,
        name: ThemeName,
        scale: float,
        window: QWidget | None = None,
    ) -> None:
        """Switch the whole application to a theme and font scale (0.8 to 2).

        With ``window`` the style sheet is set on that window alone, not on the application. A page
        built later is then styled once, when it enters the window, and not at every step of its
        construction.
        """
        self._take(application, name, scale)
        sheet = make_style_sheet(self.tokens, BASE_POINTS * self.scale)
        dressed = application if window is None else window
        if sheet != dressed.styleSheet():
            if window is not None and window.styleSheet():
                # Qt drops the rules of the old sheet only for polished widgets: those laid out
                # before they are first shown would keep them while a second window is open.
                window.ensurePolished()
            # Replacing a sheet directly takes Qt five times as long.
            dressed.setStyleSheet("")
            dressed.setStyleSheet(sheet)
        for widget in application.allWidgets():
            widget.update()

    @contextmanager
    def on_paper(self, view: QWidget) -> Iterator[None]:
        """Draw ``view`` in the light theme for a while, as a page to read and print needs it."""
        tokens, sheet = self.tokens, view.styleSheet()
        self.tokens = LIGHT
        view.setStyleSheet(make_style_sheet(LIGHT, BASE_POINTS * self.scale))
        try:
            yield
        finally:
            self.tokens = tokens
            view.setStyleSheet(sheet)

    def _take(self, application: QApplication, name: ThemeName, scale: float) -> None:
        self.tokens = TOKENS[name]
        self.scale = min(max(scale, MIN_SCALE), MAX_SCALE)
        if not application.property(STYLED):
            application.setStyle("Fusion")
            application.setProperty(STYLED, True)
        # Setting a font, palette or sheet lays out and paints every widget: skip unchanged ones.
        if application.font() != ui_font(self.scale):
            application.setFont(ui_font(self.scale))
        application.setPalette(_palette(self.tokens))


def load_resources() -> None:
    """Register the bundled interface font and icons, and the translation for the desktop.

    Runs once per application: each added font makes Qt discard its text measurements.
    """
    application = QApplication.instance()
    assert application is not None
    if application.property(FONTS):
        return
    application.setProperty(FONTS, True)
    resources = files("touchdown.resources")
    translator = QTranslator(application)
    if translator.load(QLocale(), "touchdown", "_", str(resources.joinpath("languages"))):
        application.installTranslator(translator)
    for style in ("Regular", "Medium", "SemiBold"):
        data = resources.joinpath("fonts", f"Inter-{style}.otf").read_bytes()
        QFontDatabase.addApplicationFontFromData(data)
    QDir.addSearchPath("icons", str(resources.joinpath("icons")))


# Size of marks in px per point of the text.
MARKS = {"arrow": 1.0, "small_arrow": 0.9, "tick": 1.3, "drop": 2.2, "step": 1.8}


def make_style_sheet(tokens: Tokens, points: float) -> str:
    """Return the style sheet for a theme and the base font size in points."""
    sizes = {
        "small": f"{points * 0.9:.2f}",
        "head": f"{points * 1.15:.2f}",
        "figure": f"{points * 1.7:.2f}",
        **{mark: f"{share * points:.0f}" for mark, share in MARKS.items()},
    }
    names = ("style", "contrast") if tokens.name == "contrast" else ("style",)
    resources = files("touchdown.resources")
    sheet = "".join(resources.joinpath(f"{name}.qss").read_text(encoding="utf-8") for name in names)
    return Template(sheet).substitute(asdict(tokens), **sizes)


@cache
def ui_font(scale: float = 1.0, size: float = 1.0, weight: int = 400) -> QFont:
    """Return the interface font with digits of equal width; ``size`` multiplies the base size.

    Fonts are cached: constructing one costs as much as drawing a line of text.
    """
    font = QFont(["Inter", "DejaVu Sans"])
    font.setPointSizeF(BASE_POINTS * scale * size)
    font.setWeight(QFont.Weight(weight))
    font.setFeature(QFont.Tag("tnum"), 1)
    return font


def _palette(t: Tokens) -> QPalette:
    palette = QPalette()
    role = QPalette.ColorRole
    for key, colour in (
        (role.Window, t.panel), (role.Base, t.bg), (role.AlternateBase, t.panel),
        (role.Button, t.raised), (role.Text, t.text), (role.WindowText, t.text),
        (role.ButtonText, t.text), (role.ToolTipBase, t.raised), (role.ToolTipText, t.text),
        (role.Highlight, t.selection), (role.HighlightedText, t.selection_text),
        (role.PlaceholderText, t.muted), (role.Link, t.focus), (role.Mid, t.border),
        (role.BrightText, t.text), (role.Light, t.raised), (role.Dark, t.border),
    ):  # fmt: skip
        palette.setColor(key, QColor(colour))
    disabled = QPalette.ColorGroup.Disabled
    for key in (role.Text, role.WindowText, role.ButtonText):
        palette.setColor(disabled, key, QColor(t.disabled))
    return palette


def blend(under: QColor, over: QColor, share: float) -> QColor:
    """Mix two opaque colours; ``share`` is that of ``over``, 0 to 1."""
    return QColor.fromRgbF(
        under.redF() + share * (over.redF() - under.redF()),
        under.greenF() + share * (over.greenF() - under.greenF()),
        under.blueF() + share * (over.blueF() - under.blueF()),
    )


ICON_SHARE = 0.9


def icon(name: str, colour: QColor, size_px: int = 20) -> QIcon:
    """Return icon ``name`` (a file in resources/icons) drawn in ``colour``."""
    return QIcon(pixmap(name, colour, size_px * 2))


def fit_icon(*buttons: QAbstractButton) -> None:
    """Scale the icons of buttons to the height of their text."""
    for button in buttons:
        side = round(ICON_SHARE * button.fontMetrics().height())
        button.setIconSize(QSize(side, side))


def pixmap(name: str, colour: QColor, size_px: int) -> QPixmap:
    """Return icon ``name`` as a square pixmap; raises FileNotFoundError if unknown."""
    kept, drawn = f"icon {name} {colour.name()} {size_px}", QPixmap()
    if QPixmapCache.find(kept, drawn):
        return drawn
    file = files("touchdown.resources").joinpath("icons", f"{name}.svg")
    source = file.read_text(encoding="utf-8")
    renderer = QSvgRenderer(QByteArray(source.replace("currentColor", colour.name()).encode()))
    drawn = QPixmap(size_px, size_px)
    drawn.fill(Qt.GlobalColor.transparent)
    painter = QPainter(drawn)
    renderer.render(painter, QRectF(0, 0, size_px, size_px))
    painter.end()
    QPixmapCache.insert(kept, drawn)
    return drawn


MapName = Literal["cividis", "viridis", "grey"]
MAPS: tuple[MapName, ...] = ("cividis", "viridis", "grey")


@cache
def colour_table(name: MapName) -> NDArray[np.uint8]:
    """Return the (256, 3) uint8 RGB table of a colour map, read-only."""
    if name == "grey":
        lut = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)
    else:
        lut = np.ascontiguousarray(pg.colormap.get(name).getLookupTable(nPts=256)[:, :3])
        lut = lut.astype(np.uint8)
    lut.flags.writeable = False
    return lut


def map_colours(values: NDArray[np.float64], name: MapName) -> NDArray[np.uint8]:
    """Map values in 0..1 (any shape) to (..., 3) uint8; NaN becomes the colour of 0."""
    index = np.clip(np.nan_to_num(values, nan=0.0) * 255.0, 0, 255).astype(np.uint8)
    return np.asarray(colour_table(name)[index])
