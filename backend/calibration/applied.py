"""Effect of the calibrations in use: target positions, contact height, and camera settings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from touchdown.backend.calibration.records import CalibrationRecord
from touchdown.backend.calibration.result import MIRROR_CODES, ON_BOTTOM, CalibrationName
from touchdown.backend.config import FingerCameraSettings, GelsightSettings
from touchdown.backend.core import FINGERS, FloatArray, RefusedError


@dataclass(frozen=True, slots=True)
class HandPosition:
    """Position of the hand, mm, and the standard uncertainty of x and of y."""

    x_mm: float
    y_mm: float
    sigma_mm: float


@dataclass(frozen=True, slots=True)
class BoardPosition:
    """Position of the hand with the face of ``piece`` on the centre of ``bottom``.

    ``slope_x``, ``slope_y``: increase of the contact height per mm of x and y.
    """

    piece: str
    bottom: str
    place: HandPosition
    contact_mm: float
    slope_x: float
    slope_y: float

    def is_of(self, piece: str, bottom: str) -> bool:
        """Return True if it was felt with this piece on this bottom."""
        return (self.piece, self.bottom) == (piece, bottom)

    def contact_at(self, middle_mm: FloatArray) -> float:
        """Return the contact height of the hand for a centre of contact ``middle_mm`` (2,)."""
        x_mm, y_mm = middle_mm.tolist()
        return self.contact_mm + self.slope_x * float(x_mm) + self.slope_y * float(y_mm)


@dataclass(frozen=True, slots=True)
class CalibratedPositions:
    """Positions from the calibrations of board and tool; None without a valid one."""

    board: BoardPosition | None = None
    face: HandPosition | None = None  # centre of the held face relative to the tool axis

    def origin(self, named_mm: tuple[float, float], sigma_mm: float, bottom: str) -> HandPosition:
        """Return the position of the hand with the face over the centre of ``bottom``.

        ``named_mm`` other than (0, 0) is the position of the bottom entered by the operator, known
        to ``sigma_mm``; the face offset is subtracted. Otherwise the calibration of the board is
        used, if it was measured on this bottom.
        """
        if not any(named_mm) and self.board is not None and self.board.bottom == bottom:
            return self.board.place
        x_mm, y_mm = named_mm
        if self.face is None:
            return HandPosition(x_mm, y_mm, sigma_mm)
        off = self.face
        return HandPosition(x_mm - off.x_mm, y_mm - off.y_mm, math.hypot(sigma_mm, off.sigma_mm))


UNCALIBRATED = CalibratedPositions()


def calibrated_positions(used: Mapping[CalibrationName, CalibrationRecord]) -> CalibratedPositions:
    """Return the positions of the calibrations in use."""
    tool = used.get("tool")
    face = None if tool is None else _place(tool, "face_x_mm", "face_y_mm")
    return CalibratedPositions(_board(used.get("board")), face)


def require_calibrated_bottom(
    used: Mapping[CalibrationName, CalibrationRecord], bottom: str, step: str
) -> None:
    """Raise ``RefusedError`` if the board was measured on another bottom than ``bottom``.

    ``step``: clause on how the board of this bench is measured.
    """
    board = calibrated_positions(used).board
    if board is not None and board.bottom != bottom:
        raise RefusedError(
            "CALIBRATION-OTHER-BOTTOM",
            f"Board: it was measured on {board.bottom}, not on {bottom}.",
            f"{step[:1].upper()}{step[1:]}.",
        )


def calibrated_cameras(settings: GelsightSettings, record: CalibrationRecord) -> GelsightSettings:
    """Return the camera settings with finger, mirroring and scale of the calibration.

    Settings that name other serial numbers are unchanged.
    """
    by_finger = {finger: record.file.devices.get(f"tactile_{finger}") for finger in FINGERS}
    known = {who.serial: finger for finger, who in by_finger.items() if who is not None}
    own = {finger: getattr(settings, finger) for finger in FINGERS}
    serials = {camera.serial for camera in own.values()}
    if len(known) != 2 or (any(serials) and serials != set(known)):
        return settings
    if own["left"].serial and known[own["left"].serial] == "right":
        own = {"left": own["right"], "right": own["left"]}
    values = record.file.values
    sat: dict[str, FingerCameraSettings] = {}
    for finger in FINGERS:
        code = values.get(f"{finger}_mirror")
        mirror = own[finger].mirror if code is None else MIRROR_CODES[round(code.value)]
        gel = getattr(settings, finger).gel  # is named by finger
        sat[finger] = own[finger].model_copy(update={"mirror": mirror, "gel": gel})
    scale = {
        f"mm_per_px_{pixel}": 0.5
        * sum(values[f"{finger}_{image}_mm_px"].value for finger in FINGERS)
        for pixel, image in (("x", "u"), ("y", "v"))
    }
    return settings.model_copy(update={**sat, **scale})


def camera_conflicts(
    settings: GelsightSettings, record: CalibrationRecord, step: str
) -> dict[str, str]:
    """Return, by device, a message where settings and calibration disagree on a camera.

    The calibration is used. The first message contains the remedy; ``step``: clause on how to
    measure again.
    """
    sits, told = calibrated_cameras(settings, record), dict[str, str]()
    for finger in FINGERS:
        written, found = getattr(settings, finger).serial, getattr(sits, finger).serial
        if written and written != found:
            advice = (
                ". Exchange the two in the file; or, if the sensors have changed places since, "
                f"{step}"
            )
            told[f"tactile_{finger}"] = (
                f"The lab file names {written} for the {finger} finger, the calibration of "
                f"{record.file.date:%Y-%m-%d} found {found} there, which is used"
                f"{'' if told else advice}"
            )
    return told


def _board(record: CalibrationRecord | None) -> BoardPosition | None:
    if record is None or ON_BOTTOM not in record.file.about:
        return None
    piece, bottom = record.file.about.split(ON_BOTTOM)
    values = record.file.values
    return BoardPosition(
        piece,
        bottom,
        _place(record, "x_mm", "y_mm"),
        values["z_mm"].value,
        values["slope_x_rad"].value,
        values["slope_y_rad"].value,
    )


def _place(record: CalibrationRecord, x_name: str, y_name: str) -> HandPosition:
    x, y = record.file.values[x_name], record.file.values[y_name]
    return HandPosition(x.value, y.value, max(x.sigma, y.sigma))
