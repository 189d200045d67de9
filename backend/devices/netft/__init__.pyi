from .driver import NetFtLanguage as NetFtLanguage
from .emulator import EmulatedCalibration as EmulatedCalibration
from .emulator import EmulatedNetFt as EmulatedNetFt
from .emulator import EmulatedPage as EmulatedPage

__all__ = ["EmulatedCalibration", "EmulatedNetFt", "EmulatedPage", "NetFtLanguage"]
