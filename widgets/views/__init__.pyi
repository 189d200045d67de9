from .belief import BeliefLegend as BeliefLegend
from .belief import BeliefScene as BeliefScene
from .belief import BeliefView as BeliefView
from .belief import stroke_on_black as stroke_on_black
from .decision import ESTIMATED_MARGIN as ESTIMATED_MARGIN
from .decision import NO_DECISION as NO_DECISION
from .decision import TRUE_MARGIN as TRUE_MARGIN
from .decision import DecisionPanel as DecisionPanel
from .decision import DecisionText as DecisionText
from .decision import TrialPanel as TrialPanel
from .decision import TrialPrompt as TrialPrompt
from .decision import decision_text as decision_text
from .decision import signed_mm as signed_mm
from .film import FilmTrack as FilmTrack
from .film import FilmView as FilmView
from .film import Reel as Reel
from .film import TimeLine as TimeLine
from .film import TimeMark as TimeMark
from .film import TimeScene as TimeScene
from .film import latest as latest
from .offset import Ghost as Ghost
from .offset import OffsetScene as OffsetScene
from .offset import OffsetView as OffsetView
from .offset import Point as Point
from .offset import offset_text as offset_text
from .offset import verdict_text as verdict_text
from .probe_maps import NO_PROBES as NO_PROBES
from .probe_maps import BeliefPanel as BeliefPanel
from .probe_maps import MapAndStrip as MapAndStrip
from .probe_maps import ProbeStrip as ProbeStrip
from .probe_maps import caption_of as caption_of
from .report import FlowWidget as FlowWidget
from .report import PictureCard as PictureCard
from .report import ReportCell as ReportCell
from .report import ReportGrid as ReportGrid
from .report import ReportSheet as ReportSheet
from .scene import UPRIGHT as UPRIGHT
from .scene import USUAL_SPAN_MM as USUAL_SPAN_MM
from .scene import Quaternion as Quaternion
from .scene import SideBody as SideBody
from .scene import SideScene as SideScene
from .scene import SideView as SideView
from .scene import rotation as rotation
from .scene_camera import PictureOutline as PictureOutline
from .scene_camera import SceneShot as SceneShot
from .scene_camera import SceneShotView as SceneShotView
from .scores import OUTCOME_WORDS as OUTCOME_WORDS
from .scores import ComparisonSheet as ComparisonSheet
from .scores import Score as Score
from .scores import ScorePanel as ScorePanel
from .scores import StrategyResult as StrategyResult
from .scores import success_rate_text as success_rate_text
from .tactile import LOOKS as LOOKS
from .tactile import MIN_SIZE as MIN_SIZE
from .tactile import TactileView as TactileView

__all__ = [
    "ESTIMATED_MARGIN",
    "LOOKS",
    "MIN_SIZE",
    "NO_DECISION",
    "NO_PROBES",
    "OUTCOME_WORDS",
    "TRUE_MARGIN",
    "UPRIGHT",
    "USUAL_SPAN_MM",
    "BeliefLegend",
    "BeliefPanel",
    "BeliefScene",
    "BeliefView",
    "ComparisonSheet",
    "DecisionPanel",
    "DecisionText",
    "FilmTrack",
    "FilmView",
    "FlowWidget",
    "Ghost",
    "MapAndStrip",
    "OffsetScene",
    "OffsetView",
    "PictureCard",
    "PictureOutline",
    "Point",
    "ProbeStrip",
    "Quaternion",
    "Reel",
    "ReportCell",
    "ReportGrid",
    "ReportSheet",
    "SceneShot",
    "SceneShotView",
    "Score",
    "ScorePanel",
    "SideBody",
    "SideScene",
    "SideView",
    "StrategyResult",
    "TactileView",
    "TimeLine",
    "TimeMark",
    "TimeScene",
    "TrialPanel",
    "TrialPrompt",
    "caption_of",
    "decision_text",
    "latest",
    "offset_text",
    "rotation",
    "signed_mm",
    "stroke_on_black",
    "success_rate_text",
    "verdict_text",
]
