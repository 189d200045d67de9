from .applied import UNCALIBRATED as UNCALIBRATED
from .applied import CalibratedPositions as CalibratedPositions
from .applied import HandPosition as HandPosition
from .applied import calibrated_cameras as calibrated_cameras
from .applied import calibrated_positions as calibrated_positions
from .applied import camera_conflicts as camera_conflicts
from .applied import require_calibrated_bottom as require_calibrated_bottom
from .cameras import AXES as AXES
from .cameras import FINGERPRINT_LIMIT_PX as FINGERPRINT_LIMIT_PX
from .cameras import FINGERPRINT_VALUES as FINGERPRINT_VALUES
from .cameras import HELD_LIMIT_PX as HELD_LIMIT_PX
from .cameras import SIDES as SIDES
from .cameras import Side as Side
from .cameras import SidePress as SidePress
from .cameras import dots_to_numbers as dots_to_numbers
from .cameras import estimate_cameras as estimate_cameras
from .cameras import fingerprint_distance_px as fingerprint_distance_px
from .cameras import fingers_distinguishable as fingers_distinguishable
from .cameras import identify_gel as identify_gel
from .cameras import mirrored_dots as mirrored_dots
from .cameras import numbers_to_dots as numbers_to_dots
from .estimators import PAYLOAD_POSES as PAYLOAD_POSES
from .estimators import TOOL_GRIPS as TOOL_GRIPS
from .estimators import PoseReadings as PoseReadings
from .estimators import TouchedEdge as TouchedEdge
from .estimators import WeighedPiece as WeighedPiece
from .estimators import YawOf as YawOf
from .estimators import estimate_board as estimate_board
from .estimators import estimate_held_piece as estimate_held_piece
from .estimators import estimate_level_payload as estimate_level_payload
from .estimators import estimate_payload as estimate_payload
from .estimators import estimate_tool as estimate_tool
from .estimators import estimate_wrist as estimate_wrist
from .records import CalibrationRecord as CalibrationRecord
from .records import CalibrationStatus as CalibrationStatus
from .records import CalibrationStore as CalibrationStore
from .records import DeviceName as DeviceName
from .result import CALIBRATION_KINDS as CALIBRATION_KINDS
from .result import CALIBRATION_NAMES as CALIBRATION_NAMES
from .result import MIRROR_CODES as MIRROR_CODES
from .result import ON_BOTTOM as ON_BOTTOM
from .result import CalibrationEstimate as CalibrationEstimate
from .result import CalibrationName as CalibrationName
from .result import format_residual as format_residual
from .result import format_value as format_value
from .result import quantity_name as quantity_name

__all__ = [
    "AXES",
    "CALIBRATION_KINDS",
    "CALIBRATION_NAMES",
    "FINGERPRINT_LIMIT_PX",
    "FINGERPRINT_VALUES",
    "HELD_LIMIT_PX",
    "MIRROR_CODES",
    "ON_BOTTOM",
    "PAYLOAD_POSES",
    "SIDES",
    "TOOL_GRIPS",
    "UNCALIBRATED",
    "CalibratedPositions",
    "CalibrationEstimate",
    "CalibrationName",
    "CalibrationRecord",
    "CalibrationStatus",
    "CalibrationStore",
    "DeviceName",
    "HandPosition",
    "PoseReadings",
    "Side",
    "SidePress",
    "TouchedEdge",
    "WeighedPiece",
    "YawOf",
    "calibrated_cameras",
    "calibrated_positions",
    "camera_conflicts",
    "dots_to_numbers",
    "estimate_board",
    "estimate_cameras",
    "estimate_held_piece",
    "estimate_level_payload",
    "estimate_payload",
    "estimate_tool",
    "estimate_wrist",
    "fingerprint_distance_px",
    "fingers_distinguishable",
    "format_residual",
    "format_value",
    "identify_gel",
    "mirrored_dots",
    "numbers_to_dots",
    "quantity_name",
    "require_calibrated_bottom",
]
