from .driver import OptoforceDriver as OptoforceDriver
from .emulator import emulate_optoforce as emulate_optoforce
from .protocol import SIGNATURES as SIGNATURES

__all__ = [
    "SIGNATURES",
    "OptoforceDriver",
    "emulate_optoforce",
]
