from .driver import MelfaArm as MelfaArm
from .emulated_controller import READY_RAD as READY_RAD
from .emulated_controller import frame_of as frame_of
from .emulated_controller import solve as solve
from .emulator import TIMEOUT_CYCLES as TIMEOUT_CYCLES
from .emulator import EmulatedMelfa as EmulatedMelfa
from .emulator import MelfaServer as MelfaServer
from .emulator import melfa_tables as melfa_tables
from .force_program import PLACE_LATE_S as PLACE_LATE_S
from .kinematics import JOINT_RANGES as JOINT_RANGES
from .kinematics import MelfaPlacement as MelfaPlacement
from .kinematics import check_joints as check_joints

__all__ = [
    "JOINT_RANGES",
    "PLACE_LATE_S",
    "READY_RAD",
    "TIMEOUT_CYCLES",
    "EmulatedMelfa",
    "MelfaArm",
    "MelfaPlacement",
    "MelfaServer",
    "check_joints",
    "frame_of",
    "melfa_tables",
    "solve",
]
