from .driver import TactileCamera as TactileCamera
from .driver import find_cameras as find_cameras
from .driver import make_gelsight as make_gelsight
from .emulator import SERIAL as SERIAL
from .emulator import GelsightServer as GelsightServer
from .emulator import camera_tables as camera_tables
from .emulator import emulate_gelsight as emulate_gelsight

__all__ = [
    "SERIAL",
    "GelsightServer",
    "TactileCamera",
    "camera_tables",
    "emulate_gelsight",
    "find_cameras",
    "make_gelsight",
]
