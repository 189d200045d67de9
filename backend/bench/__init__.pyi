from .assembly import SimulatedBenchChoice as SimulatedBenchChoice
from .assembly import make_scene as make_scene
from .assembly import model_in_use as model_in_use
from .assembly import shipped_model as shipped_model
from .assembly import simulated_session as simulated_session
from .emulated import EmulatedBench as EmulatedBench
from .emulated_bench import PRIORITY as PRIORITY
from .emulated_bench import JoinedScene as JoinedScene
from .emulated_bench import lab_toml as lab_toml
from .emulated_bench import serve_bench as serve_bench
from .emulated_bench import take_short_turns as take_short_turns
from .gelsight_emulator import SERIAL as SERIAL
from .lab import LabChoice as LabChoice
from .lab import lab_session as lab_session
from .lab import otherwise_named as otherwise_named
from .serving import SUFFERS as SUFFERS
from .serving import Choice as Choice
from .serving import Emulation as Emulation
from .serving import Wrench as Wrench
from .serving import bench_toml as bench_toml
from .serving import emulate as emulate
from .session import Session as Session

__all__ = [
    "PRIORITY",
    "SERIAL",
    "SUFFERS",
    "Choice",
    "EmulatedBench",
    "Emulation",
    "JoinedScene",
    "LabChoice",
    "Session",
    "SimulatedBenchChoice",
    "Wrench",
    "bench_toml",
    "emulate",
    "lab_session",
    "lab_toml",
    "make_scene",
    "model_in_use",
    "otherwise_named",
    "serve_bench",
    "shipped_model",
    "simulated_session",
    "take_short_turns",
]
