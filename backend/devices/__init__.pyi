from .connection import choices as choices
from .connection import reconnect as reconnect
from .connection import refuse_unknown_drivers as refuse_unknown_drivers
from .connection import require_serial as require_serial
from .force_torque_registry import make_force_torque as make_force_torque
from .guarded import GuardedArm as GuardedArm
from .guarded import GuardedGripper as GuardedGripper
from .interlock import LEASE_S as LEASE_S
from .interlock import MAX_WIDTH_CHANGE_MM as MAX_WIDTH_CHANGE_MM
from .interlock import RETREAT_MM as RETREAT_MM
from .interlock import RETREAT_MM_S as RETREAT_MM_S
from .interlock import STATIONARY_MM as STATIONARY_MM
from .interlock import UNLOADED_N as UNLOADED_N
from .interlock import Interlock as Interlock
from .interlock import JigEvidence as JigEvidence
from .interlock import Limits as Limits
from .interlock import ReleaseEvidence as ReleaseEvidence
from .interlock import Retreating as Retreating
from .interlock import jig_refusal as jig_refusal
from .interlock import release_refusal as release_refusal
from .jog import FRAMES as FRAMES
from .jog import STEPS_DEG as STEPS_DEG
from .jog import STEPS_MM as STEPS_MM
from .jog import Around as Around
from .jog import Axis as Axis
from .jog import Frame as Frame
from .jog import Jog as Jog
from .jog import JogOrder as JogOrder
from .jog import Room as Room
from .jog import signed_name as signed_name
from .jog import turns as turns
from .jog_limits import refuse_outside as refuse_outside
from .protocols import STEPS as STEPS
from .protocols import STILL as STILL
from .protocols import TRACE as TRACE
from .protocols import TURN_RAD_S as TURN_RAD_S
from .protocols import VOID_PRESS as VOID_PRESS
from .protocols import Arm as Arm
from .protocols import ArmStatus as ArmStatus
from .protocols import ByHand as ByHand
from .protocols import CommandedMotion as CommandedMotion
from .protocols import Device as Device
from .protocols import DeviceState as DeviceState
from .protocols import ForceTorqueSensor as ForceTorqueSensor
from .protocols import Gripper as Gripper
from .protocols import GripStatus as GripStatus
from .protocols import Health as Health
from .protocols import Homing as Homing
from .protocols import Identity as Identity
from .protocols import Joints as Joints
from .protocols import Motion as Motion
from .protocols import PressCommand as PressCommand
from .protocols import Right as Right
from .protocols import RobotMode as RobotMode
from .protocols import SafetyMode as SafetyMode
from .protocols import Steps as Steps
from .protocols import Stepwise as Stepwise
from .protocols import Traced as Traced
from .protocols import Vector as Vector
from .protocols import last_places_mm as last_places_mm
from .protocols import replaced_fault as replaced_fault
from .protocols import servo_off_fault as servo_off_fault
from .protocols import stopped_fault as stopped_fault
from .protocols import travelled_mm as travelled_mm
from .registry import make_arm as make_arm
from .supervision import NAMES as NAMES
from .supervision import Arrivals as Arrivals
from .supervision import Degraded as Degraded
from .supervision import Supervision as Supervision
from .supervision import TellsSlow as TellsSlow
from .supervision import refuse_degraded as refuse_degraded

__all__ = [
    "FRAMES",
    "LEASE_S",
    "MAX_WIDTH_CHANGE_MM",
    "NAMES",
    "RETREAT_MM",
    "RETREAT_MM_S",
    "STATIONARY_MM",
    "STEPS",
    "STEPS_DEG",
    "STEPS_MM",
    "STILL",
    "TRACE",
    "TURN_RAD_S",
    "UNLOADED_N",
    "VOID_PRESS",
    "Arm",
    "ArmStatus",
    "Around",
    "Arrivals",
    "Axis",
    "ByHand",
    "CommandedMotion",
    "Degraded",
    "Device",
    "DeviceState",
    "ForceTorqueSensor",
    "Frame",
    "GripStatus",
    "Gripper",
    "GuardedArm",
    "GuardedGripper",
    "Health",
    "Homing",
    "Identity",
    "Interlock",
    "JigEvidence",
    "Jog",
    "JogOrder",
    "Joints",
    "Limits",
    "Motion",
    "PressCommand",
    "ReleaseEvidence",
    "Retreating",
    "Right",
    "RobotMode",
    "Room",
    "SafetyMode",
    "Steps",
    "Stepwise",
    "Supervision",
    "TellsSlow",
    "Traced",
    "Vector",
    "choices",
    "jig_refusal",
    "last_places_mm",
    "make_arm",
    "make_force_torque",
    "reconnect",
    "refuse_degraded",
    "refuse_outside",
    "refuse_unknown_drivers",
    "release_refusal",
    "replaced_fault",
    "require_serial",
    "servo_off_fault",
    "signed_name",
    "stopped_fault",
    "travelled_mm",
    "turns",
]
