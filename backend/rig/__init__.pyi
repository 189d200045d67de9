from .connection import Connection as Connection
from .connection import DeviceLine as DeviceLine
from .connection import Finding as Finding
from .connection import WiredDevices as WiredDevices
from .connection import examine as examine
from .connection import fault_of as fault_of
from .flight_recorder import FlightRecorder as FlightRecorder
from .link import LATE_S as LATE_S
from .timing import Newest as Newest
from .timing import Since as Since
from .timing import Timing as Timing
from .timing import watch as watch

__all__ = [
    "LATE_S",
    "Connection",
    "DeviceLine",
    "Finding",
    "FlightRecorder",
    "Newest",
    "Since",
    "Timing",
    "WiredDevices",
    "examine",
    "fault_of",
    "watch",
]
