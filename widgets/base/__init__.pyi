from .freshness import Age as Age
from .freshness import Freshness as Freshness
from .freshness import Pump as Pump
from .freshness import bring_in_sight as bring_in_sight
from .panel import Arrangement as Arrangement
from .panel import Captioned as Captioned
from .panel import Columns as Columns
from .panel import ElidedLabel as ElidedLabel
from .panel import Notes as Notes
from .panel import Panel as Panel
from .panel import chooser as chooser
from .panel import label as label
from .panel import rule as rule
from .panel import set_property as set_property
from .panel import tool as tool
from .rows import ROOT as ROOT
from .rows import Index as Index
from .rows import RowList as RowList
from .rows import RowPainter as RowPainter
from .rows import WrappedItems as WrappedItems
from .rows import draw_line as draw_line
from .theme import LEAST as LEAST
from .theme import MAPS as MAPS
from .theme import MOST as MOST
from .theme import THEMES as THEMES
from .theme import MapName as MapName
from .theme import Theme as Theme
from .theme import ThemeName as ThemeName
from .theme import Tokens as Tokens
from .theme import blend as blend
from .theme import colours as colours
from .theme import fit_icon as fit_icon
from .theme import icon as icon
from .theme import load_resources as load_resources
from .theme import table as table
from .theme import ui_font as ui_font

__all__ = [
    "LEAST",
    "MAPS",
    "MOST",
    "ROOT",
    "THEMES",
    "Age",
    "Arrangement",
    "Captioned",
    "Columns",
    "ElidedLabel",
    "Freshness",
    "Index",
    "MapName",
    "Notes",
    "Panel",
    "Pump",
    "RowList",
    "RowPainter",
    "Theme",
    "ThemeName",
    "Tokens",
    "WrappedItems",
    "blend",
    "bring_in_sight",
    "chooser",
    "colours",
    "draw_line",
    "fit_icon",
    "icon",
    "label",
    "load_resources",
    "rule",
    "set_property",
    "table",
    "tool",
    "ui_font",
]
