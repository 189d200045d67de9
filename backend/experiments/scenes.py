"""Scenes and displacements of the experiments, each from its own seed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from backend.config.simulation import SimulationSettings
from backend.core.faults import InputError
from backend.core.flow import FloatArray
from backend.objects.catalogue import Catalogue, Piece
from backend.objects.leaning import draw_tower, placeable
from backend.objects.starts import draw_offset, draw_start
from backend.objects.tower import Tower, judge
from backend.simulation.scene import Scene

_START, _DISPLACEMENT = 77, 78


@dataclass(frozen=True, slots=True)
class Case:
    """A piece over one bottom, or over a tower of them (bottom-up), on a bench."""

    piece: Piece
    bottoms: tuple[Piece, ...]
    settings: SimulationSettings

    @classmethod
    def of(
        cls,
        catalogue: Catalogue,
        piece: str,
        bottoms: tuple[str, ...],
        settings: SimulationSettings,
    ) -> Case:
        """Look the names up; raises ``InputError``."""
        return cls(catalogue.top(piece), tuple(map(catalogue.bottom, bottoms)), settings)


def start_scene(case: Case, seed: int) -> Scene | None:
    """Return the scene of one trial, started unstable; None if nothing can be placed there.

    The device loop makes the same scene of the same seed.
    """
    rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, _START])))
    tower = draw_tower(rng, case.bottoms)
    if len(case.bottoms) > 1 and not placeable(case.piece, tower):
        return None
    start = draw_start(rng, case.piece.body(), tower)
    return Scene(case.piece, tower, start, seed, case.settings)


def probing_scene(case: Case, seed: int) -> Scene:
    """Return a scene for single presses: one mounting and one gripping of their own."""
    return Scene(case.piece, Tower((case.bottoms[0].body(),)), (0.0, 0.0), seed, case.settings)


def balanced_offset(case: Case, seed: int, attempt: int, *, stable: bool) -> FloatArray:
    """Return (2,) a displacement at which the piece would (not) stand, uniform over all such.

    Overlaps below the least of the data collection do not occur. Raises ``InputError`` if there is
    none of the wanted kind.
    """
    rng = displacement_rng(seed, 0, attempt)
    bottom = case.bottoms[0].body()
    for _ in range(100):
        for offset in draw_offset(rng, case.piece.face, case.bottoms[0].face, 16):
            at = (float(offset[0]), float(offset[1]))
            if judge(Tower((bottom, case.piece.body(at)))).stands is stable:
                return np.asarray(offset, dtype=np.float64)
    raise InputError(
        f"'{case.piece.name}' never {'stands' if stable else 'falls'} there.",
        case.bottoms[0].name,
        "Choose another bottom.",
    )


def uniform_offset(case: Case, seed: int, probe: int, attempt: int) -> FloatArray:
    """Return (2,) a displacement, uniform over all with enough overlap."""
    rng = displacement_rng(seed, probe, attempt)
    return np.asarray(draw_offset(rng, case.piece.face, case.bottoms[0].face, 1)[0])


def displacement_rng(seed: int, probe: int, attempt: int) -> np.random.Generator:
    """Return the generator of the displacement of one probe of a trial."""
    place = np.random.SeedSequence([seed, _DISPLACEMENT, probe + 1, attempt + 1])
    return np.random.Generator(np.random.PCG64(place))
