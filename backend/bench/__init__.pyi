from .assembly import SimulatedBenchChoice as SimulatedBenchChoice
from .assembly import make_scene as make_scene
from .assembly import model_in_use as model_in_use
from .assembly import shipped_model as shipped_model
from .assembly import simulated_bench as simulated_bench
from .assembly import simulated_session as simulated_session
from .emulated import EmulatedBench as EmulatedBench
from .emulated import emulated_bench as emulated_bench
from .emulated_scene import EMULATOR_PRIORITY as EMULATOR_PRIORITY
from .emulated_scene import EmulatedScene as EmulatedScene
from .emulated_scene import lab_toml as lab_toml
from .emulated_scene import serve_bench as serve_bench
from .emulated_scene import shorten_switch_interval as shorten_switch_interval
from .emulator_registry import bench_toml as bench_toml
from .emulator_registry import emulate as emulate
from .laboratory import LabChoice as LabChoice
from .laboratory import find_camera_conflicts as find_camera_conflicts
from .laboratory import lab_session as lab_session
from .laboratory import open_lab as open_lab
from .session import RunResult as RunResult
from .session import Session as Session

__all__ = [
    "EMULATOR_PRIORITY",
    "EmulatedBench",
    "EmulatedScene",
    "LabChoice",
    "RunResult",
    "Session",
    "SimulatedBenchChoice",
    "bench_toml",
    "emulate",
    "emulated_bench",
    "find_camera_conflicts",
    "lab_session",
    "lab_toml",
    "make_scene",
    "model_in_use",
    "open_lab",
    "serve_bench",
    "shipped_model",
    "shorten_switch_interval",
    "simulated_bench",
    "simulated_session",
]
