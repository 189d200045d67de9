from .assembly import SimulatedBenchChoice as SimulatedBenchChoice
from .assembly import make_scene as make_scene
from .assembly import model_in_use as model_in_use
from .assembly import shipped_model as shipped_model
from .assembly import simulated_bench as simulated_bench
from .assembly import simulated_session as simulated_session
from .emulated import EmulatedBench as EmulatedBench
from .emulated import emulated_bench as emulated_bench
from .emulated_scene import PRIORITY as PRIORITY
from .emulated_scene import EmulatedScene as EmulatedScene
from .emulated_scene import lab_toml as lab_toml
from .emulated_scene import serve_bench as serve_bench
from .emulated_scene import take_short_turns as take_short_turns
from .emulator_registry import FAULT_DEVICES as FAULT_DEVICES
from .emulator_registry import Emulation as Emulation
from .emulator_registry import EmulationChoice as EmulationChoice
from .emulator_registry import WrenchFunction as WrenchFunction
from .emulator_registry import bench_toml as bench_toml
from .emulator_registry import emulate as emulate
from .laboratory import LabChoice as LabChoice
from .laboratory import lab_session as lab_session
from .laboratory import open_lab as open_lab
from .laboratory import otherwise_named as otherwise_named
from .session import RunResult as RunResult
from .session import Session as Session

__all__ = [
    "FAULT_DEVICES",
    "PRIORITY",
    "EmulatedBench",
    "EmulatedScene",
    "Emulation",
    "EmulationChoice",
    "LabChoice",
    "RunResult",
    "Session",
    "SimulatedBenchChoice",
    "WrenchFunction",
    "bench_toml",
    "emulate",
    "emulated_bench",
    "lab_session",
    "lab_toml",
    "make_scene",
    "model_in_use",
    "open_lab",
    "otherwise_named",
    "serve_bench",
    "shipped_model",
    "simulated_bench",
    "simulated_session",
    "take_short_turns",
]
