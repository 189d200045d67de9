from .driver import BotaDriver as BotaDriver
from .emulator import EmulatedBota as EmulatedBota
from .protocol import Boot as Boot
from .protocol import BotaFrame as BotaFrame
from .protocol import incoming as incoming

__all__ = ["Boot", "BotaDriver", "BotaFrame", "EmulatedBota", "incoming"]
