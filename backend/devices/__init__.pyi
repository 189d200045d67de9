from .discovery import choices as choices
from .factories import make_arm as make_arm
from .factories import make_force_torque as make_force_torque
from .factories import make_gripper as make_gripper
from .factories import make_tactile as make_tactile
from .guarded_devices import GuardedArm as GuardedArm
from .guarded_devices import GuardedGripper as GuardedGripper
from .interlock import LEASE_S as LEASE_S
from .interlock import MAX_WIDTH_CHANGE_MM as MAX_WIDTH_CHANGE_MM
from .interlock import STATIONARY_MM as STATIONARY_MM
from .interlock import UNLOADED_N as UNLOADED_N
from .interlock import ByHand as ByHand
from .interlock import Interlock as Interlock
from .interlock import JigEvidence as JigEvidence
from .interlock import Limits as Limits
from .interlock import ReleaseAuthorisation as ReleaseAuthorisation
from .interlock import ReleaseEvidence as ReleaseEvidence
from .interlock import jig_refusal as jig_refusal
from .interlock import recent_positions_mm as recent_positions_mm
from .interlock import refuse_outside as refuse_outside
from .interlock import release_refusal as release_refusal
from .interlock import travelled_mm as travelled_mm
from .jog import FRAMES as FRAMES
from .jog import STEPS_DEG as STEPS_DEG
from .jog import STEPS_MM as STEPS_MM
from .jog import Axis as Axis
from .jog import Frame as Frame
from .jog import Jog as Jog
from .jog import JogOrder as JogOrder
from .jog import JogRange as JogRange
from .jog import JogSurroundings as JogSurroundings
from .jog import signed_name as signed_name
from .jog import turns as turns
from .protocols import CONNECTION_STEPS as CONNECTION_STEPS
from .protocols import RETREAT_MM as RETREAT_MM
from .protocols import RETREAT_MM_S as RETREAT_MM_S
from .protocols import STILL as STILL
from .protocols import TRACE_NAMES as TRACE_NAMES
from .protocols import TURN_RAD_S as TURN_RAD_S
from .protocols import VOID_PRESS as VOID_PRESS
from .protocols import Arm as Arm
from .protocols import ArmStatus as ArmStatus
from .protocols import CommandedMotion as CommandedMotion
from .protocols import ConnectionSteps as ConnectionSteps
from .protocols import Device as Device
from .protocols import DeviceState as DeviceState
from .protocols import ForceTorqueSensor as ForceTorqueSensor
from .protocols import Gripper as Gripper
from .protocols import GripStatus as GripStatus
from .protocols import Health as Health
from .protocols import HomingGripper as HomingGripper
from .protocols import Identity as Identity
from .protocols import Joints as Joints
from .protocols import Motion as Motion
from .protocols import PressCommand as PressCommand
from .protocols import ReportsConnectionSteps as ReportsConnectionSteps
from .protocols import RetreatingArm as RetreatingArm
from .protocols import RobotMode as RobotMode
from .protocols import SafetyMode as SafetyMode
from .protocols import TracedArm as TracedArm
from .protocols import Vector as Vector
from .protocols import replaced_fault as replaced_fault
from .protocols import servo_off_fault as servo_off_fault
from .protocols import stopped_fault as stopped_fault
from .registry import emulated_makes as emulated_makes
from .registry import refuse_unknown_drivers as refuse_unknown_drivers
from .safety_trips import Supervision as Supervision
from .sensor_faults import NAMES as NAMES
from .sensor_faults import ArrivalMonitor as ArrivalMonitor
from .sensor_faults import DegradedDevice as DegradedDevice
from .sensor_faults import ReportsSlowness as ReportsSlowness
from .sensor_faults import refuse_degraded as refuse_degraded

__all__ = [
    "CONNECTION_STEPS",
    "FRAMES",
    "LEASE_S",
    "MAX_WIDTH_CHANGE_MM",
    "NAMES",
    "RETREAT_MM",
    "RETREAT_MM_S",
    "STATIONARY_MM",
    "STEPS_DEG",
    "STEPS_MM",
    "STILL",
    "TRACE_NAMES",
    "TURN_RAD_S",
    "UNLOADED_N",
    "VOID_PRESS",
    "Arm",
    "ArmStatus",
    "ArrivalMonitor",
    "Axis",
    "ByHand",
    "CommandedMotion",
    "ConnectionSteps",
    "DegradedDevice",
    "Device",
    "DeviceState",
    "ForceTorqueSensor",
    "Frame",
    "GripStatus",
    "Gripper",
    "GuardedArm",
    "GuardedGripper",
    "Health",
    "HomingGripper",
    "Identity",
    "Interlock",
    "JigEvidence",
    "Jog",
    "JogOrder",
    "JogRange",
    "JogSurroundings",
    "Joints",
    "Limits",
    "Motion",
    "PressCommand",
    "ReleaseAuthorisation",
    "ReleaseEvidence",
    "ReportsConnectionSteps",
    "ReportsSlowness",
    "RetreatingArm",
    "RobotMode",
    "SafetyMode",
    "Supervision",
    "TracedArm",
    "Vector",
    "choices",
    "emulated_makes",
    "jig_refusal",
    "make_arm",
    "make_force_torque",
    "make_gripper",
    "make_tactile",
    "recent_positions_mm",
    "refuse_degraded",
    "refuse_outside",
    "refuse_unknown_drivers",
    "release_refusal",
    "replaced_fault",
    "servo_off_fault",
    "signed_name",
    "stopped_fault",
    "travelled_mm",
    "turns",
]
