from .driver import Ft300Language as Ft300Language
from .emulator import EmulatedFt300 as EmulatedFt300
from .protocol import FIRMWARE_REGISTER as FIRMWARE_REGISTER
from .protocol import Read as Read
from .protocol import Registers as Registers
from .protocol import Sample as Sample
from .protocol import encode as encode
from .protocol import incoming as incoming

__all__ = [
    "FIRMWARE_REGISTER",
    "EmulatedFt300",
    "Ft300Language",
    "Read",
    "Registers",
    "Sample",
    "encode",
    "incoming",
]
