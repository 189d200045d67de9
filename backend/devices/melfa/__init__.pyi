from .driver import MelfaArm as MelfaArm
from .emulated_channels import TYPE_FORCE as TYPE_FORCE
from .emulated_channels import EmulatedMonitor as EmulatedMonitor
from .emulated_controller import READY_RAD as READY_RAD
from .emulated_controller import frame_of as frame_of
from .emulated_controller import solve as solve
from .emulator import TIMEOUT_CYCLES as TIMEOUT_CYCLES
from .emulator import EmulatedMelfa as EmulatedMelfa
from .emulator import MelfaServer as MelfaServer
from .force_program import PLACE_LATE_S as PLACE_LATE_S
from .kinematics import JOINT_RANGES as JOINT_RANGES
from .kinematics import MelfaPlacement as MelfaPlacement
from .kinematics import check_joints as check_joints
from .sockets import SocketLinks as SocketLinks
from .wrist_sensor import MelfaWrenchDriver as MelfaWrenchDriver
from .wrist_sensor import monitor_address as monitor_address

__all__ = [
    "JOINT_RANGES",
    "PLACE_LATE_S",
    "READY_RAD",
    "TIMEOUT_CYCLES",
    "TYPE_FORCE",
    "EmulatedMelfa",
    "EmulatedMonitor",
    "MelfaArm",
    "MelfaPlacement",
    "MelfaServer",
    "MelfaWrenchDriver",
    "SocketLinks",
    "check_joints",
    "frame_of",
    "monitor_address",
    "solve",
]
