"""The centre of pressure that the wrist wrench demands, as a check of an estimated patch."""

from __future__ import annotations

import numpy as np

from backend.core.flow import FloatArray

LEAST_PRESS_N = 0.5
"""Below this press force the quotient is noise (F/T offset 0.2 N): no centre is returned."""
FIRST_TICK, LAST_TICKS = 0, slice(-4, None)
LEAST_RISE_N = 2.0
"""A press that gains less than this says nothing of where it acts."""


def centre_of_pressure_mm(
    wrench: FloatArray, lever_mm: float, least_press_n: float = LEAST_PRESS_N
) -> FloatArray:
    """Return the centre of pressure in the face plane, (..., 2) mm from the axis through ``G``.

    ``wrench`` (..., 6) in N and N·m at the sensor, tared; ``lever_mm`` is the height of the sensor
    above the face (grip height + sensor above ``G``). The lateral forces turn about that lever and
    must be taken out (method 14, item 3; bench-physics 4):

        x = -(Ty + h Fx) / Fz,   y = (Tx - h Fy) / Fz

    NaN where the piece is not pressed by at least ``least_press_n``.
    """
    fx, fy, fz = wrench[..., 0], wrench[..., 1], wrench[..., 2]
    tx_nmm, ty_nmm = 1e3 * wrench[..., 3], 1e3 * wrench[..., 4]
    press = np.where(fz >= least_press_n, fz, np.nan)
    x = -(ty_nmm + lever_mm * fx) / press
    y = (tx_nmm - lever_mm * fy) / press
    return np.stack((x, y), axis=-1)


def pressed_at_mm(wrench: FloatArray, lever_mm: float) -> FloatArray:
    """Return (2,) where a press acted, in ``F``: the centre of pressure without slow sensor errors.

    ``wrench`` (20, 6) in N and N·m at the sensor, ``lever_mm`` above the face. The offset left by
    the tare (several mm of centre) is the same at all ticks: the growth from the first tick, when
    hardly anything presses, to the last ones does not contain it. NaN where the press hardly grows.
    """
    growth = wrench[LAST_TICKS].mean(axis=0) - wrench[FIRST_TICK]
    return centre_of_pressure_mm(growth, lever_mm, LEAST_RISE_N)
