"""Finite-element gel of one sensor, condensed to the disc that presses on it.

The gel is a small-strain linear-elastic block, glued to the glass at its back and free at its
sides, meshed with quadratic hexahedra (scikit-fem). A rigid flat disc, the side of the gripped
piece, touches it with unilateral contact and Coulomb friction at each node. The block is assembled
and factorised once; a dense stiffness of the nodes under the disc remains. Axes x and z of the hand
along the surface, then into the gel; mm and N.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.interpolate import make_interp_spline
from scipy.optimize import brentq
from scipy.sparse.linalg import splu

from touchdown.backend.config import ProbeSettings
from touchdown.backend.core import GRID_COLS, GRID_ROWS, MARKERS, FloatArray, require_package
from touchdown.backend.simulation.conditions import Conditions
from touchdown.backend.simulation.ground_truth import Scene
from touchdown.backend.simulation.marker_fields import Gel
from touchdown.backend.simulation.second_world.trials import DescentRecord, SecondWorldTrials


@dataclass(frozen=True, slots=True)
class GelShape:
    """Block of gel and its mesh; sizes of a GelSight Mini.

    ``size_mm`` along x and z. ``disc_mm``: radius of the disc, in the middle [U]. Elements:
    ``across`` the disc, ``around`` it to each side, and ``layers``.
    """

    size_mm: tuple[float, float] = (25.0, 19.0)
    thickness_mm: float = 4.0
    poisson: float = 0.48
    disc_mm: float = 5.0
    across: int = 6
    around: int = 4
    layers: int = 3


@dataclass(frozen=True, slots=True)
class CondensedGel:
    """Gel with a shear modulus of 1 N/mm², as felt by the disc.

    ``at_mm`` (n, 2): nodes under the disc. ``stiffness_n_mm`` (3 n, 3 n): forces on them for their
    displacements. ``shown`` (2 m, 3 n): displacement of m points of the surface for that of the
    nodes.
    """

    at_mm: FloatArray
    stiffness_n_mm: FloatArray
    shown: FloatArray


def import_skfem() -> Any:
    """Return the optional package; raises ``InputError`` if it is missing."""
    return require_package("skfem", "dev", "scikit-fem")


def _graded(length_mm: float, count: int, first_mm: float) -> FloatArray:
    """Return the ends (count,) of elements that grow geometrically from ``first_mm``."""
    share = np.arange(1, count + 1) / count
    if count * first_mm >= length_mm:
        return np.asarray(length_mm * share)
    rate = brentq(lambda r: length_mm * np.expm1(r / count) / np.expm1(r) - first_mm, 1e-6, 100.0)
    return np.asarray(length_mm * np.expm1(rate * share) / np.expm1(rate))


def _mesh(shape: GelShape) -> Any:
    """Return hexahedra, finest at the edge of the disc, which they follow."""
    half_mm = 0.5 * np.array(shape.size_mm)
    inner = shape.disc_mm * np.sin(0.5 * np.pi * np.linspace(-1.0, 1.0, shape.across + 1))
    finest = inner[1] - inner[0]
    outer = [shape.disc_mm + _graded(h - shape.disc_mm, shape.around, finest) for h in half_mm]
    mesh = import_skfem().MeshHex.init_tensor(
        *(np.concatenate([-lines[::-1], inner, lines]) for lines in outer),
        np.append(0.0, _graded(shape.thickness_mm, shape.layers, finest)),
    )
    # Squares around the centre become circles, entirely so at the edge of the disc.
    points = mesh.p.copy()
    square = np.maximum(np.abs(points[0]), np.abs(points[1]))
    far = (half_mm.min() - square) / (half_mm.min() - shape.disc_mm)
    share = np.clip(np.minimum(square / shape.disc_mm, far), 0.0, 1.0)
    radius = np.maximum(np.hypot(points[0], points[1]), 1e-12)
    points[:2] *= 1.0 + share * (square / radius - 1.0)
    return type(mesh)(points, mesh.t)


def assemble_stiffness(shape: GelShape) -> tuple[Any, sparse.csc_array]:
    """Return the basis of one component, and the stiffness for a shear modulus of 1 N/mm².

    The matrix has a block for each axis. Raises ``InputError`` without scikit-fem.
    """
    fem = import_skfem()
    basis = fem.Basis(_mesh(shape), fem.ElementHex2(), intorder=4)
    slopes = [
        [fem.BilinearForm(lambda u, v, _, i=i, j=j: u.grad[i] * v.grad[j]).assemble(basis)
         for i in range(3)] for j in range(3)
    ]  # fmt: skip
    laplace = slopes[0][0] + slopes[1][1] + slopes[2][2]
    lame = 2.0 * shape.poisson / (1.0 - 2.0 * shape.poisson)
    blocks = [
        [lame * slopes[j][i] + slopes[i][j] + (i == j) * laplace for i in range(3)]
        for j in range(3)
    ]
    return basis, sparse.csc_array(sparse.block_array(blocks))


def condense_gel(shape: GelShape, points_mm: FloatArray) -> CondensedGel:
    """Return the gel with all nodes eliminated but those under the disc.

    ``points_mm`` (m, 2): points of the surface that are shown. Raises ``InputError`` without
    scikit-fem.
    """
    basis, whole = assemble_stiffness(shape)
    count, (x, z, deep) = basis.N, basis.doflocs
    nodes = np.flatnonzero((deep < 1e-9) & (np.hypot(x, z) < shape.disc_mm * (1.0 + 1e-9)))
    touched = (nodes[:, None] + count * np.arange(3)).ravel()
    held = np.tile(deep > shape.thickness_mm - 1e-9, 3)
    held[touched] = True
    free = np.flatnonzero(~held)
    coupling = whole[free][:, touched].toarray()
    factors = splu(whole[free][:, free], permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
                   options={"SymmetricMode": True})  # fmt: skip
    follow = -factors.solve(coupling)
    stiffness = whole[touched][:, touched].toarray() + coupling.T @ follow
    moved = np.zeros((3 * count, len(touched)))
    moved[free] = follow
    moved[touched, np.arange(len(touched))] = 1.0
    probes = basis.probes(np.vstack([points_mm.T, np.zeros(len(points_mm))]))
    shown = np.stack([probes @ moved[k * count : (k + 1) * count] for k in range(2)], axis=1)
    return CondensedGel(
        np.stack([x, z], axis=1)[nodes],
        0.5 * (stiffness + stiffness.T),
        shown.reshape(-1, len(touched)),
    )


ITERATIONS = 60  # at most, in one step
SOLVED_N = 1e-5  # largest imbalance of a node in a solved step


class DiscContact:
    """Rigid flat disc on the gel: unilateral contact, Coulomb friction, memory of slip.

    ``force_n`` (n, 3): on the nodes of the gel. ``slip_mm`` (n, 3): of the nodes relative to the
    disc. ``depth_mm``: of the disc in the gel. ``solved``: all steps so far have converged.
    ``mu``: friction between gel and disc.
    """

    def __init__(self, gel: CondensedGel, modulus_n_mm2: float, mu: float) -> None:
        count = len(gel.at_mm)
        self._gel, self._mu = gel, mu
        self._stiffness = modulus_n_mm2 * gel.stiffness_n_mm
        self._penalty = float(np.diag(self._stiffness).mean())
        self._down = np.tile([0.0, 0.0, 1.0], count)
        self._pushed = self._stiffness @ self._down
        self.depth_mm = 0.0
        self.slip_mm = np.zeros((count, 3))
        self.force_n = np.zeros((count, 3))
        self.solved = True

    def follow(self, motion: FloatArray, normal_n: float) -> FloatArray:
        """Move the disc, parallel to the gel and pressed with ``normal_n``.

        ``motion`` (3,): along x and z in mm and rotation in rad, since the first touch. Returns the
        displacement (2 m,) of the points of the gel. Solved by a semi-smooth Newton method on the
        nodes that slip or are lifted (Alart and Curnier 1991).
        """
        x, z = self._gel.at_mm.T
        rigid = np.stack([motion[0] + motion[2] * z, motion[1] - motion[2] * x, 0.0 * x], axis=1)
        before, slip = self.slip_mm, self.slip_mm.copy()
        for _ in range(ITERATIONS):
            force = self._force(rigid + slip)
            lifted, slips, error = self._states(force, slip - before)
            if max(abs(normal_n - force[:, 2].sum()), np.abs(error).max()) < SOLVED_N:
                break
            slip = np.where((slips | lifted)[:, None], slip, before)
            slip[~lifted, 2] = 0.0
            active = np.repeat(lifted[:, None], 3, axis=1)
            active[slips, :2] = True
            force = self._force(rigid + slip)
            error, slope = self._linearised(force, slip - before, active, slips)
            step = np.linalg.solve(slope, np.append(-error, normal_n - force[:, 2].sum()))
            slip[active] += step[:-1]
            self.depth_mm += float(step[-1])
        else:
            self.solved = False
        self.force_n, self.slip_mm = force, slip
        moved = (rigid + slip).ravel() + self.depth_mm * self._down
        return np.asarray(self._gel.shown @ moved, dtype=np.float64)

    def _force(self, moved: FloatArray) -> FloatArray:
        force = self._stiffness @ moved.ravel() + self.depth_mm * self._pushed
        return np.asarray(force.reshape(-1, 3))

    def _states(
        self, force: FloatArray, slid: FloatArray
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_], FloatArray]:
        """Return the nodes that are lifted, those that slip, and the errors of all laws (n, 3)."""
        wanted = force - self._penalty * slid
        lifted = wanted[:, 2] < 0.0
        wanted[lifted, 2] = 0.0
        limit, pull = self._mu * wanted[:, 2], np.hypot(*wanted[:, :2].T)
        slips = ~lifted & (pull > limit)
        wanted[:, :2] *= np.minimum(1.0, limit / np.maximum(pull, 1e-12))[:, None]
        return lifted, slips, force - wanted

    def _linearised(
        self,
        force: FloatArray,
        slid: FloatArray,
        active: NDArray[np.bool_],
        slips: NDArray[np.bool_],
    ) -> tuple[FloatArray, FloatArray]:
        """Return errors (k,) of the active components, and slopes (k + 1, k + 1).

        Columns: the active components, then the depth. The last row is the normal force.
        """
        columns = np.column_stack([self._stiffness[:, active.ravel()], self._pushed])
        moves = np.zeros_like(columns)
        moves[np.flatnonzero(active), np.arange(active.sum())] = self._penalty
        columns, moves = (each.reshape(*force.shape, -1) for each in (columns, moves))
        pull = force[slips, :2] - self._penalty * slid[slips, :2]
        size = np.maximum(np.linalg.norm(pull, axis=1), 1e-12)[:, None]
        along = pull / size
        bound = self._mu * force[slips, 2:]
        error, slope = force.copy(), columns.copy()
        error[slips, :2] -= bound * along
        # The limit grows with the normal force, and its direction turns with the pull.
        turn = np.eye(2) - along[:, :, None] * along[:, None, :]
        turned = turn @ (columns[slips, :2] - moves[slips, :2])
        slope[slips, :2] -= self._mu * along[:, :, None] * columns[slips, 2:]
        slope[slips, :2] -= (bound / size)[:, None] * turned
        return error[active], np.vstack([slope[active], columns[:, 2].sum(axis=0)])


STEP_S = 0.05  # between two solutions of the gel; the markers are interpolated
LEAST_NORMAL_N = 0.1  # a pad that lifts off keeps this force
TO_IMAGE = np.array([[[1.0, -1.0]], [[-1.0, -1.0]]])  # of x and z, by finger


@cache
def marker_gels(
    mm_per_px: tuple[float, float], pitch_mm: float, shape: GelShape = GelShape()
) -> tuple[CondensedGel, CondensedGel]:
    """Return the gels of both fingers; the points are the markers, in px of the image.

    Marker order and image axes of ``build_gel``. Raises ``InputError`` without scikit-fem.
    """
    row, column = np.divmod(np.arange(MARKERS), GRID_COLS)
    x = (column - GRID_COLS // 2) * pitch_mm
    z = (GRID_ROWS // 2 - row) * pitch_mm
    gel = condense_gel(shape, np.stack([np.append(x, -x), np.append(z, z)], axis=1))
    shown = gel.shown.reshape(2, MARKERS, 2, -1)
    left, right = shown / np.reshape(mm_per_px, (2, 1, 1, 1)) * TO_IMAGE[..., None]
    rows = (2 * MARKERS, -1)
    return replace(gel, shown=left.reshape(rows)), replace(gel, shown=right.reshape(rows))


class FiniteGelTrials(SecondWorldTrials):
    """The second world with the finite-element gel.

    The modulus makes the gel as stiff in shear as the pad. Each press begins with a fresh contact
    under the grip force. Nodes slip by Coulomb's law; the creep of the whole piece along the pad
    stays that of ``CreepingPads``.
    """

    saturates = False

    def __init__(self, scenes: Sequence[Scene], probe: ProbeSettings | None = None) -> None:
        super().__init__(scenes, probe)
        tactile = self._first.settings.tactile
        self._gels = marker_gels(tactile.mm_per_px, tactile.pitch_mm)
        self._gel = Gel(np.stack([np.eye(2 * MARKERS)] * 2), self._gel.rest_px)

    def _shown(self, record: DescentRecord, conditions: Conditions) -> DescentRecord:
        """Return the record with marker displacements (M, 6 + 2 * 126) in place of strains."""
        stride = max(1, round(STEP_S / float(np.diff(record.t_s).mean())))
        steps = np.unique(np.append(np.arange(0, len(record.t_s), stride), len(record.t_s) - 1))
        fields, air, settled = [record.values[:, :6]], [record.air[:6]], record.settled
        for finger, gel in enumerate(self._gels):
            modulus = float(conditions.shear_n_mm[0]) / float(gel.stiffness_n_mm[::3, ::3].sum())
            contact = DiscContact(gel, modulus, float(conditions.mu_grip[0]))
            strain = record.values[:, 6 + 3 * finger : 9 + 3 * finger]
            normal = np.maximum(record.values[:, 12 + finger], LEAST_NORMAL_N)
            air.append(contact.follow(np.zeros(3), float(conditions.grip_force_n[0])))
            found = np.stack([contact.follow(strain[k], float(normal[k])) for k in steps])
            fields.append(make_interp_spline(record.t_s[steps], found, k=1)(record.t_s))
            settled &= contact.solved
        return replace(record, values=np.hstack(fields), air=np.concatenate(air), settled=settled)
