"""MuJoCo model of the piece on springs above its bottoms.

Robot and pads are joints with springs: three slides of the hand, then three slides and three hinges
of the piece in it, at the pivot ``G``. Faces touch at spheres along both rims, each with its own
spring, so that pressure is at the border of the overlap (on the bench: all over it). Friction is a
cone per sphere that creeps below its limit, with a torsional part. Free bottoms are free bodies.
After a press the model determines their sliding and whether they return: a body that leans on an
edge of its base returns if the common centre of mass of all it carries is on the inner side of that
edge. SI units inside; axes of ``O``, the board tilted about it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from touchdown.backend.config import SupportSettings
from touchdown.backend.core import FloatArray, rotation_from_quaternion
from touchdown.backend.geometry import FLAT, Outline, Piece, Surface, Tower
from touchdown.backend.simulation.conditions import Conditions
from touchdown.backend.simulation.release_mujoco import (
    EDGE_MM,
    format_metres,
    import_mujoco,
    inertia_xml,
    perimeter_mm,
    rim_points,
    shape_xml,
    surface_points,
    surface_prisms_xml,
)

STEP_S = 0.002
RIM_SPHERES, FOOT_SPHERES = 32, 16
SPHERE_MM = 0.05
# Rim stiffness per length over foundation stiffness per area [U]. 64 N/mm² at 20 N/mm³ makes a ring
# of 7.5 mm as stiff as a flat punch of that size on a half-space of 200 N/mm² (2 E a).
RIM_SHARE_MM = 3.2
# Common to all contacts. The contact stiffness is k IMPEDANCE / ((1 - IMPEDANCE) MOBILITY), where
# -k is the first number of solref (soft constraints of MuJoCo).
IMPEDANCE, MOBILITY_1_KG = 0.9, 1.0
TORSION_MM = 0.5  # lever of the friction torque of one sphere [U]
# Inertia of the hand and of the piece in the pads; negligible in a slow press.
HAND_KG, PAD_KG, PAD_KGM2 = 1.5, 0.5, 5e-4
PAD_DELAY_S = 0.06  # viscosity of the pads over their stiffness (Kelvin-Voigt) [U]
# Joints of the hand, then of the piece in it; the first of the model.
HAND_JOINTS, HELD_JOINTS = slice(0, 3), slice(3, 9)
SHELL_MM = 4.0  # height of the part of the piece that collides

HEADER = f"""
<mujoco>
  <compiler boundmass="0" boundinertia="0" angle="radian"/>
  <option timestep="{STEP_S}" integrator="implicitfast" solver="Newton" iterations="50"
          cone="elliptic" impratio="10" gravity="0 0 -9.80665"/>
  <default>
    <geom contype="1" conaffinity="2" mass="0"/>
    <default class="rim">
      <geom type="sphere" size="{SPHERE_MM * 1e-3}" contype="2" conaffinity="1" priority="1"
            condim="4" solimp="{IMPEDANCE} {IMPEDANCE} 0.001 0.5 2"/>
    </default>
  </default>
"""


@dataclass(frozen=True, slots=True)
class MountedPiece:
    """A compiled model and its state. ``free``: number of bottoms that move, its last bodies."""

    engine: Any
    model: Any
    data: Any
    free: int

    def wrench_g(self) -> FloatArray:
        """Return (6,) contact on the piece at ``G``, N and N·mm."""
        found = np.array(self.data.qfrc_constraint[HELD_JOINTS])
        found[3:] *= 1e3
        return found

    def held(self) -> FloatArray:
        """Return (6,) displacement of the piece in the hand at ``G``, mm and rad."""
        found = np.array(self.data.qpos[HELD_JOINTS])
        found[:3] *= 1e3
        return found


@dataclass(frozen=True, slots=True)
class _SphereContact:
    """Contact of the spheres of a face: friction, and equivalent foundation (N/mm³)."""

    mu: float
    foundation_n_mm3: float

    def rim_xml(
        self, outline: Outline, height_mm: float, count: int, surface: Surface = FLAT
    ) -> str:
        """Return spheres along ``outline`` with their centres at ``height_mm``.

        A surface that is not flat has them along its step and all over its dome as well.
        """
        points = [(x, y, 0.0) for x, y in rim_points(outline, count)]
        share_mm = perimeter_mm(outline) / len(points)
        if not surface.flat:
            points, share_mm = list(map(tuple, surface_points(outline, surface).tolist())), EDGE_MM
        stiffness_n_m = 1e3 * RIM_SHARE_MM * self.foundation_n_mm3 * share_mm
        k = stiffness_n_m * MOBILITY_1_KG * (1.0 - IMPEDANCE) / IMPEDANCE
        how = (
            f'solref="{-k!r} {-2.0 * k**0.5!r}" '
            f'friction="{self.mu!r} {self.mu * TORSION_MM * 1e-3!r} 0"'
        )
        return "".join(
            f'<geom class="rim" pos="{format_metres(x, y, height_mm + z)}" {how}/>'
            for x, y, z in points
        )


def build_model(
    piece: Piece,
    bottoms: Tower,
    conditions: Conditions,
    at_mm: FloatArray,
    support: SupportSettings,
) -> MountedPiece:
    """Return the piece under the one set of ``conditions`` at the true displacement ``at_mm`` (2,).

    With all joints at zero its face is at the height of the centre of the touched face. Raises
    ``InputError`` without MuJoCo.
    """
    mujoco = import_mujoco()
    meshes: list[str] = []
    stiff = float(conditions.foundation_n_mm3[0])
    face, foot = _SphereContact(float(conditions.mu[0]), stiff), _SphereContact(support.mu, stiff)
    tilt_rad = np.array([*-conditions.tilt_rad[0], 0.0])
    quat = f'quat="1 {float(tilt_rad[0]) / 2!r} {float(tilt_rad[1]) / 2!r} 0"'
    origin_mm = np.asarray(bottoms.bodies[-1].at_mm)
    height_mm = -sum(body.height_mm for body in bottoms.bodies)
    floor = f'<geom type="plane" size="1 1 .1" pos="{format_metres(0, 0, height_mm)}"/>'
    parts = [_hand_xml(piece, conditions, at_mm, face, meshes), f"<body {quat}>{floor}</body>"]
    free = 0
    for k, body in enumerate(bottoms.bodies):
        at = np.array([*(np.asarray(body.at_mm) - origin_mm), height_mm])
        at += np.cross(tilt_rad, at)
        moves = (support.rocks or support.slides) and not body.fixed
        free += moves
        joint = f"<freejoint/>{inertia_xml(body)}" if moves else ""
        upper = face if body is bottoms.bodies[-1] else foot
        outline = body.upper or body.lower
        if body.surface.flat:
            inside = shape_xml(outline, 0.0, body.height_mm, f"b{k}", meshes)
        else:
            inside = surface_prisms_xml(body, f"b{k}", meshes)
        inside += foot.rim_xml(body.lower, SPHERE_MM, FOOT_SPHERES)
        inside += upper.rim_xml(outline, body.height_mm - SPHERE_MM, RIM_SPHERES, body.surface)
        parts.append(f'<body pos="{format_metres(*at)}" {quat}>{joint}{inside}</body>')
        height_mm += body.height_mm
    model = mujoco.MjModel.from_xml_string(
        f"{HEADER}<asset>{''.join(meshes)}</asset><worldbody>{''.join(parts)}</worldbody></mujoco>"
    )
    model.body_invweight0[:, 0] = 0.5 * MOBILITY_1_KG
    moving = model.dof_armature[HELD_JOINTS.stop :].reshape(free, 6)
    moving[:, :3], moving[:, 3:] = PAD_KG, PAD_KGM2
    return MountedPiece(mujoco, model, mujoco.MjData(model), free)


def pad_stiffness(conditions: Conditions) -> FloatArray:
    """Return (6,) N/m and N·m/rad of both pads together at ``G``, unstrained."""
    shear, normal = float(conditions.shear_n_mm[0]), float(conditions.normal_n_mm[0])
    torsion, lever = float(conditions.torsion_nmm[0]), 0.5 * float(conditions.width_mm[0])
    rocking = shear * lever**2
    both = np.array([shear, normal, shear, 1e-6 * rocking, 1e-6 * torsion, 1e-6 * rocking])
    return np.asarray(2e3 * both, dtype=np.float64)


def _hand_xml(
    piece: Piece, conditions: Conditions, at_mm: FloatArray, face: _SphereContact, meshes: list[str]
) -> str:
    """Return hand and piece with origin at the pivot; the face is rotated in the hand."""
    g_x, g_z = (float(g) for g in conditions.grasp_offset_mm[0])
    low_mm = -float(conditions.grip_height_mm[0]) - g_z
    half_yaw = 0.5 * float(conditions.yaw_rad[0])
    robot, pads = 1e3 * conditions.robot_n_mm[0], pad_stiffness(conditions)
    hand = _joints("slide", robot, 2.0 * np.sqrt(robot * HAND_KG), 0.0)
    held = _joints("slide", pads[:3], PAD_DELAY_S * pads[:3], PAD_KG)
    held += _joints("hinge", pads[3:], PAD_DELAY_S * pads[3:], PAD_KGM2)
    return (
        f'<body pos="{format_metres(at_mm[0] + g_x, at_mm[1], -low_mm)}" gravcomp="1">{hand}'
        f'<inertial pos="0 0 0" mass="{HAND_KG}" diaginertia=".01 .01 .01"/>'
        f'<body gravcomp="1">{held}<inertial pos="0 0 0" mass="{1e-3 * piece.mass_g!r}" '
        'diaginertia="1e-6 1e-6 1e-6"/>'
        f'<body pos="{format_metres(-g_x, 0.0, 0.0)}" quat="1 0 0 {half_yaw!r}">'
        f"{shape_xml(piece.face, low_mm, low_mm + SHELL_MM, 'piece', meshes)}"
        f"{face.rim_xml(piece.face, low_mm + SPHERE_MM, RIM_SPHERES)}</body></body></body>"
    )


def _joints(kind: str, stiffness: FloatArray, damping: FloatArray, armature: float) -> str:
    return "".join(
        f'<joint type="{kind}" axis="{axis}" stiffness="{k!r}" damping="{c!r}" '
        f'armature="{armature}"/>'
        for axis, k, c in zip(
            ("1 0 0", "0 1 0", "0 0 1"), stiffness.tolist(), damping.tolist(), strict=True
        )
    )


UPRIGHT_RAD = 1e-3  # A body tilted by less than this stands flat
FREE_BODY_QPOS = 7  # position values of a free body: metres, quaternion


def bottoms_after_press(mounted: MountedPiece, bottoms: Tower) -> tuple[FloatArray, bool]:
    """Return the sliding of each free bottom (m, 2) in mm, and True if one falls.

    ``bottoms``: the mounted tower.
    """
    model, data, free = mounted.model, mounted.data, mounted.free
    first = len(bottoms.bodies) - free
    slides = np.zeros((free, 2))
    falls = False
    below_now = below_then = np.zeros(2)
    bodies = range(model.nbody - free, model.nbody)
    for k, number in enumerate(bodies):
        then = model.qpos0[HELD_JOINTS.stop + FREE_BODY_QPOS * k :][:3]
        board = rotation_from_quaternion(model.body_quat[number])
        now = rotation_from_quaternion(data.xquat[number])
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
