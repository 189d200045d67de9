from .driver import TactileCamera as TactileCamera
from .driver import find_cameras as find_cameras
from .emulator import SERIAL as SERIAL
from .emulator import GelsightServer as GelsightServer
from .emulator import camera_tables as camera_tables
