"""The numbers of Weiss WSG grippers: commands, status codes, flags and grasping states.

Source: command set reference manual, firmware 2.2.0.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag


class Command(IntEnum):
    """Command ids."""

    LOOP = 0x06
    DISCONNECT = 0x07
    HOME = 0x20
    PREPOSITION = 0x21
    STOP = 0x22
    FAST_STOP = 0x23
    ACKNOWLEDGE = 0x24
    GRASP = 0x25
    RELEASE = 0x26
    SET_ACCELERATION = 0x30
    GET_ACCELERATION = 0x31
    SET_FORCE_LIMIT = 0x32
    GET_FORCE_LIMIT = 0x33
    SET_SOFT_LIMITS = 0x34
    GET_SOFT_LIMITS = 0x35
    CLEAR_SOFT_LIMITS = 0x36
    OVERDRIVE = 0x37
    TARE = 0x38
    SYSTEM_STATE = 0x40
    GRASP_STATE = 0x41
    STATISTICS = 0x42
    WIDTH = 0x43
    SPEED = 0x44
    FORCE = 0x45
    TEMPERATURE = 0x46
    SYSTEM_INFO = 0x50
    SET_TAG = 0x51
    GET_TAG = 0x52
    SYSTEM_LIMITS = 0x53


class Status(IntEnum):
    """Status of a reply; any other value is a fault of the device."""

    SUCCESS = 0
    NOT_AVAILABLE = 1
    NO_SENSOR = 2
    NOT_INITIALIZED = 3
    ALREADY_RUNNING = 4
    FEATURE_NOT_SUPPORTED = 5
    INCONSISTENT_DATA = 6
    TIMEOUT = 7
    READ_ERROR = 8
    WRITE_ERROR = 9
    INSUFFICIENT_RESOURCES = 10
    CHECKSUM_ERROR = 11
    NO_PARAM_EXPECTED = 12
    NOT_ENOUGH_PARAMS = 13
    CMD_UNKNOWN = 14
    CMD_FORMAT_ERROR = 15
    ACCESS_DENIED = 16
    ALREADY_OPEN = 17
    CMD_FAILED = 18
    CMD_ABORTED = 19
    INVALID_HANDLE = 20
    NOT_FOUND = 21
    NOT_OPEN = 22
    IO_ERROR = 23
    INVALID_PARAMETER = 24
    INDEX_OUT_OF_BOUNDS = 25
    CMD_PENDING = 26
    OVERRUN = 27
    RANGE_ERROR = 28
    AXIS_BLOCKED = 29
    FILE_EXISTS = 30


class SystemFlag(IntFlag):
    """Bits of the system state."""

    REFERENCED = 1 << 0
    MOVING = 1 << 1
    BLOCKED_MINUS = 1 << 2
    BLOCKED_PLUS = 1 << 3
    SOFT_LIMIT_MINUS = 1 << 4
    SOFT_LIMIT_PLUS = 1 << 5
    AXIS_STOPPED = 1 << 6
    TARGET_POS_REACHED = 1 << 7
    OVERDRIVE_MODE = 1 << 8
    FORCECNTL_MODE = 1 << 9
    FAST_STOP = 1 << 12
    TEMP_WARNING = 1 << 13
    TEMP_FAULT = 1 << 14
    POWER_FAULT = 1 << 15
    CURR_FAULT = 1 << 16
    FINGER_FAULT = 1 << 17
    CMD_FAILURE = 1 << 18
    SCRIPT_RUNNING = 1 << 19
    SCRIPT_FAILURE = 1 << 20


class GraspState(IntEnum):
    """Grasping states; ERROR only in newer firmware."""

    IDLE = 0
    GRASPING = 1
    NO_PART_FOUND = 2
    PART_LOST = 3
    HOLDING = 4
    RELEASING = 5
    POSITIONING = 6
    ERROR = 7
