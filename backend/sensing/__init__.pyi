from .detector import HEIGHT_PX as HEIGHT_PX
from .detector import WIDTH_PX as WIDTH_PX
from .episode import EpisodeLimits as EpisodeLimits
from .episode import assemble_episode as assemble_episode
from .episode import refuse_observation as refuse_observation
from .episode import synchronise as synchronise
from .live import LiveSensing as LiveSensing
from .live import RawStreams as RawStreams
from .picture_files import DEFAULT_RATE_HZ as DEFAULT_RATE_HZ
from .picture_files import OverlayVideo as OverlayVideo
from .picture_files import count_pictures as count_pictures
from .picture_files import read_pictures as read_pictures
from .scene_camera import Homography as Homography
from .scene_camera import calibrate_scene_camera as calibrate_scene_camera
from .scene_camera import observe_offset as observe_offset
from .slip import TorsionSlipDetector as TorsionSlipDetector
from .slip import slip_since_loading as slip_since_loading
from .tracker import GelRest as GelRest
from .tracker import MarkerTracker as MarkerTracker
from .tracker import measure_rest as measure_rest
from .tracking import TrackedImage as TrackedImage
from .tracking import complete_fields as complete_fields
from .tracking import mean_reference as mean_reference
from .tracking import track_frames as track_frames
from .tracking import track_markers as track_markers
from .zeroing import MIN_REST_FRAMES as MIN_REST_FRAMES
from .zeroing import MOTION_FACTOR as MOTION_FACTOR
from .zeroing import NOISE_FLOOR_PX as NOISE_FLOOR_PX
from .zeroing import REST_FRAMES as REST_FRAMES
from .zeroing import STANDARD_GRAVITY_M_S2 as STANDARD_GRAVITY_M_S2
from .zeroing import TactileReference as TactileReference
from .zeroing import WrenchDrift as WrenchDrift
from .zeroing import WrenchDriftEstimator as WrenchDriftEstimator
from .zeroing import gripper_payload as gripper_payload
from .zeroing import refuse_contact as refuse_contact
from .zeroing import take_reference as take_reference

__all__ = [
    "DEFAULT_RATE_HZ",
    "HEIGHT_PX",
    "MIN_REST_FRAMES",
    "MOTION_FACTOR",
    "NOISE_FLOOR_PX",
    "REST_FRAMES",
    "STANDARD_GRAVITY_M_S2",
    "WIDTH_PX",
    "EpisodeLimits",
    "GelRest",
    "Homography",
    "LiveSensing",
    "MarkerTracker",
    "OverlayVideo",
    "RawStreams",
    "TactileReference",
    "TorsionSlipDetector",
    "TrackedImage",
    "WrenchDrift",
    "WrenchDriftEstimator",
    "assemble_episode",
    "calibrate_scene_camera",
    "complete_fields",
    "count_pictures",
    "gripper_payload",
    "mean_reference",
    "measure_rest",
    "observe_offset",
    "read_pictures",
    "refuse_contact",
    "refuse_observation",
    "slip_since_loading",
    "synchronise",
    "take_reference",
    "track_frames",
    "track_markers",
]
