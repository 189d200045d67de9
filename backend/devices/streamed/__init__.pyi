from .arm import AIR_WINDOW_S as AIR_WINDOW_S
from .arm import NOT_PRESSING as NOT_PRESSING
from .arm import TRIPPED as TRIPPED
from .arm import UNFELT as UNFELT
from .arm import PositionRecord as PositionRecord
from .arm import StreamedPrograms as StreamedPrograms
from .arm import air_before as air_before
from .arm import jog_motion as jog_motion
from .arm import no_contact_fault as no_contact_fault
from .arm import press_fields as press_fields
from .compliance import OLD_S as OLD_S
from .compliance import LoopDelays as LoopDelays
from .compliance import TripDetector as TripDetector
from .motion_programs import ACCELERATION_MM_S2 as ACCELERATION_MM_S2
from .motion_programs import ACCELERATION_RAD_S2 as ACCELERATION_RAD_S2
from .motion_programs import UNLOAD_MM as UNLOAD_MM
from .motion_programs import CycleInput as CycleInput
from .motion_programs import JogProgram as JogProgram
from .motion_programs import JointJogProgram as JointJogProgram
from .motion_programs import JointProgram as JointProgram
from .motion_programs import JointTravelProgram as JointTravelProgram
from .motion_programs import MotionProgram as MotionProgram
from .motion_programs import RotationJogProgram as RotationJogProgram
from .motion_programs import RotationTravelProgram as RotationTravelProgram
from .motion_programs import TravelProgram as TravelProgram
from .motion_programs import not_unloaded_fault as not_unloaded_fault

__all__ = [
    "ACCELERATION_MM_S2",
    "ACCELERATION_RAD_S2",
    "AIR_WINDOW_S",
    "NOT_PRESSING",
    "OLD_S",
    "TRIPPED",
    "UNFELT",
    "UNLOAD_MM",
    "CycleInput",
    "JogProgram",
    "JointJogProgram",
    "JointProgram",
    "JointTravelProgram",
    "LoopDelays",
    "MotionProgram",
    "PositionRecord",
    "RotationJogProgram",
    "RotationTravelProgram",
    "StreamedPrograms",
    "TravelProgram",
    "TripDetector",
    "air_before",
    "jog_motion",
    "no_contact_fault",
    "not_unloaded_fault",
    "press_fields",
]
