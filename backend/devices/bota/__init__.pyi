from .driver import BotaDriver as BotaDriver
from .emulator import emulate_bota as emulate_bota
from .protocol import SIGNATURES as SIGNATURES

__all__ = [
    "SIGNATURES",
    "BotaDriver",
    "emulate_bota",
]
