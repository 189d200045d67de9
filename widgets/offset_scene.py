"""What the offset view shows: one displacement and what follows from it, values only."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from backend.core.flow import FloatArray, SupportKind

GhostKind = Literal["commanded", "measured", "scene", "model"]
Point = tuple[float, float]
EDGE_MM, REACH_STEP_MM = 2.0, 6.0
"""Room round what is drawn; the square grows in such steps, not with every nudge."""


@dataclass(frozen=True, slots=True)
class Ghost:
    """Where another source puts the face; ``sigma_mm`` is its standard uncertainty, 0: not told."""

    kind: GhostKind
    offset_mm: Point
    sigma_mm: float


@dataclass(frozen=True, slots=True)
class OffsetScene:
    """The grasped face over the bottom face, in the frame ``O``, mm.

    ``bottom`` and ``face``: (k, 2) outlines, each round its own centre. ``offset_mm`` is None while
    nobody has said where the face is. ``points_mm`` (N, 2), ``touching`` (N,), ``hull_mm`` (k, 2),
    ``centre_mm``, ``margin_mm`` and ``support`` follow from it. ``sigma_mm``: of the label.
    ``names``: of bottom and face, written into them; none while there is more to see.
    """

    bottom: FloatArray
    face: FloatArray
    offset_mm: Point | None = None
    yaw_rad: float = 0.0
    points_mm: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    touching: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    hull_mm: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    centre_mm: Point = (math.nan, math.nan)
    margin_mm: float = math.nan
    support: SupportKind = SupportKind.NO_ESTIMATE
    too_close: bool = False
    sigma_mm: float = 0.0
    ghosts: tuple[Ghost, ...] = ()
    names: tuple[str, str] | None = None

    @property
    def reach_mm(self) -> float:
        """Half width of the square that holds all that is drawn.

        The same for every label whose centre lies over the bottom, so that episodes compare.
        """
        face = float(np.hypot(*self.face.T).max() if self.yaw_rad else np.abs(self.face).max())
        usual = float(np.abs(self.bottom).max()) + face + EDGE_MM
        placed = [(ghost.offset_mm, ghost.sigma_mm) for ghost in self.ghosts]
        if self.offset_mm is not None:
            placed.append((self.offset_mm, self.sigma_mm))
        far = max((max(map(abs, at)) + max(face, sigma) for at, sigma in placed), default=0.0)
        more = max(far + EDGE_MM - usual, 0.0)
        return usual + REACH_STEP_MM * math.ceil(more / REACH_STEP_MM)


def verdict_in_words(scene: OffsetScene) -> str:
    """Return whether the piece would stand, and by how much."""
    if scene.offset_mm is None:
        return "No displacement yet"
    if scene.support is not SupportKind.AREA:
        return "No contact: it would fall" if not scene.touching.any() else (
            f"Would fall: {scene.support.value}"
        )  # fmt: skip
    side = "inside" if scene.margin_mm >= 0 else "outside"
    distance = f"centre of mass {abs(scene.margin_mm):.1f} mm {side} the hull"
    if scene.too_close:
        return f"Too close to call: {distance}"
    return f"Would {'stand' if scene.margin_mm >= 0 else 'fall'}: {distance}"


def offset_in_words(offset_mm: Point | None, sigma_mm: float = 0.0) -> str:
    """Write a displacement as "x +1.50, y +0.25 mm", with its uncertainty."""
    if offset_mm is None:
        return "no displacement"
    x, y = (f"{v:+.2f}".replace("-", "\N{MINUS SIGN}") for v in offset_mm)
    spread = f" \N{PLUS-MINUS SIGN} {sigma_mm:.2f}" if sigma_mm else ""
    return f"x {x}, y {y} mm{spread}"
