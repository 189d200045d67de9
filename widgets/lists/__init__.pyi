from .recordings import STATE_COLOURS as STATE_COLOURS
from .recordings import HistoryList as HistoryList
from .recordings import HistoryRow as HistoryRow
from .recordings import LabelList as LabelList
from .recordings import LabelListRow as LabelListRow
from .recordings import RecordingList as RecordingList
from .recordings import RecordingRow as RecordingRow
from .recordings import RowsOnDemand as RowsOnDemand
from .tables import EpisodeTable as EpisodeTable
from .tables import EpisodeTableRow as EpisodeTableRow
from .tables import FigureTable as FigureTable
from .tables import TableArrangement as TableArrangement
from .tables import TrainingRow as TrainingRow
from .tables import TrainingTable as TrainingTable

__all__ = [
    "STATE_COLOURS",
    "EpisodeTable",
    "EpisodeTableRow",
    "FigureTable",
    "HistoryList",
    "HistoryRow",
    "LabelList",
    "LabelListRow",
    "RecordingList",
    "RecordingRow",
    "RowsOnDemand",
    "TableArrangement",
    "TrainingRow",
    "TrainingTable",
]
