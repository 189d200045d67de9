"""What a press of the second world did to the bottoms: how far they slid, whether they come back.

Without the press a body that leans on the edge of its base comes back as long as the common centre
of mass of all it carries is on the inner side of that edge.
"""

from __future__ import annotations

import numpy as np

from backend.core.flow import FloatArray
from backend.objects.tower import Tower
from backend.simulation.elsewhere.mount import HELD, Mount

UPRIGHT_RAD = 1e-3
"""A body that leans less than this stands flat."""
JOINTS = 7
"""Numbers of a free body's place: metres, quaternion."""


def aftermath(mounted: Mount, bottoms: Tower) -> tuple[FloatArray, bool]:
    """Return how far each free bottom slid on what is below it (m, 2) in mm, and whether it falls.

    ``bottoms``: the tower that was mounted.
    """
    model, data, free = mounted.model, mounted.data, mounted.free
    first = len(bottoms.bodies) - free
    slides = np.zeros((free, 2))
    falls = False
    below_now = below_then = np.zeros(2)
    bodies = range(model.nbody - free, model.nbody)
    for k, number in enumerate(bodies):
        then = model.qpos0[HELD.stop + JOINTS * k :][:3]
        board = _axes(model.body_quat[number])
        now = _axes(data.xquat[number])
        lean = (board.T @ now)[:2, 2]
        edge = np.zeros(3)
        if np.hypot(*lean) > UPRIGHT_RAD:
            corners = bottoms.bodies[first + k].lower.polygon()
            edge[:2] = 1e-3 * corners[np.argmax(corners @ lean)]
            pivot = data.xpos[number] + now @ edge
            carried = list(bodies)[k:]
            mass = model.body_mass[carried]
            centre = mass @ data.xipos[carried] / mass.sum()
            outward = board[:2, :2] @ lean
            falls = falls or bool((centre - pivot)[:2] @ outward > 0.0)
        place = (data.xpos[number] + now @ edge)[:2] - below_now
        slides[k] = place - (then + board @ edge)[:2] + below_then
        below_now, below_then = data.xpos[number][:2], then[:2]
    return 1e3 * slides, falls


def _axes(quat: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) of a unit quaternion (w, x, y, z)."""
    w, x, y, z = quat
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
