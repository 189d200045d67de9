from .driver import Ft300Driver as Ft300Driver
from .emulator import emulate_ft300 as emulate_ft300
from .protocol import SIGNATURES as SIGNATURES

__all__ = [
    "SIGNATURES",
    "Ft300Driver",
    "emulate_ft300",
]
