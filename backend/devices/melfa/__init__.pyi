from .arm import MelfaArm as MelfaArm
from .emulator import TIMEOUT_CYCLES as TIMEOUT_CYCLES
from .emulator import EmulatedMelfa as EmulatedMelfa
from .emulator import MelfaFront as MelfaFront
from .emulator_arm import frame_of as frame_of
from .emulator_arm import solve as solve
from .emulator_controller import READY_RAD as READY_RAD
from .emulator_controller import TYPE_FORCE as TYPE_FORCE
from .emulator_controller import EmulatedMonitor as EmulatedMonitor
from .force_program import PLACE_LATE_S as PLACE_LATE_S
from .force_sensor import MelfaLanguage as MelfaLanguage
from .force_sensor import monitor_address as monitor_address
from .kinematics import Placing as Placing
from .sockets import SocketWires as SocketWires
from .stream import JOINT_RANGES as JOINT_RANGES
from .stream import check_joints as check_joints

__all__ = [
    "JOINT_RANGES",
    "PLACE_LATE_S",
    "READY_RAD",
    "TIMEOUT_CYCLES",
    "TYPE_FORCE",
    "EmulatedMelfa",
    "EmulatedMonitor",
    "MelfaArm",
    "MelfaFront",
    "MelfaLanguage",
    "Placing",
    "SocketWires",
    "check_joints",
    "frame_of",
    "monitor_address",
    "solve",
]
