from .calibration import PatchCalibration as PatchCalibration
from .calibration import fit_calibration as fit_calibration
from .checkpoint import Checkpoint as Checkpoint
from .checkpoint import ModelCard as ModelCard
from .checkpoint import card_path as card_path
from .checkpoint import load_card as load_card
from .checkpoint import load_checkpoint as load_checkpoint
from .checkpoint import save_card as save_card
from .checkpoint import save_checkpoint as save_checkpoint
from .checkpoint import save_half_precision as save_half_precision
from .fitting import calibrate_model as calibrate_model
from .fitting import evaluate as evaluate
from .fitting import evaluate_model as evaluate_model
from .fitting import hardware_rows as hardware_rows
from .fitting import load_episodes as load_episodes
from .fitting import make_card as make_card
from .inference import LstmState as LstmState
from .inference import NetworkShape as NetworkShape
from .inference import PatchForward as PatchForward
from .inference import channel_groups as channel_groups
from .inference import modality_columns as modality_columns
from .metrics import CONTACT_LEVEL as CONTACT_LEVEL
from .metrics import Z_95 as Z_95
from .metrics import EvaluationScores as EvaluationScores
from .metrics import SamplePrediction as SamplePrediction
from .metrics import clustered_interval as clustered_interval
from .metrics import load_samples as load_samples
from .metrics import rate_interval as rate_interval
from .metrics import stable_flags as stable_flags
from .registry import HARDWARE_PROBES as HARDWARE_PROBES
from .registry import SHIPPED_MODEL as SHIPPED_MODEL
from .registry import ModelRegistry as ModelRegistry
from .registry import card_mismatches as card_mismatches
from .registry import check_autonomous as check_autonomous
from .registry import models_below as models_below
from .training import Trainer as Trainer
from .training import device_name as device_name
from .training import fingerprint as fingerprint
from .training import load_network as load_network
from .training import predict as predict
from .training import select_device as select_device
from .training import use_one_thread as use_one_thread
from .training_data import TrainingCandidate as TrainingCandidate
from .training_data import TrainingSetOverview as TrainingSetOverview
from .training_data import training_candidates as training_candidates
from .training_data import training_set_overview as training_set_overview
from .training_process import DeviceName as DeviceName
from .training_process import TrainingCancelled as TrainingCancelled
from .training_process import TrainingEpoch as TrainingEpoch
from .training_process import TrainingFinished as TrainingFinished
from .training_process import TrainingLoaded as TrainingLoaded
from .training_runs import Curve as Curve
from .training_runs import RecordedTraining as RecordedTraining
from .training_runs import TrainingRequest as TrainingRequest
from .training_runs import TrainingRun as TrainingRun
from .training_runs import list_training_runs as list_training_runs
from .training_runs import make_training_job as make_training_job
from .training_runs import read_training_run as read_training_run
from .training_runs import resume_request as resume_request
from .training_runs import run_training as run_training
from .training_runs import train_model as train_model

__all__ = [
    "CONTACT_LEVEL",
    "HARDWARE_PROBES",
    "SHIPPED_MODEL",
    "Z_95",
    "Checkpoint",
    "Curve",
    "DeviceName",
    "EvaluationScores",
    "LstmState",
    "ModelCard",
    "ModelRegistry",
    "NetworkShape",
    "PatchCalibration",
    "PatchForward",
    "RecordedTraining",
    "SamplePrediction",
    "Trainer",
    "TrainingCancelled",
    "TrainingCandidate",
    "TrainingEpoch",
    "TrainingFinished",
    "TrainingLoaded",
    "TrainingRequest",
    "TrainingRun",
    "TrainingSetOverview",
    "calibrate_model",
    "card_mismatches",
    "card_path",
    "channel_groups",
    "check_autonomous",
    "clustered_interval",
    "device_name",
    "evaluate",
    "evaluate_model",
    "fingerprint",
    "fit_calibration",
    "hardware_rows",
    "list_training_runs",
    "load_card",
    "load_checkpoint",
    "load_episodes",
    "load_network",
    "load_samples",
    "make_card",
    "make_training_job",
    "modality_columns",
    "models_below",
    "predict",
    "rate_interval",
    "read_training_run",
    "resume_request",
    "run_training",
    "save_card",
    "save_checkpoint",
    "save_half_precision",
    "select_device",
    "stable_flags",
    "train_model",
    "training_candidates",
    "training_set_overview",
    "use_one_thread",
]
