from .disturbances import DisturbanceScript as DisturbanceScript
from .disturbances import RateLimiter as RateLimiter
from .disturbances import parse_script as parse_script
from .fault_plan import AMOUNTS as AMOUNTS
from .fault_plan import FaultPlan as FaultPlan
from .fault_plan import Faults as Faults
from .fault_plan import load_faults as load_faults
from .loads import hanging as hanging
from .loads import noisy as noisy
from .loads import suffering as suffering
from .pace import Pace as Pace
from .servers import CHUNK as CHUNK
from .servers import UNPLUGGED_S as UNPLUGGED_S
from .servers import Emulated as Emulated
from .servers import Front as Front
from .servers import PtyFront as PtyFront
from .servers import TcpFront as TcpFront
from .servers import UdpFront as UdpFront

__all__ = [
    "AMOUNTS",
    "CHUNK",
    "UNPLUGGED_S",
    "DisturbanceScript",
    "Emulated",
    "FaultPlan",
    "Faults",
    "Front",
    "Pace",
    "PtyFront",
    "RateLimiter",
    "TcpFront",
    "UdpFront",
    "hanging",
    "load_faults",
    "noisy",
    "parse_script",
    "suffering",
]
