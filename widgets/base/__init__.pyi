from .freshness import Age as Age
from .freshness import EventPump as EventPump
from .freshness import Freshness as Freshness
from .freshness import scroll_into_view as scroll_into_view
from .panel import CaptionedView as CaptionedView
from .panel import ColumnArrangement as ColumnArrangement
from .panel import Columns as Columns
from .panel import DrawnView as DrawnView
from .panel import ElidedLabel as ElidedLabel
from .panel import Panel as Panel
from .panel import ScrollingNote as ScrollingNote
from .panel import add_items as add_items
from .panel import compact_combo_box as compact_combo_box
from .panel import describe as describe
from .panel import flat_button as flat_button
from .panel import hbox as hbox
from .panel import label as label
from .panel import rule as rule
from .panel import scroll_area as scroll_area
from .panel import set_property as set_property
from .panel import vbox as vbox
from .rows import ENTER as ENTER
from .rows import ROOT as ROOT
from .rows import KeylessList as KeylessList
from .rows import ModelIndex as ModelIndex
from .rows import RowList as RowList
from .rows import RowPainter as RowPainter
from .rows import WrappedItemDelegate as WrappedItemDelegate
from .rows import draw_elided_line as draw_elided_line
from .rows import open_over as open_over
from .rows import plain_table as plain_table
from .rows import signed as signed
from .rows import true_minus as true_minus
from .theme import MAPS as MAPS
from .theme import MAX_SCALE as MAX_SCALE
from .theme import MIN_SCALE as MIN_SCALE
from .theme import THEMES as THEMES
from .theme import MapName as MapName
from .theme import Theme as Theme
from .theme import ThemeName as ThemeName
from .theme import Tokens as Tokens
from .theme import blend as blend
from .theme import colour_table as colour_table
from .theme import fit_icon as fit_icon
from .theme import icon as icon
from .theme import load_resources as load_resources
from .theme import map_colours as map_colours
from .theme import ui_font as ui_font

__all__ = [
    "ENTER",
    "MAPS",
    "MAX_SCALE",
    "MIN_SCALE",
    "ROOT",
    "THEMES",
    "Age",
    "CaptionedView",
    "ColumnArrangement",
    "Columns",
    "DrawnView",
    "ElidedLabel",
    "EventPump",
    "Freshness",
    "KeylessList",
    "MapName",
    "ModelIndex",
    "Panel",
    "RowList",
    "RowPainter",
    "ScrollingNote",
    "Theme",
    "ThemeName",
    "Tokens",
    "WrappedItemDelegate",
    "add_items",
    "blend",
    "colour_table",
    "compact_combo_box",
    "describe",
    "draw_elided_line",
    "fit_icon",
    "flat_button",
    "hbox",
    "icon",
    "label",
    "load_resources",
    "map_colours",
    "open_over",
    "plain_table",
    "rule",
    "scroll_area",
    "scroll_into_view",
    "set_property",
    "signed",
    "true_minus",
    "ui_font",
    "vbox",
]
