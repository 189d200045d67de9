from .coco import read_coco as read_coco
from .csv_tables import read_csv as read_csv
from .exports import EXPORTS as EXPORTS
from .exports import ExportResult as ExportResult
from .exports import export as export
from .imports import EpisodeImport as EpisodeImport
from .imports import ImportOptions as ImportOptions
from .jsonl import import_log as import_log
from .jsonl import read_jsonl as read_jsonl
from .label_import import import_labels as import_labels
from .manifest import read_manifest as read_manifest
from .query import EXPORT_STATES as EXPORT_STATES
from .query import ExportState as ExportState

__all__ = [
    "EXPORTS",
    "EXPORT_STATES",
    "EpisodeImport",
    "ExportResult",
    "ExportState",
    "ImportOptions",
    "export",
    "import_labels",
    "import_log",
    "read_coco",
    "read_csv",
    "read_jsonl",
    "read_manifest",
]
