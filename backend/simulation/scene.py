"""What a simulated trial is set up with."""

from __future__ import annotations

from dataclasses import dataclass, field

from backend.config.simulation import SimulationSettings
from backend.objects.catalogue import Piece
from backend.objects.shapes import Outline
from backend.objects.tower import Tower


@dataclass(frozen=True, slots=True)
class Scene:
    """A piece in a jig between the open jaws, a tower of bottoms below it, and a seed.

    ``bottoms``: from the lowest up; the topmost carries the bench frame ``O``. ``start_mm``: true
    displacement of the piece's face from ``O`` before the first probe, errors of grasp and print
    included. ``start_height_mm``: height of the commanded face above the support at the start.
    ``mounting``: number of the fitting of bottom and gels. With ``jig`` the piece stands in a jig
    at ``start_mm``: it can be put back there and taken again.
    """

    piece: Piece
    bottoms: Tower
    start_mm: tuple[float, float]
    seed: int
    settings: SimulationSettings = field(default_factory=SimulationSettings)
    start_height_mm: float = 3.0
    mounting: int = 0
    jig: bool = False

    def __post_init__(self) -> None:
        if self.piece.grip_height_mm is None:
            raise ValueError(f"{self.piece.name} cannot be grasped")
        if self.bottoms.bodies[-1].upper is None:
            raise ValueError(f"{self.bottoms.bodies[-1].name} carries nothing")

    @property
    def grip_height_mm(self) -> float:
        """Nominal height of the grasp pivot above the face."""
        assert self.piece.grip_height_mm is not None
        return self.piece.grip_height_mm

    @property
    def surface(self) -> Outline:
        """Outline of the surface that is touched."""
        upper = self.bottoms.bodies[-1].upper
        assert upper is not None
        return upper
