from .axes import LineBuffer as LineBuffer
from .axes import PictureCache as PictureCache
from .axes import PlotArea as PlotArea
from .axes import centred_square as centred_square
from .axes import draw_message as draw_message
from .axes import draw_mm_grid as draw_mm_grid
from .axes import draw_rings as draw_rings
from .axes import draw_stale_overlay as draw_stale_overlay
from .axes import nice_step as nice_step
from .axes import polygon_of as polygon_of
from .axes import tick_text as tick_text
from .axes import ticks as ticks
from .distribution import BinCounts as BinCounts
from .distribution import DistributionScene as DistributionScene
from .distribution import DistributionView as DistributionView
from .distribution import reach_of as reach_of
from .force_traces import SPANS_S as SPANS_S
from .force_traces import TracePlot as TracePlot
from .force_traces import TracesPanel as TracesPanel
from .recorded_traces import CHANNEL_NAMES as CHANNEL_NAMES
from .recorded_traces import NO_WRENCH as NO_WRENCH
from .recorded_traces import Drawn as Drawn
from .recorded_traces import PhasePlot as PhasePlot
from .recorded_traces import PhaseSheet as PhaseSheet
from .recorded_traces import RecordedTraces as RecordedTraces
from .recorded_traces import TraceSheet as TraceSheet
from .recorded_traces import WrenchTrace as WrenchTrace
from .recorded_traces import has_moments as has_moments
from .training import RUN_COLOURS as RUN_COLOURS
from .training import CurveLine as CurveLine
from .training import CurvePlot as CurvePlot
from .training import ReliabilityPlot as ReliabilityPlot
from .training import SampleScene as SampleScene
from .training import SampleStrip as SampleStrip

__all__ = [
    "CHANNEL_NAMES",
    "NO_WRENCH",
    "RUN_COLOURS",
    "SPANS_S",
    "BinCounts",
    "CurveLine",
    "CurvePlot",
    "DistributionScene",
    "DistributionView",
    "Drawn",
    "LineBuffer",
    "PhasePlot",
    "PhaseSheet",
    "PictureCache",
    "PlotArea",
    "RecordedTraces",
    "ReliabilityPlot",
    "SampleScene",
    "SampleStrip",
    "TracePlot",
    "TraceSheet",
    "TracesPanel",
    "WrenchTrace",
    "centred_square",
    "draw_message",
    "draw_mm_grid",
    "draw_rings",
    "draw_stale_overlay",
    "has_moments",
    "nice_step",
    "polygon_of",
    "reach_of",
    "tick_text",
    "ticks",
]
