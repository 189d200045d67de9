from .checkpoint import FusedCard as FusedCard
from .checkpoint import FusedCheckpoint as FusedCheckpoint
from .checkpoint import load_fused as load_fused
from .checkpoint import shipped_fused as shipped_fused
from .features import SENSOR_MM as SENSOR_MM
from .features import TICKS as TICKS
from .features import GraspedFace as GraspedFace
from .features import InputPart as InputPart
from .features import acting_point_mm as acting_point_mm
from .features import wrench_at_sensor as wrench_at_sensor
from .inference import FusedForward as FusedForward
from .inference import InsetDistribution as InsetDistribution
from .training import MARGIN_REACH_MM as MARGIN_REACH_MM
from .training import FusedTrainer as FusedTrainer
from .training import FusedTraining as FusedTraining
from .training import data_sha256 as data_sha256

__all__ = [
    "MARGIN_REACH_MM",
    "SENSOR_MM",
    "TICKS",
    "FusedCard",
    "FusedCheckpoint",
    "FusedForward",
    "FusedTrainer",
    "FusedTraining",
    "GraspedFace",
    "InputPart",
    "InsetDistribution",
    "acting_point_mm",
    "data_sha256",
    "load_fused",
    "shipped_fused",
    "wrench_at_sensor",
]
