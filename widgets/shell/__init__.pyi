from .devices import ChipState as ChipState
from .devices import ChipValue as ChipValue
from .devices import DeviceInspector as DeviceInspector
from .fault_cards import STOPPED as STOPPED
from .fault_cards import CardQuestion as CardQuestion
from .fault_cards import CardText as CardText
from .fault_cards import FaultCards as FaultCards
from .fault_cards import UnsavedBanner as UnsavedBanner
from .keys import CommandPalette as CommandPalette
from .keys import KeyDialog as KeyDialog
from .keys import KeySheet as KeySheet
from .keys import PaletteEntry as PaletteEntry
from .state import Colour as Colour
from .state import PillState as PillState
from .state import Shape as Shape
from .state import StateStrip as StateStrip
from .top_bar import DEVICE_CHIPS as DEVICE_CHIPS
from .top_bar import BenchBanner as BenchBanner
from .top_bar import TopBar as TopBar
from .tour import RING_PX as RING_PX
from .tour import Spotlight as Spotlight
from .tour import TourCard as TourCard
from .tour import TourStop as TourStop

__all__ = [
    "DEVICE_CHIPS",
    "RING_PX",
    "STOPPED",
    "BenchBanner",
    "CardQuestion",
    "CardText",
    "ChipState",
    "ChipValue",
    "Colour",
    "CommandPalette",
    "DeviceInspector",
    "FaultCards",
    "KeyDialog",
    "KeySheet",
    "PaletteEntry",
    "PillState",
    "Shape",
    "Spotlight",
    "StateStrip",
    "TopBar",
    "TourCard",
    "TourStop",
    "UnsavedBanner",
]
