"""The piece between the fingers: contact with the bottom, slip in the grasp, what it weighs.

Wraps the batched mechanics for a single piece over many probes: nuisances are drawn for the
mounting, for every gripping and for every probe; slip and gel state are carried from probe to
probe until the jaws open.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from backend.config.method import ProbeSettings
from backend.core.flow import FloatArray
from backend.objects.surface import face_points
from backend.objects.tower import Tower
from backend.simulation import mechanics
from backend.simulation.conditions import Conditions, true_offset_mm
from backend.simulation.nuisance import (
    Mounting,
    Scope,
    conditions_of,
    draw_gripping,
    draw_mounting,
    draw_probe,
    generator,
)
from backend.simulation.scene import Scene
from backend.simulation.support import slid, stand_of
from backend.simulation.timeline import VALUES, packed
from backend.simulation.wrench import held_piece

NEAR_MM = 1.0
"""Below this height over first touch the contact is solved; above it the piece is in air."""


class Holding:
    """One gripping of the piece. Positions are commands of ``G`` (3,), mm in ``O``."""

    def __init__(
        self, scene: Scene, grip: int, force_n: float, bottoms: Tower | None = None
    ) -> None:
        """``grip``: number of this gripping; ``force_n``: what was asked of each finger.

        ``bottoms``: those of the scene, where they have slid to by now.
        """
        self._scene, self._grip = scene, grip
        self._bottoms = bottoms or scene.bottoms
        self.mounting = mounting_of(scene)
        rng = generator(scene.seed, Scope.GRIPPING, scene.mounting, grip)
        self.gripping = draw_gripping(scene.settings, force_n, rng)
        self.probe = 0
        self.conditions = self._draw(ProbeSettings())
        self._points_mm = face_points(scene.piece.face, scene.settings.face.lattice_mm)
        self._state: mechanics.ContactState | None = None
        self._base_mm = np.zeros(2)
        self._fresh = True
        self.air = np.zeros(VALUES)
        self.air[12:] = self.gripping.grip_force_n
        self._values = self.air
        self.weight = held_piece(
            scene.piece.mass_g,
            (*scene.piece.com_xy_mm, scene.piece.com_height_mm),
            scene.grip_height_mm,
            self.gripping.grasp_offset_mm,
        )
        self.weight_g = self.weight.wrench_g()
        """(6,) weight of the piece at ``G``, N and N·mm."""
        self.sensed = False
        """Whether the sensor errors of the probe apply: from its press until it is lifted off."""
        self._lowered = False

    def begin_probe(self, probe: ProbeSettings) -> None:
        """Draw the nuisances of the next probe; they hold until the one after it."""
        self.probe += 1
        self.conditions = self._draw(probe)
        self.sensed = True
        self._fresh = True

    def solve(self, command_mm: FloatArray, dt_s: float) -> FloatArray:
        """Return (14,) of a timeline: contact wrench at ``G``, gel strain, pad forces."""
        height = command_mm[2] - self.touch_height_mm
        near = bool(height <= NEAR_MM)
        if near:
            self._lowered = True
        elif self._lowered:
            self.sensed = self._lowered = False
        relaxing = self._state is not None and bool(self.conditions.alpha[0] > 0.0)
        if not near and not relaxing:
            self._values = self.air
            return self._values
        state = self._contact(command_mm)
        relative = np.array([[*(command_mm[:2] - self._base_mm), height]])
        self._state, solved = mechanics.advance(state, relative, dt_s)
        self._values = packed(solved)[0]
        return self._values

    def turn(self, angle_rad: float) -> None:
        """Turn the piece between the pads: as a torsion slip of both, felt in contact alone."""
        if self._state is not None:
            slip = self._state.slip + np.array([0.0, 0.0, angle_rad])
            self._state = replace(self._state, slip=slip)

    @property
    def touch_height_mm(self) -> float:
        """Command at which the face first touches while nothing has slipped."""
        return self._scene.grip_height_mm + self.gripping.grasp_offset_mm[1]

    @property
    def press_n(self) -> float:
        """Present true press force."""
        return float(self._values[2])

    @property
    def residual(self) -> float:
        """Worst scaled residual since the contact began, see ``mechanics.RESIDUAL_LIMIT``."""
        return 0.0 if self._state is None else float(self._state.residual[0])

    @property
    def bottoms(self) -> Tower:
        """The tower below where it is by now: free bottoms stay where they slid to."""
        if self._state is None or not self._state.pose.slide_mm.any():
            return self._bottoms
        return slid(self._bottoms, self._state.pose.slide_mm[0])

    @property
    def toppled(self) -> bool:
        """Whether the press has tipped the bottoms so far that they will not come back."""
        return self._state is not None and bool(self._state.toppled[0])

    @property
    def slip_mm(self) -> float:
        """Largest slip of a pad in this gripping."""
        if self._state is None:
            return 0.0
        return float(np.hypot(self._state.slip[0, :, 0], self._state.slip[0, :, 1]).max())

    def dragged_mm(self, command_mm: FloatArray) -> float:
        """Return how far the arm went sideways since the contact began, 0 in air."""
        if self._state is None or self.press_n <= 0.0:
            return 0.0
        return float(np.hypot(*(command_mm[:2] - self._base_mm)))

    def offset_mm(self, command_mm: FloatArray) -> tuple[float, float]:
        """Return the true displacement of the face in ``O`` for a command."""
        true = true_offset_mm(command_mm[None, :2], self.conditions)[0]
        now, first = self.bottoms.bodies[-1].at_mm, self._scene.bottoms.bodies[-1].at_mm
        x, y = now[0] - first[0], now[1] - first[1]
        return float(true[0] + self._slip_x_mm() - x), float(true[1] - y)

    def gap_mm(self, command_mm: FloatArray) -> float:
        """Return how high the face is over first touch, 0 while pressing."""
        if self.press_n > 0.0:
            return 0.0
        return max(float(command_mm[2]) - self.touch_height_mm, 0.0)

    def _slip_x_mm(self) -> float:
        return 0.0 if self._state is None else float(self._state.slip[0, :, 0].mean())

    def _contact(self, command_mm: FloatArray) -> mechanics.ContactState:
        """Return the contact at this place; in air it may be a new place."""
        state, here = self._state, command_mm[:2]
        moved = bool(np.abs(here - self._base_mm).max() > 1e-6)
        settled = self.press_n > 0.0 or not moved
        if state is not None and settled and not self._fresh:
            return state
        self._base_mm = here.copy()
        self._fresh = False
        offset = np.array([self.offset_mm(command_mm)])
        self._bottoms = self.bottoms
        return mechanics.begin(
            self._points_mm,
            self._scene.surface,
            offset,
            self.conditions,
            previous=state,
            pitch_mm=self._scene.settings.face.lattice_mm,
        ).on(stand_of(self._bottoms, self._scene.settings.support))

    def _draw(self, probe: ProbeSettings) -> Conditions:
        scene = self._scene
        rng = generator(scene.seed, Scope.PROBE, scene.mounting, self._grip, self.probe)
        draw = draw_probe(scene.settings, rng)
        if self.probe == 0:
            # Before the first press the piece is where the scene says.
            draw = replace(draw, label_error_mm=(0.0, 0.0))
        return conditions_of(
            scene.settings,
            probe,
            scene.grip_height_mm,
            scene.piece.width_mm,
            [(self.mounting, self.gripping, draw)],
        )


def mounting_of(scene: Scene) -> Mounting:
    """Return the draw of the scene's mounting."""
    return draw_mounting(scene.settings, generator(scene.seed, Scope.MOUNTING, scene.mounting))


def start_command_mm(scene: Scene) -> FloatArray:
    """Return the command (3,) of ``G`` that puts the first gripping of the piece at the start.

    A jig is where it was taught, whatever the errors of this gripping.
    """
    if scene.jig:
        return np.array([*scene.start_mm, scene.grip_height_mm + scene.start_height_mm])
    holding = Holding(scene, 0, ProbeSettings().grip_force_n)
    true = true_offset_mm(np.zeros((1, 2)), holding.conditions)[0]
    x, y = scene.start_mm
    return np.array([x - true[0], y - true[1], scene.grip_height_mm + scene.start_height_mm])
