from .driver import OptoforceDriver as OptoforceDriver
from .emulator import CAPACITY as CAPACITY
from .emulator import COUNTS as COUNTS
from .emulator import EmulatedOptoforce as EmulatedOptoforce
from .protocol import OptoforceFrame as OptoforceFrame
from .protocol import incoming as incoming

__all__ = [
    "CAPACITY",
    "COUNTS",
    "EmulatedOptoforce",
    "OptoforceDriver",
    "OptoforceFrame",
    "incoming",
]
