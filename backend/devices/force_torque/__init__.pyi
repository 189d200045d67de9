from .driver import DatagramDriver as DatagramDriver
from .driver import FramedDriver as FramedDriver
from .driver import FrameErrors as FrameErrors
from .driver import NotAnsweredError as NotAnsweredError
from .driver import SensorDescription as SensorDescription
from .driver import SensorLink as SensorLink
from .driver import UnansweredError as UnansweredError
from .driver import WrenchDriver as WrenchDriver
from .driver import WrenchReading as WrenchReading
from .driver import ask as ask
from .driver import listen as listen
from .driver import open_link as open_link
from .driver import pause as pause
from .reader import LATE_S as LATE_S
from .reader import ForceTorqueReader as ForceTorqueReader
from .reader import implausible_text as implausible_text
from .reader import overload_fault as overload_fault
from .reader import range_text as range_text
from .reader import require_plausible as require_plausible

__all__ = [
    "LATE_S",
    "DatagramDriver",
    "ForceTorqueReader",
    "FrameErrors",
    "FramedDriver",
    "NotAnsweredError",
    "SensorDescription",
    "SensorLink",
    "UnansweredError",
    "WrenchDriver",
    "WrenchReading",
    "ask",
    "implausible_text",
    "listen",
    "open_link",
    "overload_fault",
    "pause",
    "range_text",
    "require_plausible",
]
