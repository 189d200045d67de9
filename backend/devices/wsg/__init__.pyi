from .driver import WsgGripper as WsgGripper
from .driver import make_wsg as make_wsg
from .emulator import EmulatedWsg as EmulatedWsg
from .emulator import emulate_wsg as emulate_wsg
from .gcl import SIGNATURES as SIGNATURES

__all__ = [
    "SIGNATURES",
    "EmulatedWsg",
    "WsgGripper",
    "emulate_wsg",
    "make_wsg",
]
