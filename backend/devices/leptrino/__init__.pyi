from .driver import LeptrinoLanguage as LeptrinoLanguage
from .emulator import EmulatedLeptrino as EmulatedLeptrino
from .protocol import Command as Command
from .protocol import Info as Info
from .protocol import Plain as Plain
from .protocol import Sample as Sample
from .protocol import encode as encode
from .protocol import packets as packets

__all__ = [
    "Command",
    "EmulatedLeptrino",
    "Info",
    "LeptrinoLanguage",
    "Plain",
    "Sample",
    "encode",
    "packets",
]
