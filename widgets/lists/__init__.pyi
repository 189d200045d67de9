from .recordings import CHIPS as CHIPS
from .recordings import HistoryList as HistoryList
from .recordings import HistoryRow as HistoryRow
from .recordings import LabelList as LabelList
from .recordings import LabelRow as LabelRow
from .recordings import RecordingList as RecordingList
from .recordings import RecordingRow as RecordingRow
from .tables import Arrangement as Arrangement
from .tables import EpisodeRow as EpisodeRow
from .tables import EpisodeTable as EpisodeTable
from .tables import FigureTable as FigureTable
from .tables import RunRow as RunRow
from .tables import RunTable as RunTable

__all__ = [
    "CHIPS",
    "Arrangement",
    "EpisodeRow",
    "EpisodeTable",
    "FigureTable",
    "HistoryList",
    "HistoryRow",
    "LabelList",
    "LabelRow",
    "RecordingList",
    "RecordingRow",
    "RunRow",
    "RunTable",
]
