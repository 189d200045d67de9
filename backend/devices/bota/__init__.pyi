from .driver import BotaLanguage as BotaLanguage
from .emulator import EmulatedBota as EmulatedBota
from .protocol import Boot as Boot
from .protocol import Frame as Frame
from .protocol import incoming as incoming

__all__ = ["Boot", "BotaLanguage", "EmulatedBota", "Frame", "incoming"]
