from .arm import ArmCycle as ArmCycle
from .arm import SimProgram as SimProgram
from .batch import BatchedTrials as BatchedTrials
from .batch import BatchPlan as BatchPlan
from .batch import EpisodeBatch as EpisodeBatch
from .batch import PressTruth as PressTruth
from .batch import SensorNoise as SensorNoise
from .batch import TrialPresses as TrialPresses
from .batch import draw_noise as draw_noise
from .batch import observe_presses as observe_presses
from .batch import onset_rule as onset_rule
from .batch import press_with_noise as press_with_noise
from .batch import simulate_episodes as simulate_episodes
from .conditions import DAY_SCORES as DAY_SCORES
from .conditions import DAY_SPREADS as DAY_SPREADS
from .conditions import SEAT_SCORES as SEAT_SCORES
from .conditions import SEAT_SPREADS as SEAT_SPREADS
from .conditions import Conditions as Conditions
from .conditions import GripDraw as GripDraw
from .conditions import MountingDraw as MountingDraw
from .conditions import ProbeDraw as ProbeDraw
from .conditions import conditions_from_draws as conditions_from_draws
from .conditions import day_draw as day_draw
from .conditions import seat_draw as seat_draw
from .contact import RESIDUAL_LIMIT as RESIDUAL_LIMIT
from .finger_camera import TactileRenderer as TactileRenderer
from .finger_camera import load_gel_appearance as load_gel_appearance
from .finger_camera import mirror_appearance as mirror_appearance
from .gripper import simulate_weighing as simulate_weighing
from .gripper import start_command_mm as start_command_mm
from .ground_truth import Scene as Scene
from .ground_truth import SceneTruth as SceneTruth
from .ground_truth import judge_release as judge_release
from .ground_truth import release_kick_mm as release_kick_mm
from .ground_truth import tower_with_piece as tower_with_piece
from .ground_truth import true_com_xy_mm as true_com_xy_mm
from .ground_truth import true_margin_mm as true_margin_mm
from .marker_fields import build_gel as build_gel
from .marker_fields import gel_from_settings as gel_from_settings
from .mechanics import GraspHistory as GraspHistory
from .mechanics import Region as Region
from .mechanics import advance_probes as advance_probes
from .mechanics import begin_probes as begin_probes
from .release_mujoco import import_mujoco as import_mujoco
from .release_mujoco import mujoco_available as mujoco_available
from .staged_release import LoosePads as LoosePads
from .staged_release import OpeningCourse as OpeningCourse
from .staged_release import OpeningPlan as OpeningPlan
from .staged_release import StandingPiece as StandingPiece
from .staged_release import open_in_steps as open_in_steps
from .supports import SupportStack as SupportStack
from .supports import join_support_stacks as join_support_stacks
from .supports import support_stack as support_stack
from .world import CycleRecord as CycleRecord
from .world import World as World
from .wrist_sensor import wrist_wrench as wrist_wrench

__all__ = [
    "DAY_SCORES",
    "DAY_SPREADS",
    "RESIDUAL_LIMIT",
    "SEAT_SCORES",
    "SEAT_SPREADS",
    "ArmCycle",
    "BatchPlan",
    "BatchedTrials",
    "Conditions",
    "CycleRecord",
    "EpisodeBatch",
    "GraspHistory",
    "GripDraw",
    "LoosePads",
    "MountingDraw",
    "OpeningCourse",
    "OpeningPlan",
    "PressTruth",
    "ProbeDraw",
    "Region",
    "Scene",
    "SceneTruth",
    "SensorNoise",
    "SimProgram",
    "StandingPiece",
    "SupportStack",
    "TactileRenderer",
    "TrialPresses",
    "World",
    "advance_probes",
    "begin_probes",
    "build_gel",
    "conditions_from_draws",
    "day_draw",
    "draw_noise",
    "gel_from_settings",
    "import_mujoco",
    "join_support_stacks",
    "judge_release",
    "load_gel_appearance",
    "mirror_appearance",
    "mujoco_available",
    "observe_presses",
    "onset_rule",
    "open_in_steps",
    "press_with_noise",
    "release_kick_mm",
    "seat_draw",
    "simulate_episodes",
    "simulate_weighing",
    "start_command_mm",
    "support_stack",
    "tower_with_piece",
    "true_com_xy_mm",
    "true_margin_mm",
    "wrist_wrench",
]
