from .driver import LeptrinoDriver as LeptrinoDriver
from .emulator import EmulatedLeptrino as EmulatedLeptrino
from .protocol import Info as Info
from .protocol import LeptrinoCommand as LeptrinoCommand
from .protocol import LeptrinoSample as LeptrinoSample
from .protocol import Plain as Plain
from .protocol import encode as encode
from .protocol import packets as packets

__all__ = [
    "EmulatedLeptrino",
    "Info",
    "LeptrinoCommand",
    "LeptrinoDriver",
    "LeptrinoSample",
    "Plain",
    "encode",
    "packets",
]
