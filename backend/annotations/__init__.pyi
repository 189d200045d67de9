from .agreement import AgreementReport as AgreementReport
from .agreement import SuggestionBias as SuggestionBias
from .agreement import compare_with_control_items as compare_with_control_items
from .agreement import patch_iou as patch_iou
from .agreement import suggestion_bias as suggestion_bias
from .backups import list_backups as list_backups
from .backups import restore_backup as restore_backup
from .consistency import CheckProgress as CheckProgress
from .consistency import ConsistencyProblem as ConsistencyProblem
from .consistency import no_progress as no_progress
from .control_items import ControlItemLabels as ControlItemLabels
from .control_items import ControlItemView as ControlItemView
from .control_items import with_control_items as with_control_items
from .database import CATALOGUE_FILE as CATALOGUE_FILE
from .database import SCHEMA_VERSION as SCHEMA_VERSION
from .database import Database as Database
from .database import add_event as add_event
from .dataset import DESCRIPTION_FILE as DESCRIPTION_FILE
from .dataset import Dataset as Dataset
from .dataset import QualityReport as QualityReport
from .dataset import check_dataset_quality as check_dataset_quality
from .episode_files import file_sha256 as file_sha256
from .episode_index import SPLIT_TAG as SPLIT_TAG
from .episode_index import items_deleted as items_deleted
from .episode_index import list_campaigns as list_campaigns
from .episode_index import tagged_sides as tagged_sides
from .episode_index import with_uuid as with_uuid
from .geometry_records import Pair as Pair
from .geometry_records import pair_records as pair_records
from .labels import BulkChange as BulkChange
from .labels import BulkPreview as BulkPreview
from .labels import MoveGeometry as MoveGeometry
from .labels import RotateFrame as RotateFrame
from .labels import SetState as SetState
from .labels import ShiftOrigin as ShiftOrigin
from .labels import read_review_status as read_review_status
from .operation_log import OperationDraft as OperationDraft
from .operation_log import append_operation as append_operation
from .operation_log import new_revision as new_revision
from .operation_log import read_mark as read_mark
from .operation_log import read_operations as read_operations
from .queues import MODEL_PREFIX as MODEL_PREFIX
from .queues import Suggestion as Suggestion
from .queues import disagreement as disagreement
from .rebuild import rebuild_dataset as rebuild_dataset
from .reconciliation import MergeReport as MergeReport
from .reconciliation import check_dataset as check_dataset
from .reconciliation import merge_labels as merge_labels
from .reconciliation import reconcile as reconcile
from .review import REJECT_REASONS as REJECT_REASONS
from .review import check_person as check_person
from .review import refresh_heads as refresh_heads
from .review import state_after as state_after
from .run_tracking import METRICS_FILE as METRICS_FILE
from .run_tracking import RUNS_FOLDER as RUNS_FOLDER
from .run_tracking import ActiveRun as ActiveRun
from .run_tracking import RunInfo as RunInfo
from .run_tracking import hardware_info as hardware_info
from .run_tracking import is_run_alive as is_run_alive
from .run_tracking import package_versions as package_versions
from .run_tracking import read_run_info as read_run_info
from .storage import DISK_FULL_ERRNOS as DISK_FULL_ERRNOS
from .storage import NotWritableError as NotWritableError
from .storage import WriterLock as WriterLock
from .storage import check_free_space as check_free_space
from .storage import free_bytes_if_low as free_bytes_if_low
from .training_set import LABEL_CHOICES as LABEL_CHOICES
from .training_set import CacheRow as CacheRow
from .training_set import LabelChoice as LabelChoice
from .training_set import is_dataset as is_dataset
from .training_set import labelled_episodes as labelled_episodes
from .training_set import load_training_set as load_training_set
from .training_set import read_observation as read_observation
from .values import NO_LABEL as NO_LABEL
from .values import PROGRAM_ACTOR as PROGRAM_ACTOR
from .values import AnswerContext as AnswerContext
from .values import EpisodeContext as EpisodeContext
from .values import EpisodeEntry as EpisodeEntry
from .values import EpisodeFilter as EpisodeFilter
from .values import Label as Label
from .values import LabelContent as LabelContent
from .values import LabelState as LabelState
from .values import Operation as Operation
from .values import Revision as Revision
from .values import Source as Source
from .values import Verdict as Verdict
from .values import canonical_json as canonical_json
from .values import content_hash as content_hash
from .values import follow_uuid as follow_uuid
from .values import is_uuid7 as is_uuid7
from .values import uuid7 as uuid7
from .values import uuid7_from_parts as uuid7_from_parts

__all__ = [
    "CATALOGUE_FILE",
    "DESCRIPTION_FILE",
    "DISK_FULL_ERRNOS",
    "LABEL_CHOICES",
    "METRICS_FILE",
    "MODEL_PREFIX",
    "NO_LABEL",
    "PROGRAM_ACTOR",
    "REJECT_REASONS",
    "RUNS_FOLDER",
    "SCHEMA_VERSION",
    "SPLIT_TAG",
    "ActiveRun",
    "AgreementReport",
    "AnswerContext",
    "BulkChange",
    "BulkPreview",
    "CacheRow",
    "CheckProgress",
    "ConsistencyProblem",
    "ControlItemLabels",
    "ControlItemView",
    "Database",
    "Dataset",
    "EpisodeContext",
    "EpisodeEntry",
    "EpisodeFilter",
    "Label",
    "LabelChoice",
    "LabelContent",
    "LabelState",
    "MergeReport",
    "MoveGeometry",
    "NotWritableError",
    "Operation",
    "OperationDraft",
    "Pair",
    "QualityReport",
    "Revision",
    "RotateFrame",
    "RunInfo",
    "SetState",
    "ShiftOrigin",
    "Source",
    "Suggestion",
    "SuggestionBias",
    "Verdict",
    "WriterLock",
    "add_event",
    "append_operation",
    "canonical_json",
    "check_dataset",
    "check_dataset_quality",
    "check_free_space",
    "check_person",
    "compare_with_control_items",
    "content_hash",
    "disagreement",
    "file_sha256",
    "follow_uuid",
    "free_bytes_if_low",
    "hardware_info",
    "is_dataset",
    "is_run_alive",
    "is_uuid7",
    "items_deleted",
    "labelled_episodes",
    "list_backups",
    "list_campaigns",
    "load_training_set",
    "merge_labels",
    "new_revision",
    "no_progress",
    "package_versions",
    "pair_records",
    "patch_iou",
    "read_mark",
    "read_observation",
    "read_operations",
    "read_review_status",
    "read_run_info",
    "rebuild_dataset",
    "reconcile",
    "refresh_heads",
    "restore_backup",
    "state_after",
    "suggestion_bias",
    "tagged_sides",
    "uuid7",
    "uuid7_from_parts",
    "with_control_items",
    "with_uuid",
]
