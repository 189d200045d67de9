from .driver import Ft300Driver as Ft300Driver
from .emulator import EmulatedFt300 as EmulatedFt300
from .protocol import FIRMWARE_REGISTER as FIRMWARE_REGISTER
from .protocol import Ft300Sample as Ft300Sample
from .protocol import Read as Read
from .protocol import Registers as Registers
from .protocol import encode as encode
from .protocol import incoming as incoming

__all__ = [
    "FIRMWARE_REGISTER",
    "EmulatedFt300",
    "Ft300Driver",
    "Ft300Sample",
    "Read",
    "Registers",
    "encode",
    "incoming",
]
