"""How a marker gel looks at rest: dot grid, colours and grain, read from resources/gels."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources

import numpy as np

from backend.core.flow import GRID_COLS, GRID_ROWS, MARKERS, FloatArray, read_only


@dataclass(frozen=True, slots=True)
class GelLook:
    """Appearance of one kind of gel (bench reference 7; colours are B, G, R levels).

    ``rest_px`` (63, 2) row-major dot centres; ``background`` (3, 4, 3) colours at the centres
    (40 + 80 c, 40 + 80 r); ``radius_px`` at half contrast and ``edge_px`` of the logistic edge;
    ``grain`` and ``noise``: standard deviations of the fixed pattern and of every frame, levels.
    """

    name: str
    rest_px: FloatArray
    background: FloatArray
    core: FloatArray
    smear: FloatArray
    radius_px: float
    edge_px: float
    grain: float
    noise: float

    def __post_init__(self) -> None:
        for array in (self.rest_px, self.background, self.core, self.smear):
            read_only(array)


@cache
def load_look(name: str = "large-dot") -> GelLook:
    """Return the gel ``name`` that ships with Touchdown."""
    text = resources.files("resources").joinpath("gels", f"{name}.toml").read_text("utf-8")
    raw = tomllib.loads(text)
    rest_px = np.array(raw["rest_px"], dtype=np.float64)
    if rest_px.shape != (GRID_ROWS, GRID_COLS, 2):
        raise ValueError(f"gel {name}: rest_px is {rest_px.shape}, not 7 x 9 x 2")
    return GelLook(
        name=str(raw["name"]),
        rest_px=rest_px.reshape(MARKERS, 2),
        background=np.array(raw["background"], dtype=np.float64),
        core=np.array(raw["core"], dtype=np.float64),
        smear=np.array(raw["smear"], dtype=np.float64),
        radius_px=float(raw["radius_px"]),
        edge_px=float(raw["edge_px"]),
        grain=float(raw["grain"]),
        noise=float(raw["noise"]),
    )


def mirrored(look: GelLook, width_px: int = 320) -> GelLook:
    """Return the look of the opposite finger: flipped left to right, order kept row-major."""
    grid = look.rest_px.reshape(GRID_ROWS, GRID_COLS, 2)[:, ::-1].copy()
    grid[..., 0] = width_px - 1 - grid[..., 0]
    return replace(
        look, rest_px=grid.reshape(MARKERS, 2), background=look.background[:, ::-1].copy()
    )
