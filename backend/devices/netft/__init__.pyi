from .driver import NetFtDriver as NetFtDriver
from .emulator import EmulatedCalibration as EmulatedCalibration
from .emulator import EmulatedNetFt as EmulatedNetFt
from .emulator import EmulatedPage as EmulatedPage

__all__ = ["EmulatedCalibration", "EmulatedNetFt", "EmulatedPage", "NetFtDriver"]
