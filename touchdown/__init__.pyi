from .backend.annotations import Dataset as Dataset
from .backend.bench import RunResult as RunResult
from .backend.bench import Session as Session
from .backend.bench import emulated_bench as emulated_bench
from .backend.bench import open_lab as open_lab
from .backend.bench import simulated_bench as simulated_bench
from .backend.config import SimulationSettings as SimulationSettings
from .backend.config import StackSettings as StackSettings
from .backend.core import BeliefMap as BeliefMap
from .backend.core import ContactPatch as ContactPatch
from .backend.core import Episode as Episode
from .backend.core import FaultError as FaultError
from .backend.core import InputError as InputError
from .backend.core import MarkerField as MarkerField
from .backend.core import Outcome as Outcome
from .backend.core import PlaceAction as PlaceAction
from .backend.core import Pose as Pose
from .backend.core import RefusedError as RefusedError
from .backend.core import Stability as Stability
from .backend.core import TactileFrame as TactileFrame
from .backend.core import TouchdownError as TouchdownError
from .backend.exchange import ExportResult as ExportResult
from .backend.exchange import export as export
from .backend.geometry import load_pieces as load_pieces
from .backend.learning import EvaluationScores as EvaluationScores
from .backend.learning import ModelCard as ModelCard
from .backend.learning import evaluate as evaluate
from .backend.learning import train_model as train_model
from .backend.runs import CollectRequest as CollectRequest
from .backend.runs import StackRequest as StackRequest
from .backend.sensing import track_markers as track_markers

__version__: str
__all__ = [
    "BeliefMap",
    "CollectRequest",
    "ContactPatch",
    "Dataset",
    "Episode",
    "EvaluationScores",
    "ExportResult",
    "FaultError",
    "InputError",
    "MarkerField",
    "ModelCard",
    "Outcome",
    "PlaceAction",
    "Pose",
    "RefusedError",
    "RunResult",
    "Session",
    "SimulationSettings",
    "Stability",
    "StackRequest",
    "StackSettings",
    "TactileFrame",
    "TouchdownError",
    "emulated_bench",
    "evaluate",
    "export",
    "load_pieces",
    "open_lab",
    "simulated_bench",
    "track_markers",
    "train_model",
]
