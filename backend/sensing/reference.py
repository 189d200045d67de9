"""The tactile reference: where the 63 markers rest before a probe, and how still they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256

import numpy as np

from backend.core.faults import RefusedError
from backend.core.flow import MARKERS, Finger, FloatArray, MarkerField, MarkerState, read_only

FRAMES = 10
"""Frames of a usual reference."""
FEWEST_FRAMES = 3
NOISE_FLOOR_PX = 0.06
"""Noise of one marker centre on a still gel (measured on real frames, docs/tracking.md)."""
MOTION_FACTOR = 3.0
CONTACT_PX = 0.7
"""Change of shape (rms, whole-grid motion and affine part removed) that means contact."""


@dataclass(frozen=True, slots=True)
class Reference:
    """Mean of still frames: ``position_px`` (63, 2), ``noise_px`` (63,) sigma per marker at rest.

    ``t_s``: bench time of its newest frame; ``frames``: how many were averaged.
    """

    finger: Finger
    t_s: float
    position_px: FloatArray
    noise_px: FloatArray
    frames: int

    def __post_init__(self) -> None:
        read_only(self.position_px)
        read_only(self.noise_px)

    @property
    def sha256(self) -> str:
        """Name of the rest positions: equal ones have the same."""
        return sha256(np.ascontiguousarray(self.position_px, dtype="<f8").tobytes()).hexdigest()


def take_reference(fields: Sequence[MarkerField], template: Reference | None = None) -> Reference:
    """Average ``fields`` of one finger, oldest first, into a reference.

    ``template``: a no-contact reference of the same gel; with it a gel in contact is refused (the
    loop gives the first one taken in air after gripping). Raises ``RefusedError`` with reason
    "frames" (too few or of two fingers), "markers" (not all seen), "motion" (more than three times
    the noise floor) or "contact".
    """
    _check_frames(fields)
    places = np.stack([field.position_px for field in fields])
    rest = places.mean(axis=0)
    motion_px = float(np.sqrt(((places - rest) ** 2).mean(axis=(1, 2)).max()))
    if motion_px > MOTION_FACTOR * NOISE_FLOOR_PX:
        raise RefusedError(
            "motion",
            f"The gel moves by {motion_px:.2f} px; wait until it is still "
            f"(at most {MOTION_FACTOR * NOISE_FLOOR_PX:.2f} px).",
        )
    if template is not None:
        refuse_contact(rest, [template.position_px])
    noise = places.std(axis=0, ddof=1).mean(axis=1)
    return Reference(fields[-1].finger, fields[-1].t_s, rest, noise, len(fields))


def refuse_contact(position_px: FloatArray, templates_px: Sequence[FloatArray]) -> None:
    """Raise ``RefusedError`` "contact" unless (63, 2) places have the shape of one template."""
    change_px = min(shape_change_px(position_px, template) for template in templates_px)
    if not change_px <= CONTACT_PX:
        raise RefusedError(
            "contact",
            f"The gel is pressed {change_px:.2f} px out of its no-contact shape "
            f"(at most {CONTACT_PX:.2f} px).",
        )


def shape_change_px(position_px: FloatArray, rest_px: FloatArray) -> float:
    """Return the rms change of shape between two (63, 2) grids beyond an affine motion, in px."""
    model = np.column_stack([rest_px, np.ones(MARKERS)])
    change = position_px - rest_px
    fitted = model @ np.linalg.lstsq(model, change, rcond=None)[0]
    return float(np.sqrt(((change - fitted) ** 2).sum(axis=1).mean()))


def _check_frames(fields: Sequence[MarkerField]) -> None:
    if len(fields) < FEWEST_FRAMES or len({field.finger for field in fields}) > 1:
        raise RefusedError(
            "frames", f"A reference needs {FEWEST_FRAMES} or more frames of one finger."
        )
    hidden = max(int((field.state != MarkerState.SEEN).sum()) for field in fields)
    if hidden:
        raise RefusedError(
            "markers", f"{hidden} of the {MARKERS} markers are not seen; clean or check the gel."
        )
