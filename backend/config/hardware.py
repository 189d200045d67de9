"""Settings of real devices; a lab file overrides them.

No public source confirms the defaults. Drivers and emulators read the same settings.
``docs/hardware.md`` lists each with its reason.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from touchdown.backend.config.method import NonNegative, Positive, Settings

# A file with one of these keys is a lab file; simulation settings have none.
LAB_FILE_KEYS = frozenset({"version", "kind", "melfa", "wsg", "ft", "gelsight"})

Port = Annotated[int, Field(ge=1, le=65535)]
Share = Annotated[float, Field(gt=0, le=1)]
U16 = Annotated[int, Field(ge=0, le=0xFFFF)]
Count = Annotated[int, Field(ge=1, le=1_000_000)]
Six = tuple[Positive, Positive, Positive, Positive, Positive, Positive]
Row = tuple[float, float, float]
ProgramName = Annotated[str, Field(pattern="^[A-Za-z0-9_]{1,12}$")]

# Defaults without a source; displayed as such until the lab file sets them.
PLACEHOLDERS = ("melfa.mxt.error_overspeed", "melfa.mxt.error_timeout", "melfa.r3.error_unknown")

# Names of camera controls in newer and older kernels.
CONTROL_NAMES: dict[str, tuple[str, ...]] = {
    "white_balance_auto": ("white_balance_automatic", "white_balance_temperature_auto"),
    "exposure_auto": ("auto_exposure", "exposure_auto"),
    "exposure": ("exposure_time_absolute", "exposure_absolute"),
    "exposure_priority": ("exposure_dynamic_framerate", "exposure_auto_priority"),
    "white_balance": ("white_balance_temperature",),
}


class DeviceSettings(Settings):
    """Settings of which an older lab file may name retired keys; these never had an effect."""

    retired: ClassVar[frozenset[str]] = frozenset()

    @model_validator(mode="before")
    @classmethod
    def _without_retired(cls, content: Any) -> Any:
        if isinstance(content, Mapping):
            return {key: value for key, value in content.items() if key not in cls.retired}
        return content


class MonitorSettings(DeviceSettings):
    """Real-time monitor of the controller; off without data type numbers."""

    retired = frozenset({"type_robmon", "type_pose", "type_joint"})

    port: Port = 12000
    type_force: U16 | None = None


class MxtSettings(DeviceSettings):
    """Real-time external control."""

    retired = frozenset({"lost_limit"})

    position_type: Literal[0, 1, 2] = 1
    port: Port = 10000
    program: ProgramName = "TDMXT"  # controller program that opens the stream
    allow_unlimited: bool = False  # stream even if the controller never ends a silent stream
    send_type_must_match: bool = True
    ends_on_servo_off: bool = True
    mxttout: Annotated[int, Field(ge=-1, le=32_767)] = -1
    error_overspeed: U16 = 9901
    error_timeout: U16 = 9902
    step_fraction: Share = 0.5
    start_timeout_s: Positive = 3.0


class R3Settings(Settings):
    """Command channel."""

    port: Port = 10001
    stop_port: Port = 10002  # second connection that carries STOP only
    error_unknown: U16 = 9903
    reply_terminator: Literal["same", "none", "cr", "crlf"] = "same"
    reply_gap_ms: Positive = 30.0


class ForceControlSettings(DeviceSettings):
    """The controller's force control."""

    retired = frozenset({"limited_stiffness_mode", "off_on_reset"})

    # Controller program for presses with ``stiffness_mode`` controller.
    program: ProgramName = "TDPROBE"
    damping: NonNegative = 0.0
    frame: Literal[0, 1] = 1


class ForceSensorSettings(Settings):
    """The controller's own force sensor."""

    rated_n: Positive = 200.0
    rated_nm: Positive = 4.0


class MelfaSettings(DeviceSettings):
    """Arm and controller."""

    retired = frozenset({"mxt_in_fsc", "flags", "force_variable_text"})

    # "melfa", "ur", or the name of an entry point.
    driver: Annotated[str, Field(min_length=1)] = "melfa"
    host: str = "192.168.0.20"
    robot_type: str = "RV-5AS-D"  # start of the arm type that the controller reports; empty: any
    origin_mm: Row = (450.0, 0.0, 0.0)  # bench origin in the base frame of the arm
    yaw_deg: float = 0.0  # rotation of the bench in the base frame of the arm
    hand_deg: float = 180.0  # rotation of the flange's x axis relative to that of the bench
    tool_mm: Positive = 200.0  # distance from the flange to the grasp pivot
    # SCHED_FIFO priority of the stream if the system allows it; 0: none.
    realtime_priority: Annotated[int, Field(ge=0, le=98)] = 50
    # Duration of the cycle-time check before the arm is switched on; 0: no check.
    idle_check_s: Annotated[float, Field(ge=0, le=60)] = 5.0
    arm_lag_ms: NonNegative = 10.0
    sensor_lag_ms: NonNegative = 16.0  # age of a wrench sample on arrival: adapter, line, filter
    euler: Literal["Rz(C) Ry(B) Rx(A)", "Rx(A) Ry(B) Rz(C)"] = "Rz(C) Ry(B) Rx(A)"
    # Compliance in a press by this computer over the stream, or by the controller.
    stiffness_mode: Literal["software", "controller"] = "software"
    servo_delay_s: NonNegative = 2.0
    servo_timeout_s: Positive = 10.0
    override_start: Annotated[int, Field(ge=1, le=100)] = 10
    probe_force_limit_n: Positive = 30.0
    probe_margin_s: Positive = 2.0
    monitor: MonitorSettings = MonitorSettings()
    mxt: MxtSettings = MxtSettings()
    r3: R3Settings = R3Settings()
    fsc: ForceControlSettings = ForceControlSettings()
    fs: ForceSensorSettings = ForceSensorSettings()


class UrSettings(Settings):
    """A Universal Robots arm in place of the MELFA: ``melfa.driver = "ur"``."""

    host: str = "192.168.0.3"
    # 125 for a CB series, up to 500 for an e-series.
    rate_hz: Annotated[float, Field(ge=50, le=500)] = 125.0
    origin_mm: Row = (450.0, 0.0, 0.0)  # bench origin in the base frame of the arm
    yaw_deg: float = 0.0  # rotation of the bench in the base frame of the arm
    tool_mm: Positive = 200.0  # distance from the flange to the grasp pivot
    # Smoothing of the servo motion; adds about this lag.
    lookahead_s: Annotated[float, Field(ge=0.03, le=0.2)] = 0.05
    gain: Annotated[float, Field(ge=100, le=2000)] = 600.0
    arm_lag_ms: NonNegative = 60.0
    sensor_lag_ms: NonNegative = 16.0
    watchdog_hz: Positive = 10.0  # the controller stops if commands arrive less often
    # Range of the built-in sensor of a UR5e, N and N·m.
    rated: Six = (50.0, 50.0, 50.0, 10.0, 10.0, 10.0)


class WsgSettings(DeviceSettings):
    """Gripper; the ranges apply only if the gripper does not report its own."""

    retired = frozenset({"bad_crc_reply", "grasp_force_parameter", "temperature"})

    driver: Annotated[str, Field(min_length=1)] = "wsg"  # "wsg", or the name of an entry point
    protocol: Literal["binary", "gcl"] = "binary"
    host: str = "192.168.1.20"
    port: Port = 1000
    stroke_mm: Positive = 66.0
    speed_min: Positive = 5.0
    speed_max: Positive = 400.0
    force_min_n: Positive = 5.0
    force_max_n: Positive = 50.0
    acceleration_mm_s2: Positive = 500.0
    grasp_width_mm: NonNegative = 0.0  # nominal width of a grasp; 0 closes until contact
    grasp_speed_mm_s: Positive = 50.0
    # Commanded force: "device" sum over both fingers, "finger" each.
    force_convention: Literal["device", "finger"] = "device"
    # True if a piece stays held after an announced disconnect. Otherwise no disconnect is announced
    # while a piece is held, and the fast stop of the gripper keeps it.
    keeps_grip_after_07: bool = True
    gcl_autosend_third: Literal["true", "false"] = "true"
    # Meaning of the distance in RELEASE (text protocol): opening width, or way of each finger.
    gcl_release: Literal["width", "finger"] = "width"
    update_ms: Annotated[int, Field(ge=1, le=1000)] = 50
    margin_s: Positive = 1.0


class ForceTorqueSettings(Settings):
    """Make and mounting of the wrist sensor."""

    # "melfa", "dynpick", "leptrino", "ft300", "bota", "optoforce", "netft", "ur", or an entry
    # point.
    driver: Annotated[str, Field(min_length=1)] = "melfa"
    address: str = ""  # path of a serial port, ``socket://host:port`` or ``udp://host:port``
    # Sensor frame to tool frame.
    rotation: tuple[Row, Row, Row] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    sign: Literal[1, -1] = 1  # 1: force on the sensor, -1: force by the sensor
    # For sensors without sample numbers whose rate is not the default.
    rate_hz: Positive | None = None
    # Age of the newest sample on arrival; its time stamp is earlier by this.
    latency_ms: NonNegative = 0.0
    silence_s: Positive = 0.2
    # After this many identical samples the signal counts as stuck.
    stuck_after: Annotated[int, Field(ge=2, le=1000)] = 5

    @field_validator("rotation")
    @classmethod
    def _is_a_rotation(cls, rows: tuple[Row, Row, Row]) -> tuple[Row, Row, Row]:
        matrix = np.array(rows)
        if not np.abs(matrix @ matrix.T - np.eye(3)).max() < 1e-6:
            raise ValueError("the rows are not at right angles and of length 1")
        if np.linalg.det(matrix) < 0:
            raise ValueError("this is a reflection, not a rotation")
        return rows


class DynpickSettings(Settings):
    """WACOH-TECH Dynpick."""

    # Counts per N and per N·m of a WEF-6A200.
    sensitivity: Six = (65.47, 65.44, 65.08, 1638.5, 1639.25, 1640.75)
    tick_step: Annotated[int, Field(ge=1, le=9)] = 1
    max_step: Count = 2000
    saturation: tuple[U16, U16] = (0, 0x3FFF)


class OptoforceSettings(Settings):
    """OptoForce and OnRobot HEX: both values from the data sheet of the individual sensor."""

    counts: Six | None = None
    capacity: Six | None = None


class SerialSettings(Settings):
    """USB serial adapters."""

    latency_ms: NonNegative = 16.0


class BotaSettings(DeviceSettings):
    """Bota SensONE."""

    retired = frozenset({"quiet_in_config"})

    # Filter length: sample period in steps of 19.53125 us.
    sinc: Annotated[int, Field(ge=51, le=512)] = 64
    rated: Six = (500.0, 500.0, 1200.0, 15.0, 15.0, 12.0)


class NetftSettings(DeviceSettings):
    """Net F/T."""

    retired = frozenset({"onrobot_commands"})

    onrobot: bool = False  # 10 000 counts per N and 100 000 per N·m
    http_port: Port = 80
    tcp_port: Port = 49151
    # Counts per N and per N·m, for a box that reports neither.
    counts: tuple[Positive, Positive] | None = None
    rated: Six = (130.0, 130.0, 400.0, 10.0, 10.0, 10.0)


class FingerCameraSettings(Settings):
    """The camera of one finger."""

    serial: str = ""  # as printed on the sensor, such as 2D8Y-69GR
    gel: Annotated[str, Field(pattern=r"^[\w./#-]{0,40}$")] = ""  # serial number of its gel
    file: str = ""  # A video or pipe in place of a camera
    mirror: Literal["none", "x", "y", "both"] = "none"
    # Overrides the value for both fingers.
    crop_fraction: Annotated[float, Field(ge=0, lt=0.5)] | None = None


class GelsightSettings(Settings):
    """GelSight Mini."""

    # "gelsight", "lerobot", or the name of an entry point.
    driver: Annotated[str, Field(min_length=1)] = "gelsight"
    left: FingerCameraSettings = FingerCameraSettings()
    right: FingerCameraSettings = FingerCameraSettings()
    by_id: str = "/dev/v4l/by-id"
    names: str = "/sys/class/video4linux"
    nodes: str = "/dev"
    width_px: Count = 3280
    height_px: Count = 2464
    exposure: Positive = 180.0
    white_balance: Positive = 4500.0
    darkest_mean: NonNegative = 16.0
    silence_s: Positive = 2.0

    crop_fraction: Annotated[float, Field(ge=0, lt=0.5)] = 0.15
    mm_per_px_x: Positive = 0.0581
    mm_per_px_y: Positive = 0.0596
    buffer_size: Count = 1
    # Names of each camera control; the first that exists is set.
    control_names: dict[str, tuple[str, ...]] = CONTROL_NAMES
    keep_jpeg: bool = True


class LerobotSettings(Settings):
    """Cameras of the package lerobot: ``gelsight.driver = "lerobot"``."""

    # Module and class of the camera configuration.
    config: Annotated[str, Field(pattern=r"^[\w.]+:\w+$")] = (
        "lerobot.cameras.opencv:OpenCVCameraConfig"
    )
    left: str = "{}"  # fields of the configuration as JSON, such as {"index_or_path": 2}
    right: str = "{}"


class HardwareSettings(Settings):
    """All devices, one table of the lab file each."""

    melfa: MelfaSettings = MelfaSettings()
    ur: UrSettings = UrSettings()
    wsg: WsgSettings = WsgSettings()
    ft: ForceTorqueSettings = ForceTorqueSettings()
    dynpick: DynpickSettings = DynpickSettings()
    optoforce: OptoforceSettings = OptoforceSettings()
    serial: SerialSettings = SerialSettings()
    bota: BotaSettings = BotaSettings()
    netft: NetftSettings = NetftSettings()
    gelsight: GelsightSettings = GelsightSettings()
    lerobot: LerobotSettings = LerobotSettings()
