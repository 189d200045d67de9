"""The label that is being worked on, before it is saved: whole µm, so that nudges add up."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace

from backend.catalogue.values import NO_LABEL, Label, Revision, Source
from backend.core.flow import FloatArray

LIMIT_UM = 99_990
"""No displacement that can be typed or nudged is larger than this."""
NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)"
TYPED = re.compile(rf"\s*({NUMBER})\s*,\s*({NUMBER})\s*(?:,\s*({NUMBER})\s*)?")


@dataclass(frozen=True, slots=True)
class Edit:
    """``base`` is the revision that holds; ``label`` and ``source`` what would be saved."""

    base: Revision
    label: Label
    source: Source

    @classmethod
    def of(cls, head: Revision) -> Edit:
        """Begin with what holds."""
        return cls(head, head.label, head.source)

    @classmethod
    def blank(cls, head: Revision) -> Edit:
        """Begin with nothing: for an opinion that nobody's label should sway."""
        return cls(replace(head, label=NO_LABEL, source="human"), NO_LABEL, "human")

    @property
    def changed(self) -> bool:
        """Whether there is anything to save."""
        return self.label != self.base.label

    @property
    def offset_mm(self) -> tuple[float, float] | None:
        """The displacement, None where there is none."""
        if self.label.x_um is None or self.label.y_um is None:
            return None
        return self.label.x_um / 1e3, self.label.y_um / 1e3

    @property
    def sigma_mm(self) -> float:
        """The standard uncertainty, 0 where none was told."""
        return (self.label.sigma_um or 0) / 1e3

    @property
    def yaw_rad(self) -> float:
        """The rotation of the face."""
        return math.radians((self.label.theta_mdeg or 0) / 1e3)

    def nudged(self, dx_um: int, dy_um: int) -> Edit:
        """Move by whole µm, from the bottom's centre where there is no displacement yet."""
        return self._at((self.label.x_um or 0) + dx_um, (self.label.y_um or 0) + dy_um)

    def placed(self, x_mm: float, y_mm: float) -> Edit:
        """Move to a place."""
        return self._at(round(x_mm * 1e3), round(y_mm * 1e3))

    def estimated(self, x_mm: float, y_mm: float, sigma_mm: float, source: Source) -> Edit:
        """Take what a model says, with its own uncertainty."""
        moved = self._at(round(x_mm * 1e3), round(y_mm * 1e3))
        return replace(
            moved, label=replace(moved.label, sigma_um=round(sigma_mm * 1e3)), source=source
        )

    def trusted(self, sigma_mm: float) -> Edit:
        """Say how sure the person is."""
        return replace(self, label=replace(self.label, sigma_um=round(sigma_mm * 1e3)))

    def _at(self, x_um: int, y_um: int) -> Edit:
        x, y = (min(max(value, -LIMIT_UM), LIMIT_UM) for value in (x_um, y_um))
        theta = self.label.theta_mdeg or 0
        base = self.base.label
        if base.is_set and (x, y, theta) == (base.x_um, base.y_um, base.theta_mdeg or 0):
            # Moved there and back: nothing was changed, neither is the source.
            return Edit.of(self.base)
        # Another's uncertainty does not hold for what a person sets.
        sigma = self.label.sigma_um if self.source == "human" else None
        return replace(self, label=Label(x, y, theta, sigma), source="human")


def parse(text: str) -> tuple[float, float, float | None]:
    """Return x, y and (if given) sigma in mm of "x,y" or "x,y,sigma"; raises ``ValueError``."""
    match = TYPED.fullmatch(text)
    if match is None:
        raise ValueError("Type x,y in mm, such as 1.5,-2 (or x,y,uncertainty).")
    x, y = float(match[1]), float(match[2])
    sigma = float(match[3]) if match[3] is not None else None
    if max(abs(x), abs(y)) * 1e3 > LIMIT_UM:
        raise ValueError("No displacement is larger than 99.99 mm.")
    if sigma is not None and not 0.001 <= sigma <= 20:
        raise ValueError("An uncertainty lies between 0.001 and 20 mm.")
    return x, y, sigma


def as_pair(offset_mm: FloatArray) -> tuple[float, float]:
    """Return a (2,) displacement as a pair."""
    x, y = offset_mm.tolist()
    return float(x), float(y)
