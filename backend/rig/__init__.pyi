from .connection import BenchConnection as BenchConnection
from .connection import DeviceStatus as DeviceStatus
from .connection import fault_of as fault_of
from .connection import reconnect as reconnect
from .diagnostics import DeviceFinding as DeviceFinding
from .diagnostics import NewestStamp as NewestStamp
from .diagnostics import SensorTiming as SensorTiming
from .diagnostics import StampsSince as StampsSince
from .diagnostics import examine_devices as examine_devices
from .diagnostics import measure_timing as measure_timing
from .flight_recorder import FlightRecorder as FlightRecorder
from .link import LATE_S as LATE_S
from .remote_devices import BenchDevices as BenchDevices

__all__ = [
    "LATE_S",
    "BenchConnection",
    "BenchDevices",
    "DeviceFinding",
    "DeviceStatus",
    "FlightRecorder",
    "NewestStamp",
    "SensorTiming",
    "StampsSince",
    "examine_devices",
    "fault_of",
    "measure_timing",
    "reconnect",
]
