from .bench import SCENE_TIMEOUT_S as SCENE_TIMEOUT_S
from .bench import Bench as Bench
from .bench import NoEstimator as NoEstimator
from .bench import OperatorPrompt as OperatorPrompt
from .bench import PatchEstimator as PatchEstimator
from .bench import ReleaseVerdict as ReleaseVerdict
from .bench import SceneCheck as SceneCheck
from .bench import SceneDevices as SceneDevices
from .bench import SceneFactory as SceneFactory
from .bench import SceneView as SceneView
from .calibrate import LEANS as LEANS
from .calibrate import check_weighing as check_weighing
from .calibrations import DriftMonitor as DriftMonitor
from .calibrations import GelCheck as GelCheck
from .calibrations import UsedCalibrations as UsedCalibrations
from .calibrations import accept_calibration as accept_calibration
from .calibrations import calibration_metadata as calibration_metadata
from .calibrations import calibrations_for as calibrations_for
from .calibrations import contact_height_mm as contact_height_mm
from .calibrations import device_names as device_names
from .calibrations import payload_wrench as payload_wrench
from .campaign import Campaign as Campaign
from .campaign import Pattern as Pattern
from .campaign import counts_for_coverage as counts_for_coverage
from .campaign import current_campaign as current_campaign
from .campaign import fresh_seed as fresh_seed
from .campaign import labelled_coverage as labelled_coverage
from .campaign import newest_campaign as newest_campaign
from .campaign import read_campaign as read_campaign
from .campaign import read_examined_episodes as read_examined_episodes
from .campaign import read_probe_summary as read_probe_summary
from .collector import SignalExcerpt as SignalExcerpt
from .collector import last_signal_excerpt as last_signal_excerpt
from .engine import Engine as Engine
from .engine import LiveThread as LiveThread
from .event_log import EVENT_LOG_NAME as EVENT_LOG_NAME
from .event_log import changed_limits as changed_limits
from .event_log import decode_event as decode_event
from .event_log import event_log_path as event_log_path
from .event_log import log_limit_change as log_limit_change
from .event_log import read_events as read_events
from .manual_control import FaultNotifier as FaultNotifier
from .manual_control import ManualControl as ManualControl
from .manual_control import check_connected as check_connected
from .manual_control import check_devices as check_devices
from .manual_control import check_no_contact as check_no_contact
from .manual_control import connect_stop as connect_stop
from .manual_control import latch_device_faults as latch_device_faults
from .messages import DECISION_WORDS as DECISION_WORDS
from .messages import hand_over_message as hand_over_message
from .messages import mounting_question as mounting_question
from .messages import outcome_question as outcome_question
from .messages import scene_to_set_message as scene_to_set_message
from .motions import RunEnding as RunEnding
from .outcome import DEVICE_FAULTS as DEVICE_FAULTS
from .outcome import excluding_fault as excluding_fault
from .plan import CancelledError as CancelledError
from .plan import Plan as Plan
from .plans import check_request as check_request
from .plans import make_plan as make_plan
from .recorder import PHOTO_SUFFIXES as PHOTO_SUFFIXES
from .recorder import RecordingOptions as RecordingOptions
from .recorder import RunRecorder as RunRecorder
from .recorder import calibrations_folder as calibrations_folder
from .recorder import dataset_folder as dataset_folder
from .recorder import keep_photo as keep_photo
from .recorder import models_folder as models_folder
from .requests import CalibrateRequest as CalibrateRequest
from .requests import CollectRequest as CollectRequest
from .requests import DecisionMode as DecisionMode
from .requests import ProbeRequest as ProbeRequest
from .requests import Request as Request
from .requests import RunState as RunState
from .requests import RunStatus as RunStatus
from .requests import SceneChoice as SceneChoice
from .requests import SetRequest as SetRequest
from .requests import StackRequest as StackRequest
from .requests import StrategyChoice as StrategyChoice
from .stack import certificate_status as certificate_status

__all__ = [
    "DECISION_WORDS",
    "DEVICE_FAULTS",
    "EVENT_LOG_NAME",
    "LEANS",
    "PHOTO_SUFFIXES",
    "SCENE_TIMEOUT_S",
    "Bench",
    "CalibrateRequest",
    "Campaign",
    "CollectRequest",
    "DecisionMode",
    "DriftMonitor",
    "Engine",
    "FaultNotifier",
    "GelCheck",
    "LiveThread",
    "ManualControl",
    "NoEstimator",
    "OperatorPrompt",
    "PatchEstimator",
    "Pattern",
    "Plan",
    "ProbeRequest",
    "RecordingOptions",
    "ReleaseVerdict",
    "Request",
    "RunEnding",
    "RunRecorder",
    "RunState",
    "RunStatus",
    "SceneCheck",
    "SceneChoice",
    "SceneDevices",
    "SceneFactory",
    "SceneView",
    "SetRequest",
    "SignalExcerpt",
    "StackRequest",
    "StrategyChoice",
    "UsedCalibrations",
    "accept_calibration",
    "calibration_metadata",
    "calibrations_folder",
    "calibrations_for",
    "certificate_status",
    "changed_limits",
    "check_connected",
    "check_devices",
    "check_no_contact",
    "check_request",
    "check_weighing",
    "connect_stop",
    "contact_height_mm",
    "counts_for_coverage",
    "current_campaign",
    "dataset_folder",
    "decode_event",
    "device_names",
    "event_log_path",
    "excluding_fault",
    "fresh_seed",
    "hand_over_message",
    "keep_photo",
    "labelled_coverage",
    "last_signal_excerpt",
    "latch_device_faults",
    "log_limit_change",
    "make_plan",
    "models_folder",
    "mounting_question",
    "newest_campaign",
    "outcome_question",
    "payload_wrench",
    "read_campaign",
    "read_events",
    "read_examined_episodes",
    "read_probe_summary",
    "scene_to_set_message",
]
