from .bench_description import BenchDescription as BenchDescription
from .bench_description import BenchIdentity as BenchIdentity
from .bench_description import BenchMode as BenchMode
from .bench_description import bench_sha256 as bench_sha256
from .bench_description import describe_simulation as describe_simulation
from .bench_description import sha256_of_json as sha256_of_json
from .hardware import PLACEHOLDERS as PLACEHOLDERS
from .hardware import FingerCameraSettings as FingerCameraSettings
from .hardware import ForceTorqueSettings as ForceTorqueSettings
from .hardware import GelsightSettings as GelsightSettings
from .hardware import HardwareSettings as HardwareSettings
from .hardware import MelfaSettings as MelfaSettings
from .hardware import UrSettings as UrSettings
from .hardware import WsgSettings as WsgSettings
from .lab import Lab as Lab
from .lab import LabSettings as LabSettings
from .lab import LimitSettings as LimitSettings
from .lab import is_lab_file as is_lab_file
from .lab import is_loopback as is_loopback
from .lab import load_lab as load_lab
from .lab import save_lab as save_lab
from .method import EARLY_TICKS as EARLY_TICKS
from .method import SAMPLES_PER_PROBE as SAMPLES_PER_PROBE
from .method import TICK_S as TICK_S
from .method import BeliefSettings as BeliefSettings
from .method import CollectSettings as CollectSettings
from .method import FusedSettings as FusedSettings
from .method import NonNegative as NonNegative
from .method import PolicySettings as PolicySettings
from .method import Positive as Positive
from .method import Probability as Probability
from .method import ProbeSettings as ProbeSettings
from .method import RecordingPlan as RecordingPlan
from .method import Settings as Settings
from .method import StabilitySettings as StabilitySettings
from .method import StackSettings as StackSettings
from .method import StrategyName as StrategyName
from .method import TowerSettings as TowerSettings
from .method import TrainingSettings as TrainingSettings
from .simulation import PRESETS as PRESETS
from .simulation import SimulationSettings as SimulationSettings
from .simulation import SpreadSettings as SpreadSettings
from .simulation import SupportSettings as SupportSettings
from .simulation import SurfaceSettings as SurfaceSettings
from .simulation import TactileSettings as TactileSettings
from .simulation import WristSettings as WristSettings
from .simulation import load_simulation as load_simulation
from .toml_file import first_error as first_error
from .toml_file import first_error_message as first_error_message
from .toml_file import parse_settings as parse_settings
from .toml_file import read_settings as read_settings
from .toml_file import read_toml as read_toml

__all__ = [
    "EARLY_TICKS",
    "PLACEHOLDERS",
    "PRESETS",
    "SAMPLES_PER_PROBE",
    "TICK_S",
    "BeliefSettings",
    "BenchDescription",
    "BenchIdentity",
    "BenchMode",
    "CollectSettings",
    "FingerCameraSettings",
    "ForceTorqueSettings",
    "FusedSettings",
    "GelsightSettings",
    "HardwareSettings",
    "Lab",
    "LabSettings",
    "LimitSettings",
    "MelfaSettings",
    "NonNegative",
    "PolicySettings",
    "Positive",
    "Probability",
    "ProbeSettings",
    "RecordingPlan",
    "Settings",
    "SimulationSettings",
    "SpreadSettings",
    "StabilitySettings",
    "StackSettings",
    "StrategyName",
    "SupportSettings",
    "SurfaceSettings",
    "TactileSettings",
    "TowerSettings",
    "TrainingSettings",
    "UrSettings",
    "WristSettings",
    "WsgSettings",
    "bench_sha256",
    "describe_simulation",
    "first_error",
    "first_error_message",
    "is_lab_file",
    "is_loopback",
    "load_lab",
    "load_simulation",
    "parse_settings",
    "read_settings",
    "read_toml",
    "save_lab",
    "sha256_of_json",
]
