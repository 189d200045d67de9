from .driver import DynpickDriver as DynpickDriver
from .emulator import EmulatedDynpick as EmulatedDynpick
from .protocol import DynpickCommand as DynpickCommand
from .protocol import DynpickRecord as DynpickRecord
from .protocol import records as records

__all__ = ["DynpickCommand", "DynpickDriver", "DynpickRecord", "EmulatedDynpick", "records"]
