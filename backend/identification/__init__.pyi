from .estimates import CONTACT as CONTACT
from .estimates import GEL as GEL
from .estimates import REST as REST
from .estimates import Estimate as Estimate
from .estimates import identifiable as identifiable
from .identify import Identification as Identification
from .identify import bench_file as bench_file
from .identify import identify_bench as identify_bench
from .identify import write_identification as write_identification
from .recordings import Recordings as Recordings
from .recordings import read_recordings as read_recordings
from .stages import GATE_CHANNELS as GATE_CHANNELS
from .stages import PHASES as PHASES

__all__ = [
    "CONTACT",
    "GATE_CHANNELS",
    "GEL",
    "PHASES",
    "REST",
    "Estimate",
    "Identification",
    "Recordings",
    "bench_file",
    "identifiable",
    "identify_bench",
    "read_recordings",
    "write_identification",
]
