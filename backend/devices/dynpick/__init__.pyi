from .driver import DynpickDriver as DynpickDriver
from .emulator import EmulatedDynpick as EmulatedDynpick
from .emulator import emulate_dynpick as emulate_dynpick
from .protocol import SIGNATURES as SIGNATURES

__all__ = [
    "SIGNATURES",
    "DynpickDriver",
    "EmulatedDynpick",
    "emulate_dynpick",
]
