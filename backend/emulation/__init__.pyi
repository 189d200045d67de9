from .fault_plan import AMOUNTS as AMOUNTS
from .fault_plan import FaultPlan as FaultPlan
from .fault_plan import Faults as Faults
from .fault_plan import SampleSchedule as SampleSchedule
from .fault_plan import add_noise as add_noise
from .fault_plan import apply_faults as apply_faults
from .fault_plan import hanging_gripper as hanging_gripper
from .fault_plan import load_faults as load_faults
from .fault_plan import parse_fault as parse_fault
from .server import CHUNK as CHUNK
from .server import DeviceServer as DeviceServer
from .server import EmulatedDevice as EmulatedDevice
from .server import PtyServer as PtyServer
from .server import TcpServer as TcpServer
from .server import UdpServer as UdpServer
from .serving import EVERY_ADDRESS as EVERY_ADDRESS
from .serving import BenchTables as BenchTables
from .serving import Emulation as Emulation
from .serving import EmulationChoice as EmulationChoice
from .serving import PictureFunction as PictureFunction
from .serving import SerialSensor as SerialSensor
from .serving import WrenchFunction as WrenchFunction
from .serving import own_address as own_address
from .serving import replace_host as replace_host
from .serving import serve_serial as serve_serial
from .simulated_disturbances import DisturbanceScript as DisturbanceScript
from .simulated_disturbances import parse_script as parse_script

__all__ = [
    "AMOUNTS",
    "CHUNK",
    "EVERY_ADDRESS",
    "BenchTables",
    "DeviceServer",
    "DisturbanceScript",
    "EmulatedDevice",
    "Emulation",
    "EmulationChoice",
    "FaultPlan",
    "Faults",
    "PictureFunction",
    "PtyServer",
    "SampleSchedule",
    "SerialSensor",
    "TcpServer",
    "UdpServer",
    "WrenchFunction",
    "add_noise",
    "apply_faults",
    "hanging_gripper",
    "load_faults",
    "own_address",
    "parse_fault",
    "parse_script",
    "replace_host",
    "serve_serial",
]
