"""Verification vectors of the mechanics: no noise, defaults, end of hold."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from touchdown.backend.core.values import GRID_COLS, GRID_ROWS
from touchdown.backend.simulation.marker_fields import build_gel
from touchdown.backend.simulation.wrist_sensor import centre_of_pressure_mm, wrist_wrench

TOPS = {"mushroom": 25.4, "barrel": 21.2, "pot": 15.0}
CENTRE = (GRID_ROWS // 2) * GRID_COLS + GRID_COLS // 2

TABLE = Path(__file__).parents[2] / "data" / "mechanics-vectors.csv"
WORDS = 2


def read_vectors():
    with TABLE.open(newline="") as file:
        rows = list(csv.reader(file))[1:]
    return [(*row[:WORDS], *map(float, row[WORDS:])) for row in rows]


VECTORS = read_vectors()


@pytest.mark.parametrize("row", VECTORS, ids=lambda r: f"{r[0]}-{r[1]}-{r[2]:g}-{r[3]:g}")
def test_published_vector(row, press, shapes) -> None:
    disc, square = shapes
    bottoms = {"c15": disc(15.0), "c25": disc(25.0), "s15": square(15.0)}
    top, bottom, x, y, cells, f_x, f_y, f_z, m_x, m_y, rho_x, rho_y, *rest = row
    state, solved = press(TOPS[top], bottoms[bottom], (x, y))
    end = solved[-1]
    force, moment = end.wrench_g[0, :3], end.wrench_g[0, 3:]
    assert state.cells.count[0] == cells
    assert state.residual[0] <= 1e-6
    np.testing.assert_allclose(force, (f_x, f_y, f_z), rtol=0.01, atol=6e-4)
    np.testing.assert_allclose(moment[:2], (m_x, m_y), rtol=0.02, atol=6e-4)
    np.testing.assert_allclose(1e3 * end.q[0, 3:5], (rho_x, rho_y), rtol=0.01, atol=6e-3)
    np.testing.assert_allclose(end.cop_mm[0], rest[:2], rtol=0.01, atol=6e-3)
    at_wrist = wrist_wrench(end.wrench_g, 120.0)
    np.testing.assert_allclose(at_wrist[0, 3:5], rest[2:4], rtol=0.02, atol=6e-5)
    lever = 120.0 - state.cells.r_z[0]
    np.testing.assert_allclose(centre_of_pressure_mm(at_wrist, lever), end.cop_mm, atol=1e-9)
    field = build_gel((0.058, 0.058)).displacement_px(end.strain, end.normal_n, np.array([10.0]))
    np.testing.assert_allclose(field[0, :, CENTRE].ravel(), rest[4:], atol=0.05)


@pytest.mark.parametrize(("pitch_mm", "f_x"), [(2.0, 0.727), (1.0, 0.794), (0.5, 0.799)])
def test_discretisation_table(pitch_mm, f_x, press, shapes) -> None:
    _, solved = press(25.4, shapes[0](15.0), (9, 0), pitch_mm=pitch_mm)
    assert solved[-1].wrench_g[0, 0] == pytest.approx(f_x, rel=0.01)


@pytest.mark.parametrize(
    ("stiffness", "f_x"), [(2.0, 1.233), (5.0, 1.032), (20.0, 0.794), (100.0, 0.610)]
)
def test_foundation_table(stiffness, f_x, press, shapes) -> None:
    _, solved = press(25.4, shapes[0](15.0), (9, 0), foundation_n_mm3=stiffness)
    assert solved[-1].wrench_g[0, 0] == pytest.approx(f_x, rel=0.01)
