"""MuJoCo tips or slides a pressed body where the model predicts it."""

from __future__ import annotations

import numpy as np
import pytest

from tests.backend.simulation.test_supports import block, pressed
from touchdown.backend.config.simulation import SupportSettings
from touchdown.backend.geometry import Body, Tower, rectangle
from touchdown.backend.simulation.release_mujoco import model_xml

mujoco = pytest.importorskip("mujoco")
SECONDS = 0.25
BAND_MM, BAND_SHARE = 0.2, 0.05


def engine_moves(body: Body, force_n, at_mm) -> tuple[float, float]:
    """Return (tilt in rad, way of the base in mm) of a free body under a dead force."""
    model = mujoco.MjModel.from_xml_string(model_xml(Tower((body,))))
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=50)
    start = data.xpos[1].copy()
    centre = np.array([0.0, 0.0, body.com_height_mm])
    moment = np.cross(np.subtract(at_mm, centre) * 1e-3, force_n)
    data.xfrc_applied[1] = np.r_[force_n, moment]
    mujoco.mj_step(model, data, nstep=int(SECONDS / model.opt.timestep))
    up = 1.0 - 2.0 * (data.qpos[4] ** 2 + data.qpos[5] ** 2)
    way = 1e3 * float(np.hypot(*(data.xpos[1] - start)[:2]))
    return float(np.arccos(np.clip(up, -1.0, 1.0))), way


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("lateral_n", [0.0, 0.4])
def test_a_pressed_block_tips_where_the_model_says(side: float, lateral_n: float) -> None:
    body, down_n = block(), 7.0
    weight = 1e-3 * body.mass_g * 9.81
    # Resultant at the edge: x down + lateral * height = 6 (down + weight).
    edge = (6.0 * (down_n + weight) - lateral_n * body.height_mm) / down_n
    for x, tips in ((edge - BAND_MM, False), (edge + BAND_MM, True)):
        tilt, _ = engine_moves(body, (side * lateral_n, 0.0, -down_n), (side * x, 0.0, 40.0))
        assert (tilt > 0.05) == tips


@pytest.mark.parametrize("share", [1.0 - BAND_SHARE, 1.0 + BAND_SHARE])
def test_a_pressed_block_slides_where_the_model_says(share: float) -> None:
    body = Body("low", rectangle(40.0, 40.0), rectangle(40.0, 40.0), 10.0, 35.0, 5.0)
    limit_n = 0.5 * (7.0 + 1e-3 * body.mass_g * 9.81)  # friction of the engine's model
    _, way = engine_moves(body, (share * limit_n, 0.0, -7.0), (0.0, 0.0, 10.0))
    assert (way > 5.0) == (share > 1.0)


@pytest.mark.parametrize("x_mm", [4.5, 5.5, 6.8])
def test_the_wrench_of_a_press_tips_the_engine_too(x_mm: float) -> None:
    _, rigid = pressed(Tower((block(),)), (x_mm, 0.0), SupportSettings())
    state, _ = pressed(Tower((block(),)), (x_mm, 0.0))
    fx, fy, fz, _, my, _ = rigid.wrench_g[0]
    at = x_mm + (-(my + 30.0 * fx) / fz)
    tilt, _ = engine_moves(block(), (-fx, -fy, -fz), (at, 0.0, 40.0))
    assert (tilt > 0.05) == bool(state.pose.rock_rad.any())
