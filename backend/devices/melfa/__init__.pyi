from .driver import MelfaArm as MelfaArm
from .driver import make_melfa as make_melfa
from .emulated_controller import READY_RAD as READY_RAD
from .emulated_controller import frame_of as frame_of
from .emulated_controller import solve as solve
from .emulator import TIMEOUT_CYCLES as TIMEOUT_CYCLES
from .emulator import EmulatedMelfa as EmulatedMelfa
from .emulator import MelfaServer as MelfaServer
from .emulator import emulate_melfa as emulate_melfa
from .emulator import emulate_monitor as emulate_monitor
from .emulator import melfa_tables as melfa_tables
from .force_program import PLACE_LATE_S as PLACE_LATE_S
from .kinematics import JOINT_RANGES as JOINT_RANGES
from .kinematics import MelfaPlacement as MelfaPlacement
from .kinematics import check_joints as check_joints
from .wrist_sensor import MelfaWrenchDriver as MelfaWrenchDriver

__all__ = [
    "JOINT_RANGES",
    "PLACE_LATE_S",
    "READY_RAD",
    "TIMEOUT_CYCLES",
    "EmulatedMelfa",
    "MelfaArm",
    "MelfaPlacement",
    "MelfaServer",
    "MelfaWrenchDriver",
    "check_joints",
    "emulate_melfa",
    "emulate_monitor",
    "frame_of",
    "make_melfa",
    "melfa_tables",
    "solve",
]
