"""Release of a tower simulated with MuJoCo, as a second opinion and for the animation of a fall.

Optional. Shapes do not collide with each other. Each flat face has tiny massless spheres along its
outline, tangent to the face from inside, and only spheres collide with shapes. The built-in contact
of cylinders (MuJoCo 4.0) misplaces the toppling edge by up to 1.3 mm at a radius of 7.5 mm; this
model by 0.06 mm. It never replaces the exact analysis of ``geometry.tower``.
"""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from math import acos, cos, degrees, sin
from typing import Any

import numpy as np

from touchdown.backend.core import Fall, InputError
from touchdown.backend.geometry import Body, Outline, Point, Tower, TowerVerdict, rotated

SPHERES_PER_FACE = 32
SPHERE_RADIUS_MM = 0.05
FALLEN_DEG = 12.0  # A body tilted by more has fallen

PAIR_BAND_MM = 0.2
TOWER_BAND_MM = 0.25
STEP_S = 0.001

HEADER = f"""
<mujoco>
  <compiler boundmass="0" boundinertia="0" angle="radian"/>
  <option timestep="{STEP_S}" integrator="implicitfast" solver="Newton" iterations="50"
          cone="pyramidal"/>
  <default>
    <geom condim="3" friction="0.5 0.005 0.0001" solref="0.004 1"
          solimp="0.99 0.999 0.0001 0.5 2" contype="1" conaffinity="2" mass="0"/>
    <default class="rim">
      <geom type="sphere" size="{SPHERE_RADIUS_MM * 1e-3}" contype="2" conaffinity="1"/>
    </default>
  </default>
"""


def simulate_release(
    tower: Tower, seconds: float = 1.5, frame_hz: float = 60.0, disturbance_mm: Point = (0.0, 0.0)
) -> tuple[bool, Fall]:
    """Simulate the release of a tower for ``seconds``.

    ``disturbance_mm``: effect of the opening fingers, as in ``judge_tower``. Returns True if a free
    body tilted by more than 12 degrees, and the motion at ``frame_hz``: per body the centre of its
    lower face (m; z = 0 at the base of the topmost body) and quaternion. Raises ``InputError``
    without MuJoCo.
    """
    mujoco = import_mujoco()
    model = mujoco.MjModel.from_xml_string(model_xml(_kicked(tower, disturbance_mm)))
    data = mujoco.MjData(model)
    rest_m = _heights_mm(tower)[-1] * 1e-3
    frames = int(seconds * frame_hz) + 1
    poses = np.empty((frames, len(tower.bodies), 7))
    fallen = False
    for frame in range(frames):
        due = round(frame / frame_hz / STEP_S) - round(data.time / STEP_S)
        if due > 0:
            mujoco.mj_step(model, data, nstep=due)
        mujoco.mj_kinematics(model, data)
        poses[frame, :, :3] = data.xpos[1:]
        poses[frame, :, 2] -= rest_m
        poses[frame, :, 3:] = data.xquat[1:]
        # A fixed body never tilts.
        upright = float((1.0 - 2.0 * (poses[frame, :, 4] ** 2 + poses[frame, :, 5] ** 2)).min())
        fallen = fallen or degrees(acos(max(-1.0, min(1.0, upright)))) > FALLEN_DEG
    names = tuple(body.name for body in tower.bodies)
    return fallen, Fall(np.arange(frames) / frame_hz, poses, names)


def contradicts_analysis(verdict: TowerVerdict, fallen: bool) -> bool:
    """Return True if MuJoCo contradicts the exact analysis beyond its own error.

    The error is 0.2 mm of margin, 0.25 mm for towers of three or more bodies.
    """
    band_mm = PAIR_BAND_MM if len(verdict.margins_mm) < 3 else TOWER_BAND_MM
    return fallen == verdict.stands and abs(verdict.margin_mm) > band_mm


def mujoco_available() -> bool:
    """Return True if the optional package is installed."""
    try:
        import_mujoco()
    except InputError:
        return False
    return True


def import_mujoco() -> Any:
    """Return the optional package; raises ``InputError`` if it is missing."""
    try:
        return import_module("mujoco")
    except ImportError as error:
        raise InputError(
            "The simulated release requires the package mujoco-core, which is not installed.",
            "optional extra 'mujoco'",
            'Install it with: pip install "touchdown[mujoco]".',
        ) from error


def _kicked(tower: Tower, disturbance_mm: Point) -> Tower:
    """Shift the centre of mass of the topmost body."""
    top = tower.bodies[-1]
    shift = rotated(np.asarray(disturbance_mm, dtype=np.float64), -top.yaw_rad)
    x, y = (np.asarray(top.com_xy_mm) + shift).tolist()
    return Tower((*tower.bodies[:-1], replace(top, com_xy_mm=(x, y))))


def _heights_mm(tower: Tower) -> list[float]:
    """Return the height of every body's lower face above the floor."""
    heights = [0.0]
    for body in tower.bodies[:-1]:
        heights.append(heights[-1] + body.height_mm)
    return heights


def model_xml(tower: Tower) -> str:
    """Return the MuJoCo model of a tower, in SI units."""
    meshes: list[str] = []
    bodies: list[str] = []
    for index, (body, height_mm) in enumerate(zip(tower.bodies, _heights_mm(tower), strict=True)):
        bodies.append(_body_xml(body, f"b{index}", height_mm, meshes))
    return (
        f"{HEADER}<asset>{''.join(meshes)}</asset><worldbody>"
        f'<geom type="plane" size="1 1 0.1"/>{"".join(bodies)}</worldbody></mujoco>'
    )


def _body_xml(body: Body, tag: str, height_mm: float, meshes: list[str]) -> str:
    at = format_metres(*body.at_mm, height_mm)
    quat = f"{cos(body.yaw_rad / 2)!r} 0 0 {sin(body.yaw_rad / 2)!r}"
    parts = [_rim_xml(body.lower, SPHERE_RADIUS_MM)]
    if body.upper is None or body.upper == body.lower:
        parts.append(shape_xml(body.lower, 0.0, body.height_mm, tag, meshes))
    else:
        half = body.height_mm / 2
        parts.append(shape_xml(body.lower, 0.0, half, f"{tag}l", meshes))
        parts.append(shape_xml(body.upper, half, body.height_mm, f"{tag}u", meshes))
    # Spheres at both ends keep a fallen body from sinking into the floor.
    parts.append(_rim_xml(body.upper or body.lower, body.height_mm - SPHERE_RADIUS_MM))
    free = "" if body.fixed else f"<freejoint/>{inertia_xml(body)}"
    return f'<body pos="{at}" quat="{quat}">{free}{"".join(parts)}</body>'


def format_metres(*lengths_mm: float) -> str:
    """Return lengths in SI units, separated by spaces."""
    return " ".join(repr(float(length) * 1e-3) for length in lengths_mm)


def inertia_xml(body: Body) -> str:
    """Return the inertia of a solid block, or cylinder, with the size of the lower outline."""
    mass = body.mass_g * 1e-3
    x, y = (extent * 1e-3 for extent in body.lower.half_extents_mm)
    share = 1 / 4 if body.lower.kind == "circle" else 1 / 3
    height2 = (body.height_mm * 1e-3) ** 2 / 12
    ix, iy, iz = share * y**2 + height2, share * x**2 + height2, share * (x**2 + y**2)
    at = format_metres(*body.com_xy_mm, body.com_height_mm)
    moments = " ".join(repr(mass * value) for value in (ix, iy, iz))
    return f'<inertial pos="{at}" mass="{mass!r}" diaginertia="{moments}"/>'


def shape_xml(outline: Outline, low_mm: float, high_mm: float, tag: str, meshes: list[str]) -> str:
    """Return the shape between two heights as cylinder, box, or prism mesh.

    A prism is added to ``meshes`` under the name ``tag``.
    """
    middle, half = (low_mm + high_mm) / 2, (high_mm - low_mm) / 2
    if outline.kind == "circle":
        size = format_metres(outline.radius_mm, half)
        return f'<geom type="cylinder" pos="{format_metres(0, 0, middle)}" size="{size}"/>'
    x, y = outline.half_extents_mm
    if {(abs(a), abs(b)) for a, b in outline.vertices_mm} == {(x, y)}:
        centre, size = format_metres(0, 0, middle), format_metres(x, y, half)
        return f'<geom type="box" pos="{centre}" size="{size}"/>'
    corners = " ".join(
        format_metres(a, b, height) for height in (low_mm, high_mm) for a, b in outline.vertices_mm
    )
    meshes.append(f'<mesh name="{tag}" vertex="{corners}"/>')
    return f'<geom type="mesh" mesh="{tag}"/>'


def _rim_xml(outline: Outline, height_mm: float) -> str:
    """Return the spheres along the outline."""
    return "".join(
        f'<geom class="rim" pos="{format_metres(x, y, height_mm)}"/>'
        for x, y in rim_points(outline)
    )


def rim_points(outline: Outline, count: int = SPHERES_PER_FACE) -> list[tuple[float, float]]:
    """Return the centres (mm) of about ``count`` rim spheres, one at each corner of a polygon."""
    corners = outline.polygon(count)
    per_side = max(1, round(count / len(corners)))
    ends = np.roll(corners, -1, axis=0)
    share = np.arange(per_side) / per_side
    points = corners[:, None] + share[:, None] * (ends - corners)[:, None]
    return [(float(x), float(y)) for x, y in points.reshape(-1, 2)]
