from .belief import Belief as Belief
from .equilibrium import convex_hull as convex_hull
from .equilibrium import resting_contact as resting_contact
from .estimator import NOTABLE_SIGMAS as NOTABLE_SIGMAS
from .estimator import Ensemble as Ensemble
from .estimator import Estimator as Estimator
from .estimator import OffsetFit as OffsetFit
from .estimator import OffsetGrid as OffsetGrid
from .estimator import sigmas_apart as sigmas_apart
from .label_review import score_labels as score_labels
from .policy import ShiftTarget as ShiftTarget
from .policy import describe_situation as describe_situation
from .policy import give_up as give_up
from .policy import judge_stability as judge_stability
from .policy import shift_towards as shift_towards
from .strategies import FusedStrategy as FusedStrategy
from .strategies import GraspedPiece as GraspedPiece
from .strategies import PlaceDecision as PlaceDecision
from .strategies import ProbeObservation as ProbeObservation
from .strategies import SearchingStrategy as SearchingStrategy
from .strategies import Strategy as Strategy
from .strategies import check_outlines as check_outlines
from .strategies import load_network_of as load_network_of
from .strategies import make_strategy as make_strategy
from .support_tower import XY as XY
from .support_tower import SupportTower as SupportTower

__all__ = [
    "NOTABLE_SIGMAS",
    "XY",
    "Belief",
    "Ensemble",
    "Estimator",
    "FusedStrategy",
    "GraspedPiece",
    "OffsetFit",
    "OffsetGrid",
    "PlaceDecision",
    "ProbeObservation",
    "SearchingStrategy",
    "ShiftTarget",
    "Strategy",
    "SupportTower",
    "check_outlines",
    "convex_hull",
    "describe_situation",
    "give_up",
    "judge_stability",
    "load_network_of",
    "make_strategy",
    "resting_contact",
    "score_labels",
    "shift_towards",
    "sigmas_apart",
]
