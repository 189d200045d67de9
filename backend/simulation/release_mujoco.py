"""Release of a tower simulated with MuJoCo, as a second opinion and for the animation of a fall.

Optional. Shapes do not collide with each other. Each flat face has tiny massless spheres along its
outline, tangent to the face from inside, and only spheres collide with shapes. The built-in contact
of cylinders (MuJoCo 4.0) misplaces the toppling edge by up to 1.3 mm at a radius of 7.5 mm; this
model by 0.06 mm. A face with holes or several parts is a set of convex prisms, and has spheres at
the corners of its contact as well, where two outlines cross. A face that is not flat is made of
convex prisms and has spheres of its own; until the fingers are open (GUIDED_S) the piece turns
against a viscous drag. It never replaces the exact analysis of ``geometry.tower``.
"""

from __future__ import annotations

from dataclasses import replace
from math import acos, cos, degrees, sin
from typing import Any

import numpy as np

from touchdown.backend import geometry
from touchdown.backend.core import Fall, FloatArray, InputError, require_package

SPHERES_PER_FACE = 32
SPHERE_RADIUS_MM = 0.05
FALLEN_DEG = 12.0  # A body tilted by more has fallen
AT_REST_DEG = 5.0  # and one that ends tilted by more
SUNK_MM = 1.0  # and one that sank by more, such as feet between feet
APART_MM = 0.3  # spheres at the corners of a contact are not nearer to each other
CORNER_RAD = 0.35  # rings of a region turn by more at a corner

PAIR_BAND_MM = 0.2
TOWER_BAND_MM = 0.25
STEP_S = 0.001
GUIDED_S = 0.7  # the opening fingers guide a piece on a face that is not flat
GUIDE_MM = 10.0  # lever of its weight that turns it by 1 rad/s meanwhile
EDGE_MM = 1.0  # spacing of the spheres along the edges of such a face

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
    tower: geometry.Tower,
    seconds: float = 1.5,
    frame_hz: float = 60.0,
    disturbance_mm: geometry.Point = (0.0, 0.0),
) -> tuple[bool, Fall]:
    """Simulate the release of a tower for ``seconds``.

    ``disturbance_mm``: effect of the opening fingers, as in ``judge_tower``. Returns True if a free
    body tilted by more than 12 degrees, or ends tilted by more than 5 or lower by more than 1 mm,
    and the motion at ``frame_hz``: per body the centre of its lower face (m; z = 0 at the base of
    the topmost body) and quaternion. Raises ``InputError`` without MuJoCo.
    """
    mujoco = import_mujoco()
    model = mujoco.MjModel.from_xml_string(model_xml(_kicked(tower, disturbance_mm)))
    data = mujoco.MjData(model)
    rest_m = _heights_mm(tower)[-1] * 1e-3
    frames = int(seconds * frame_hz) + 1
    poses = np.empty((frames, len(tower.bodies), 7))
    fallen = False
    relief_mm = float(np.ptp(_touchable_mm(tower)[:, 2]))
    for frame in range(frames):
        if frame / frame_hz > GUIDED_S:
            model.dof_damping[:] = 0.0
        due = round(frame / frame_hz / STEP_S) - round(data.time / STEP_S)
        if due > 0:
            mujoco.mj_step(model, data, nstep=due)
        mujoco.mj_kinematics(model, data)
        poses[frame, :, :3] = data.xpos[1:]
        poses[frame, :, 2] -= rest_m
        poses[frame, :, 3:] = data.xquat[1:]
        # A fixed body never tilts.
        upright = float((1.0 - 2.0 * (poses[frame, :, 4] ** 2 + poses[frame, :, 5] ** 2)).min())
        tilt_deg = degrees(acos(max(-1.0, min(1.0, upright))))
        fallen = fallen or tilt_deg > FALLEN_DEG
    names = tuple(body.name for body in tower.bodies)
    sunk_mm = 1e3 * float((poses[0, :, 2] - poses[-1, :, 2]).max())
    fallen = fallen or tilt_deg > AT_REST_DEG or sunk_mm > SUNK_MM + relief_mm
    return fallen, Fall(np.arange(frames) / frame_hz, poses, names)


def contradicts_analysis(verdict: geometry.TowerVerdict, fallen: bool) -> bool:
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
    return require_package("mujoco", "mujoco", "mujoco-core")


def _kicked(tower: geometry.Tower, disturbance_mm: geometry.Point) -> geometry.Tower:
    top = tower.bodies[-1]
    shift = geometry.rotated(np.asarray(disturbance_mm, dtype=np.float64), -top.yaw_rad)
    x, y = (np.asarray(top.com_xy_mm) + shift).tolist()
    return geometry.Tower((*tower.bodies[:-1], replace(top, com_xy_mm=(x, y))))


def _heights_mm(tower: geometry.Tower) -> list[float]:
    """Return the height of every body's lower face above the floor, at first touch."""
    heights = [0.0]
    for body in tower.bodies[:-1]:
        heights.append(heights[-1] + body.height_mm)
    heights[-1] += float(_touchable_mm(tower)[:, 2].max())
    return heights


def _touchable_mm(tower: geometry.Tower) -> FloatArray:
    """Return the points (n, 3) that the topmost body can touch; on a flat face the centre."""
    if len(tower.bodies) > 1 and not tower.bodies[-2].surface.flat:
        placed = geometry.piece_on_surface(tower)
        if len(placed.points_mm):
            return np.column_stack([placed.points_mm, placed.heights_mm])
    return np.zeros((1, 3))


def model_xml(tower: geometry.Tower) -> str:
    """Return the MuJoCo model of a tower, in SI units."""
    meshes: list[str] = []
    bodies: list[str] = []
    for index, (body, height_mm) in enumerate(zip(tower.bodies, _heights_mm(tower), strict=True)):
        below = tower.bodies[index - 1] if index else None
        bodies.append(_body_xml(body, below, f"b{index}", height_mm, meshes))
    return (
        f"{HEADER}<asset>{''.join(meshes)}</asset><worldbody>"
        f'<geom type="plane" size="1 1 0.1"/>{"".join(bodies)}</worldbody></mujoco>'
    )


def _body_xml(
    body: geometry.Body, below: geometry.Body | None, tag: str, height_mm: float, meshes: list[str]
) -> str:
    at = format_metres(*body.at_mm, height_mm)
    quat = f"{cos(body.yaw_rad / 2)!r} 0 0 {sin(body.yaw_rad / 2)!r}"
    parts = [_spheres_xml(rim_points(body.lower), SPHERE_RADIUS_MM)]
    if below is not None and below.upper is not None:
        parts.append(_spheres_xml(contact_corners(body, below), SPHERE_RADIUS_MM))
    if body.upper is not None and not body.surface.flat:
        parts.append(shape_xml(body.lower, 0.0, body.height_mm / 2, f"{tag}l", meshes))
        parts.append(surface_prisms_xml(body, tag, meshes))
        parts += [
            _spheres_xml([(x, y)], body.height_mm + z - SPHERE_RADIUS_MM)
            for x, y, z in surface_points(body.upper, body.surface).tolist()
        ]
    elif body.upper is None or body.upper == body.lower:
        parts.append(shape_xml(body.lower, 0.0, body.height_mm, tag, meshes))
    else:
        half = body.height_mm / 2
        parts.append(shape_xml(body.lower, 0.0, half, f"{tag}l", meshes))
        parts.append(shape_xml(body.upper, half, body.height_mm, f"{tag}u", meshes))
    # Spheres at both ends keep a fallen body from sinking into the floor.
    if body.surface.flat:
        end = rim_points(body.upper or body.lower)
        parts.append(_spheres_xml(end, body.height_mm - SPHERE_RADIUS_MM))
    guide = 0.0
    if below is not None and not below.surface.flat:
        guide = 1e-6 * 9.81 * body.mass_g * GUIDE_MM
    joint = f'<joint type="free" damping="{guide!r}"/>'
    free = "" if body.fixed else f"{joint if guide else '<freejoint/>'}{inertia_xml(body)}"
    return f'<body pos="{at}" quat="{quat}">{free}{"".join(parts)}</body>'


def surface_points(outline: geometry.Outline, surface: geometry.Surface) -> FloatArray:
    """Return the points (n, 3) that stand for a face that is not flat: edges, and a dome."""
    found = []
    for part, lift_mm in geometry.step_levels(geometry.geometry_of(outline), surface):
        points, heights = _on_level(part, surface)
        found.append(np.column_stack([points, heights + lift_mm]))
    return np.concatenate(found)


def _on_level(part: Any, surface: geometry.Surface) -> tuple[FloatArray, FloatArray]:
    points = geometry.spread_points(part, EDGE_MM, inside=bool(surface.dome_mm))
    return points, replace(surface, step_mm=0.0).heights_mm(points)


def surface_prisms_xml(body: geometry.Body, tag: str, meshes: list[str]) -> str:
    """Return the upper half of a body whose upper face is not flat, as prisms.

    They are added to ``meshes`` under names that begin with ``tag``.
    """
    assert body.upper is not None
    geoms = []
    for number, cell in enumerate(geometry.convex_cells(body.upper)):
        for part, lift_mm in geometry.step_levels(geometry.polygon_of(cell), body.surface):
            top, heights = _on_level(part, body.surface)
            if not len(top):
                continue
            ends = np.full(len(top), body.height_mm / 2), body.height_mm + heights + lift_mm
            corners = np.concatenate([np.column_stack([top, end]) for end in ends]).tolist()
            name = f"{tag}u{number}{'h' if lift_mm else ''}"
            places = " ".join(format_metres(*corner) for corner in corners)
            meshes.append(f'<mesh name="{name}" vertex="{places}"/>')
            geoms.append(f'<geom type="mesh" mesh="{name}"/>')
    return "".join(geoms)


def format_metres(*lengths_mm: float) -> str:
    """Return lengths in SI units, separated by spaces."""
    return " ".join(repr(float(length) * 1e-3) for length in lengths_mm)


def inertia_xml(body: geometry.Body) -> str:
    """Return the inertia of a solid block, or cylinder, with the size of the lower outline."""
    mass = body.mass_g * 1e-3
    x, y = (extent * 1e-3 for extent in body.lower.half_extents_mm)
    share = 1 / 4 if body.lower.kind == "circle" else 1 / 3
    height2 = (body.height_mm * 1e-3) ** 2 / 12
    ix, iy, iz = share * y**2 + height2, share * x**2 + height2, share * (x**2 + y**2)
    at = format_metres(*body.com_xy_mm, body.com_height_mm)
    moments = " ".join(repr(mass * value) for value in (ix, iy, iz))
    return f'<inertial pos="{at}" mass="{mass!r}" diaginertia="{moments}"/>'


def shape_xml(
    outline: geometry.Outline, low_mm: float, high_mm: float, tag: str, meshes: list[str]
) -> str:
    """Return the shape between two heights as cylinder, box, or prism meshes.

    Prisms are added to ``meshes`` under names that begin with ``tag``.
    """
    middle, half = (low_mm + high_mm) / 2, (high_mm - low_mm) / 2
    if outline.kind == "circle":
        size = format_metres(outline.radius_mm, half)
        return f'<geom type="cylinder" pos="{format_metres(0, 0, middle)}" size="{size}"/>'
    x, y = outline.half_extents_mm
    if {(abs(a), abs(b)) for a, b in outline.vertices_mm} == {(x, y)}:
        centre, size = format_metres(0, 0, middle), format_metres(x, y, half)
        return f'<geom type="box" pos="{centre}" size="{size}"/>'
    geoms = []
    for number, cell in enumerate(geometry.convex_cells(outline)):
        name = f"{tag}_{number}" if number else tag
        corners = " ".join(
            format_metres(a, b, height) for height in (low_mm, high_mm) for a, b in cell.tolist()
        )
        meshes.append(f'<mesh name="{name}" vertex="{corners}"/>')
        geoms.append(f'<geom type="mesh" mesh="{name}"/>')
    return "".join(geoms)


def _spheres_xml(points_mm: list[geometry.Point], height_mm: float) -> str:
    return "".join(
        f'<geom class="rim" pos="{format_metres(x, y, height_mm)}"/>' for x, y in points_mm
    )


def contact_corners(body: geometry.Body, below: geometry.Body) -> list[geometry.Point]:
    """Return the corners (mm, in the frame of ``body``) of its contact with ``below``.

    Empty for two convex faces, whose rims are near enough to all corners of the contact.
    """
    assert below.upper is not None
    if "region" not in (body.lower.kind, below.upper.kind):
        return []
    away = np.subtract(body.at_mm, below.at_mm)
    at = geometry.rotated(away, -below.yaw_rad)
    turn = body.yaw_rad - below.yaw_rad
    path = geometry.overlap_polygon(body.lower, (float(at[0]), float(at[1])), below.upper, turn)
    kept: list[geometry.Point] = []
    for x, y in geometry.rotated(
        np.concatenate([np.empty((0, 2)), *geometry.rings_of(path)]) - at, -turn
    ).tolist():
        if all(abs(x - a) + abs(y - b) > APART_MM for a, b in kept):
            kept.append((x, y))
    return kept


def rim_points(outline: geometry.Outline, count: int = SPHERES_PER_FACE) -> list[geometry.Point]:
    """Return the centres (mm) of about ``count`` rim spheres, one at each corner of a polygon.

    Those of a region lie on all its rings, which may need more of them.
    """
    if outline.kind == "region":
        return _ring_points(outline, count)
    corners = outline.polygon(count)
    per_side = max(1, round(count / len(corners)))
    ends = np.roll(corners, -1, axis=0)
    share = np.arange(per_side) / per_side
    points = corners[:, None] + share[:, None] * (ends - corners)[:, None]
    return [(float(x), float(y)) for x, y in points.reshape(-1, 2)]


def _ring_points(outline: geometry.Outline, count: int) -> list[geometry.Point]:
    rings = [np.array(ring) for ring in outline.rings]
    spacing = perimeter_mm(outline) / count
    found: list[geometry.Point] = []
    for ring in rings:
        along = np.roll(ring, -1, axis=0) - ring
        bearing = np.arctan2(along[:, 1], along[:, 0])
        turn = np.abs(np.angle(np.exp(1j * (bearing - np.roll(bearing, 1)))))
        length = np.concatenate([[0.0], np.cumsum(np.hypot(along[:, 0], along[:, 1]))])
        # Even places, and all corners.
        places = np.arange(0.0, length[-1], spacing)
        places = np.union1d(places, length[:-1][turn > CORNER_RAD])
        closed = np.concatenate([ring, ring[:1]])
        x, y = (np.interp(places, length, closed[:, k]) for k in range(2))
        found += zip(x.tolist(), y.tolist(), strict=True)
    return found


def perimeter_mm(outline: geometry.Outline) -> float:
    """Return the length of all edges of an outline; a circle counts as a polygon."""
    rings = [np.array(ring) for ring in outline.rings] or [outline.polygon()]
    return float(sum(np.hypot(*(np.roll(ring, -1, axis=0) - ring).T).sum() for ring in rings))
