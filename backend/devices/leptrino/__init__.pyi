from .driver import LeptrinoDriver as LeptrinoDriver
from .emulator import emulate_leptrino as emulate_leptrino
from .protocol import SIGNATURES as SIGNATURES

__all__ = [
    "SIGNATURES",
    "LeptrinoDriver",
    "emulate_leptrino",
]
