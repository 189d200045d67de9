from .belief import BeliefLegend as BeliefLegend
from .belief import BeliefScene as BeliefScene
from .belief import BeliefView as BeliefView
from .belief import on_black as on_black
from .decision import ESTIMATED as ESTIMATED
from .decision import NOTHING_YET as NOTHING_YET
from .decision import TRUE as TRUE
from .decision import DecisionPanel as DecisionPanel
from .decision import DecisionText as DecisionText
from .decision import TrialIntents as TrialIntents
from .decision import TrialLook as TrialLook
from .decision import TrialPanel as TrialPanel
from .decision import decide_in_words as decide_in_words
from .decision import signed_mm as signed_mm
from .film import Film as Film
from .film import FilmTrack as FilmTrack
from .film import Mark as Mark
from .film import Reel as Reel
from .film import TimeLine as TimeLine
from .film import TimeScene as TimeScene
from .film import latest as latest
from .offset import Ghost as Ghost
from .offset import OffsetScene as OffsetScene
from .offset import OffsetView as OffsetView
from .offset import Point as Point
from .offset import offset_in_words as offset_in_words
from .offset import verdict_in_words as verdict_in_words
from .probe_maps import NO_PROBES as NO_PROBES
from .probe_maps import BeliefPanel as BeliefPanel
from .probe_maps import MapAndStrip as MapAndStrip
from .probe_maps import ProbeStrip as ProbeStrip
from .probe_maps import caption_of as caption_of
from .report import CellLook as CellLook
from .report import Flow as Flow
from .report import PictureCard as PictureCard
from .report import ReportGrid as ReportGrid
from .report import ReportIntents as ReportIntents
from .report import ReportSheet as ReportSheet
from .scene import UPRIGHT as UPRIGHT
from .scene import USUAL_SPAN_MM as USUAL_SPAN_MM
from .scene import Quaternion as Quaternion
from .scene import SideBody as SideBody
from .scene import SideScene as SideScene
from .scene import SideView as SideView
from .scene import rotation as rotation
from .scene_camera import Outline as Outline
from .scene_camera import SceneShot as SceneShot
from .scene_camera import SceneShotView as SceneShotView
from .scores import WORDS as WORDS
from .scores import ComparisonSheet as ComparisonSheet
from .scores import RivalLook as RivalLook
from .scores import Score as Score
from .scores import ScorePanel as ScorePanel
from .scores import rate_words as rate_words
from .tactile import LEAST as LEAST
from .tactile import LOOKS as LOOKS
from .tactile import TactileView as TactileView

__all__ = [
    "ESTIMATED",
    "LEAST",
    "LOOKS",
    "NOTHING_YET",
    "NO_PROBES",
    "TRUE",
    "UPRIGHT",
    "USUAL_SPAN_MM",
    "WORDS",
    "BeliefLegend",
    "BeliefPanel",
    "BeliefScene",
    "BeliefView",
    "CellLook",
    "ComparisonSheet",
    "DecisionPanel",
    "DecisionText",
    "Film",
    "FilmTrack",
    "Flow",
    "Ghost",
    "MapAndStrip",
    "Mark",
    "OffsetScene",
    "OffsetView",
    "Outline",
    "PictureCard",
    "Point",
    "ProbeStrip",
    "Quaternion",
    "Reel",
    "ReportGrid",
    "ReportIntents",
    "ReportSheet",
    "RivalLook",
    "SceneShot",
    "SceneShotView",
    "Score",
    "ScorePanel",
    "SideBody",
    "SideScene",
    "SideView",
    "TactileView",
    "TimeLine",
    "TimeScene",
    "TrialIntents",
    "TrialLook",
    "TrialPanel",
    "caption_of",
    "decide_in_words",
    "latest",
    "offset_in_words",
    "on_black",
    "rate_words",
    "rotation",
    "signed_mm",
    "verdict_in_words",
]
