from .certificate import RISK_LIMIT as RISK_LIMIT
from .certificate import Attempt as Attempt
from .certificate import AttemptLog as AttemptLog
from .certificate import CertificateStatus as CertificateStatus
from .certificate import ReleaseCertificate as ReleaseCertificate
from .certificate import ReleaseClaim as ReleaseClaim
from .certificate import ReleaseCounts as ReleaseCounts
from .certificate import attempt_error as attempt_error
from .certificate import attempts_path as attempts_path
from .certificate import certificate_of_attempt as certificate_of_attempt
from .certificate import find_certificate as find_certificate
from .certificate import method_sha256 as method_sha256
from .certificate import releases_needed as releases_needed
from .certificate import risk_bound as risk_bound
from .certificate import write_certificate as write_certificate
from .checkpoint import FusedCard as FusedCard
from .checkpoint import FusedCheckpoint as FusedCheckpoint
from .checkpoint import join_networks as join_networks
from .checkpoint import load_fused as load_fused
from .checkpoint import shipped_fused as shipped_fused
from .checkpoint import shipped_path as shipped_path
from .features import SENSOR_MM as SENSOR_MM
from .features import TICKS as TICKS
from .features import GraspedFace as GraspedFace
from .features import InputPart as InputPart
from .features import acting_point_mm as acting_point_mm
from .features import wrench_at_sensor as wrench_at_sensor
from .guard import ALARM as ALARM
from .guard import Guard as Guard
from .guard import GuardCalibration as GuardCalibration
from .guard import GuardFile as GuardFile
from .guard import PowerMartingale as PowerMartingale
from .guard import ScoreRanks as ScoreRanks
from .guard import guard_path as guard_path
from .guard import open_guard as open_guard
from .guard import signal_score as signal_score
from .inference import FusedForward as FusedForward
from .inference import InsetDistribution as InsetDistribution
from .training import MARGIN_REACH_MM as MARGIN_REACH_MM
from .training import FusedTrainer as FusedTrainer
from .training import FusedTraining as FusedTraining
from .training import data_sha256 as data_sha256

__all__ = [
    "ALARM",
    "MARGIN_REACH_MM",
    "RISK_LIMIT",
    "SENSOR_MM",
    "TICKS",
    "Attempt",
    "AttemptLog",
    "CertificateStatus",
    "FusedCard",
    "FusedCheckpoint",
    "FusedForward",
    "FusedTrainer",
    "FusedTraining",
    "GraspedFace",
    "Guard",
    "GuardCalibration",
    "GuardFile",
    "InputPart",
    "InsetDistribution",
    "PowerMartingale",
    "ReleaseCertificate",
    "ReleaseClaim",
    "ReleaseCounts",
    "ScoreRanks",
    "acting_point_mm",
    "attempt_error",
    "attempts_path",
    "certificate_of_attempt",
    "data_sha256",
    "find_certificate",
    "guard_path",
    "join_networks",
    "load_fused",
    "method_sha256",
    "open_guard",
    "releases_needed",
    "risk_bound",
    "shipped_fused",
    "shipped_path",
    "signal_score",
    "wrench_at_sensor",
    "write_certificate",
]
