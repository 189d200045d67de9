from .clock import BenchClock as BenchClock
from .clock import Clock as Clock
from .clock import ClockJumpDetector as ClockJumpDetector
from .clock import ManualClock as ManualClock
from .clock import MonotonicClock as MonotonicClock
from .contact_onset import OnsetDetector as OnsetDetector
from .contact_onset import OnsetRule as OnsetRule
from .contact_onset import back_date_onset as back_date_onset
from .contact_onset import detect_contact as detect_contact
from .contact_onset import force_over_baseline as force_over_baseline
from .event_bus import EventBus as EventBus
from .event_bus import EventQueue as EventQueue
from .events import ActionChosen as ActionChosen
from .events import ApprovalAwaited as ApprovalAwaited
from .events import BeliefUpdated as BeliefUpdated
from .events import CalibrationMeasured as CalibrationMeasured
from .events import CampaignBegan as CampaignBegan
from .events import DecisionAwaited as DecisionAwaited
from .events import EpisodeDecided as EpisodeDecided
from .events import EpisodeDecision as EpisodeDecision
from .events import EpisodeRecorded as EpisodeRecorded
from .events import Event as Event
from .events import FaultRaised as FaultRaised
from .events import FaultsReset as FaultsReset
from .events import Gripped as Gripped
from .events import HandOverAwaited as HandOverAwaited
from .events import MountingAwaited as MountingAwaited
from .events import Noticed as Noticed
from .events import OriginChecked as OriginChecked
from .events import OutcomeAwaited as OutcomeAwaited
from .events import PatchEstimated as PatchEstimated
from .events import Paused as Paused
from .events import PhaseEntered as PhaseEntered
from .events import PhotoKept as PhotoKept
from .events import PieceWeighed as PieceWeighed
from .events import ProbeCollected as ProbeCollected
from .events import Progress as Progress
from .events import Refused as Refused
from .events import Released as Released
from .events import RunFinished as RunFinished
from .events import RunStarted as RunStarted
from .events import Said as Said
from .events import SetUpAwaited as SetUpAwaited
from .events import StabilityJudged as StabilityJudged
from .events import TrialFinished as TrialFinished
from .events import TrialStarted as TrialStarted
from .faults import Fault as Fault
from .faults import FaultError as FaultError
from .faults import InputError as InputError
from .faults import RefusedError as RefusedError
from .faults import StaleSampleError as StaleSampleError
from .faults import TouchdownError as TouchdownError
from .files import data_folder as data_folder
from .files import lock_file as lock_file
from .files import make_folder as make_folder
from .files import package_version as package_version
from .files import parse_json as parse_json
from .files import parse_toml as parse_toml
from .files import program_stamp as program_stamp
from .files import read_json_lines as read_json_lines
from .files import sync_folder as sync_folder
from .files import write_atomically as write_atomically
from .marker_interpolation import fill_unseen_markers as fill_unseen_markers
from .marker_interpolation import marker_misfit as marker_misfit
from .notification import QUESTIONS as QUESTIONS
from .notification import CommandNotifier as CommandNotifier
from .notification import PersonCall as PersonCall
from .notification import person_call as person_call
from .rotations import IDENTITY_ROTATION as IDENTITY_ROTATION
from .rotations import LEVEL_TOLERANCE_RAD as LEVEL_TOLERANCE_RAD
from .rotations import pose_rotation as pose_rotation
from .rotations import require_unrotated as require_unrotated
from .rotations import rotation_angle_rad as rotation_angle_rad
from .rotations import rotation_from_vector as rotation_from_vector
from .rotations import rotation_vector as rotation_vector
from .rotations import tilt_margin_rad as tilt_margin_rad
from .rotations import tilt_rad as tilt_rad
from .scheduling import DISK_TIMEOUT_S as DISK_TIMEOUT_S
from .scheduling import RepaintHold as RepaintHold
from .scheduling import SharedLock as SharedLock
from .scheduling import blocking_section as blocking_section
from .scheduling import blocking_section_of as blocking_section_of
from .scheduling import lower_priority as lower_priority
from .scheduling import raised_priority as raised_priority
from .scheduling import request_short_slices as request_short_slices
from .scheduling import round_robin_priority as round_robin_priority
from .scheduling import set_realtime_priority as set_realtime_priority
from .stalled_processes import ProcessStallDetector as ProcessStallDetector
from .stalled_processes import ThreadStallDetector as ThreadStallDetector
from .streams import Decimator as Decimator
from .streams import Samples as Samples
from .streams import SampleStream as SampleStream
from .streams import Stream as Stream
from .values import CHANNELS as CHANNELS
from .values import FINGERS as FINGERS
from .values import GRID_COLS as GRID_COLS
from .values import GRID_ROWS as GRID_ROWS
from .values import MARKERS as MARKERS
from .values import TACTILE_CHANNELS as TACTILE_CHANNELS
from .values import WRENCH_CHANNELS as WRENCH_CHANNELS
from .values import BeliefMap as BeliefMap
from .values import ContactPatch as ContactPatch
from .values import Episode as Episode
from .values import EpisodeQuality as EpisodeQuality
from .values import Fall as Fall
from .values import Finger as Finger
from .values import FloatArray as FloatArray
from .values import ImageArray as ImageArray
from .values import MarkerField as MarkerField
from .values import MarkerState as MarkerState
from .values import Outcome as Outcome
from .values import PlaceAction as PlaceAction
from .values import Pose as Pose
from .values import Recording as Recording
from .values import ScenePicture as ScenePicture
from .values import Stability as Stability
from .values import SupportKind as SupportKind
from .values import TactileFrame as TactileFrame
from .values import read_only as read_only

__all__ = [
    "CHANNELS",
    "DISK_TIMEOUT_S",
    "FINGERS",
    "GRID_COLS",
    "GRID_ROWS",
    "IDENTITY_ROTATION",
    "LEVEL_TOLERANCE_RAD",
    "MARKERS",
    "TACTILE_CHANNELS",
    "WRENCH_CHANNELS",
    "ActionChosen",
    "ApprovalAwaited",
    "BeliefMap",
    "BeliefUpdated",
    "BenchClock",
    "CalibrationMeasured",
    "CampaignBegan",
    "Clock",
    "ClockJumpDetector",
    "ContactPatch",
    "Decimator",
    "DecisionAwaited",
    "Episode",
    "EpisodeDecided",
    "EpisodeDecision",
    "EpisodeQuality",
    "EpisodeRecorded",
    "Event",
    "EventBus",
    "EventQueue",
    "Fall",
    "Fault",
    "FaultError",
    "FaultRaised",
    "FaultsReset",
    "Finger",
    "FloatArray",
    "Gripped",
    "HandOverAwaited",
    "ImageArray",
    "InputError",
    "ManualClock",
    "MarkerField",
    "MarkerState",
    "MonotonicClock",
    "MountingAwaited",
    "Noticed",
    "OnsetDetector",
    "OnsetRule",
    "OriginChecked",
    "Outcome",
    "OutcomeAwaited",
    "PatchEstimated",
    "Paused",
    "PhaseEntered",
    "PhotoKept",
    "PieceWeighed",
    "PlaceAction",
    "Pose",
    "ProbeCollected",
    "ProcessStallDetector",
    "Progress",
    "Recording",
    "Refused",
    "RefusedError",
    "Released",
    "RepaintHold",
    "RunFinished",
    "RunStarted",
    "Said",
    "SampleStream",
    "Samples",
    "ScenePicture",
    "SetUpAwaited",
    "SharedLock",
    "Stability",
    "StabilityJudged",
    "StaleSampleError",
    "Stream",
    "SupportKind",
    "TactileFrame",
    "ThreadStallDetector",
    "TouchdownError",
    "TrialFinished",
    "TrialStarted",
    "back_date_onset",
    "blocking_section",
    "blocking_section_of",
    "data_folder",
    "detect_contact",
    "fill_unseen_markers",
    "force_over_baseline",
    "lock_file",
    "lower_priority",
    "make_folder",
    "marker_misfit",
    "package_version",
    "parse_json",
    "parse_toml",
    "pose_rotation",
    "program_stamp",
    "raised_priority",
    "read_json_lines",
    "read_only",
    "request_short_slices",
    "require_unrotated",
    "rotation_angle_rad",
    "rotation_from_vector",
    "rotation_vector",
    "round_robin_priority",
    "set_realtime_priority",
    "sync_folder",
    "tilt_margin_rad",
    "tilt_rad",
    "write_atomically",
]
