from .certification import LABORATORY_LIMIT as LABORATORY_LIMIT
from .certification import LEAST_SCENES as LEAST_SCENES
from .certification import Certification as Certification
from .certification import certify_laboratory as certify_laboratory
from .certification import labelled_trials as labelled_trials
from .collection import batch_plan as batch_plan
from .collection import run_jobs as run_jobs
from .collection import split_jobs as split_jobs
from .comparison import StrategyComparison as StrategyComparison
from .comparison import comparison_tables as comparison_tables
from .comparison import decided_strategies as decided_strategies
from .comparison import merged_oracle_shares as merged_oracle_shares
from .comparison import oracle_share_table as oracle_share_table
from .comparison import stopped_text as stopped_text
from .document import BLUE as BLUE
from .document import FAINT as FAINT
from .document import INK as INK
from .document import ORANGE as ORANGE
from .document import VIOLET as VIOLET
from .document import PictureGallery as PictureGallery
from .document import Report as Report
from .document import ReportPicture as ReportPicture
from .document import ReportTable as ReportTable
from .document import TableEntry as TableEntry
from .document import report_page as report_page
from .document import to_markdown as to_markdown
from .domain_shift import CollectionKind as CollectionKind
from .domain_shift import DomainShift as DomainShift
from .domain_shift import RandomisedTraining as RandomisedTraining
from .domain_shift import change_rows as change_rows
from .domain_shift import press_rows as press_rows
from .domain_shift import trial_rows as trial_rows
from .evaluation import EVALUATED_STRATEGIES as EVALUATED_STRATEGIES
from .evaluation import job_effort as job_effort
from .fusion import PORTIONS as PORTIONS
from .fusion import WEIGHTS as WEIGHTS
from .fusion import FusionRecipe as FusionRecipe
from .fusion import ready_sequences as ready_sequences
from .fusion import threshold_counts as threshold_counts
from .fusion import threshold_jobs as threshold_jobs
from .identification_report import identification_page as identification_page
from .job_kinds import KINDS as KINDS
from .models import adopt_models as adopt_models
from .models import keep_models as keep_models
from .models import load_model as load_model
from .models import shipped_model_folders as shipped_model_folders
from .results import CONTENT_ERRORS as CONTENT_ERRORS
from .results import DATA as DATA
from .results import program_version as program_version
from .results import read_beyond as read_beyond
from .results import read_report as read_report
from .results import rewrite_tables as rewrite_tables
from .results import write_comparison as write_comparison
from .results import write_tables as write_tables
from .run_report import write_run_report as write_run_report
from .sensitivity import NuisanceSensitivity as NuisanceSensitivity
from .sensitivity import sensitivity_report as sensitivity_report
from .sensitivity import sensitivity_table as sensitivity_table
from .statistics import compare_intervals as compare_intervals
from .statistics import evidence as evidence
from .statistics import sequential_decision as sequential_decision
from .strategies import BOTTOMS as BOTTOMS
from .strategies import COMPARED_PIECES as COMPARED_PIECES
from .strategies import MODEL_FREE as MODEL_FREE
from .strategies import ORACLES as ORACLES
from .strategies import STRATEGIES as STRATEGIES
from .strategies import ClosedLoopComparison as ClosedLoopComparison
from .strategies import StaticComparison as StaticComparison
from .strategies import base_strategy as base_strategy
from .strategies import method_of as method_of
from .tables import BEYOND_FORMAT as BEYOND_FORMAT
from .tables import PIECES as PIECES
from .tables import SCALES as SCALES
from .tables import TABLE_BOTTOMS as TABLE_BOTTOMS
from .tables import Recipe as Recipe
from .tables import pieces_of as pieces_of

__all__ = [
    "BEYOND_FORMAT",
    "BLUE",
    "BOTTOMS",
    "COMPARED_PIECES",
    "CONTENT_ERRORS",
    "DATA",
    "EVALUATED_STRATEGIES",
    "FAINT",
    "INK",
    "KINDS",
    "LABORATORY_LIMIT",
    "LEAST_SCENES",
    "MODEL_FREE",
    "ORACLES",
    "ORANGE",
    "PIECES",
    "PORTIONS",
    "SCALES",
    "STRATEGIES",
    "TABLE_BOTTOMS",
    "VIOLET",
    "WEIGHTS",
    "Certification",
    "ClosedLoopComparison",
    "CollectionKind",
    "DomainShift",
    "FusionRecipe",
    "NuisanceSensitivity",
    "PictureGallery",
    "RandomisedTraining",
    "Recipe",
    "Report",
    "ReportPicture",
    "ReportTable",
    "StaticComparison",
    "StrategyComparison",
    "TableEntry",
    "adopt_models",
    "base_strategy",
    "batch_plan",
    "certify_laboratory",
    "change_rows",
    "compare_intervals",
    "comparison_tables",
    "decided_strategies",
    "evidence",
    "identification_page",
    "job_effort",
    "keep_models",
    "labelled_trials",
    "load_model",
    "merged_oracle_shares",
    "method_of",
    "oracle_share_table",
    "pieces_of",
    "press_rows",
    "program_version",
    "read_beyond",
    "read_report",
    "ready_sequences",
    "report_page",
    "rewrite_tables",
    "run_jobs",
    "sensitivity_report",
    "sensitivity_table",
    "sequential_decision",
    "shipped_model_folders",
    "split_jobs",
    "stopped_text",
    "threshold_counts",
    "threshold_jobs",
    "to_markdown",
    "trial_rows",
    "write_comparison",
    "write_run_report",
    "write_tables",
]
