from .driver import OptoforceLanguage as OptoforceLanguage
from .emulator import CAPACITY as CAPACITY
from .emulator import COUNTS as COUNTS
from .emulator import EmulatedOptoforce as EmulatedOptoforce
from .protocol import Frame as Frame
from .protocol import incoming as incoming

__all__ = ["CAPACITY", "COUNTS", "EmulatedOptoforce", "Frame", "OptoforceLanguage", "incoming"]
