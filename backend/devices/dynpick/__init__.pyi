from .driver import DynpickLanguage as DynpickLanguage
from .emulator import EmulatedDynpick as EmulatedDynpick
from .protocol import Command as Command
from .protocol import Record as Record
from .protocol import records as records

__all__ = ["Command", "DynpickLanguage", "EmulatedDynpick", "Record", "records"]
