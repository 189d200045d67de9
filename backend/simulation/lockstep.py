"""Many trials on one surface side by side: the bench's own draws, the batch's physics.

Every trial has the mounting, the gripping and the probe draws of the stepped bench with the same
scene; only the noise within a probe (white, drift, frame times, lost markers) is drawn otherwise,
and nothing is rendered or tracked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from backend.config.method import ProbeSettings
from backend.core.flow import FloatArray
from backend.objects.surface import face_points
from backend.simulation import nuisance
from backend.simulation.conditions import Conditions, true_offset_mm
from backend.simulation.episodes import Eye, draw_noise, gel_of, observe, rule_of, usable
from backend.simulation.holding import mounting_of, start_command_mm
from backend.simulation.mechanics import Carried, Region, begin
from backend.simulation.nuisance import Scope
from backend.simulation.pressing import press
from backend.simulation.scene import Scene
from backend.simulation.support import Stand, join_stands, slid, stand_of
from backend.simulation.timeline import VALUES

_MOUNTING = _GRIP = 0
_SENSORS = 1


@dataclass(frozen=True, slots=True)
class Presses:
    """What k presses left behind.

    ``observation`` (k, 20, 258) float32; ``true_mm`` (k, 2): displacement of the face afterwards,
    slip in the hand and sliding of the bottom included; ``valid`` (k,): contact was found and the
    solver converged; ``press_n`` (k,) at the end; ``slip_mm`` (k,): largest slip of a pad in this
    press; ``toppled`` (k,): the supports will not come back upright.
    """

    observation: NDArray[np.float32]
    true_mm: FloatArray
    valid: NDArray[np.bool_]
    press_n: FloatArray
    slip_mm: FloatArray
    toppled: NDArray[np.bool_]


class Lockstep:
    """Trials of one piece over one upper outline and one bench; scenes differ in seed and tower.

    Raises ValueError for scenes of different pieces, surfaces, settings or numbers of free bodies.
    """

    def __init__(self, scenes: Sequence[Scene], probe: ProbeSettings | None = None) -> None:
        first = scenes[0]
        if any(self.shared(s) != self.shared(first) for s in scenes):
            raise ValueError("trials in lockstep share piece, surface and settings")
        self.scenes, self._first = scenes, first
        self._probe = probe or ProbeSettings()
        self._points_mm = face_points(first.piece.face, first.settings.face.lattice_mm)
        self._rule = rule_of(first.settings, self._probe)
        self._eye = Eye(gel_of(first.settings))
        force_n = self._probe.grip_force_n
        self.grippings = [
            nuisance.draw_gripping(
                s.settings, force_n, nuisance.generator(s.seed, Scope.GRIPPING, _MOUNTING, _GRIP)
            )
            for s in scenes
        ]
        self._mountings = [mounting_of(scene) for scene in scenes]
        self._carried = Carried.fresh(len(scenes))
        self._number = [0] * len(scenes)
        self.bottoms = [scene.bottoms for scene in scenes]
        """The towers below, as far as they have slid by now."""
        self._slid_mm = np.zeros((len(scenes), 2))
        self._stands = [stand_of(tower, first.settings.support) for tower in self.bottoms]

    @staticmethod
    def shared(scene: Scene) -> tuple[object, ...]:
        """Return what must be the same in all scenes."""
        return scene.piece, scene.surface, scene.settings, _free(scene)

    def surfaces(self, rows: NDArray[np.intp]) -> Region:
        """Return what lies under the faces of the trials ``rows``."""
        return self._first.surface

    def start_commands_mm(self) -> FloatArray:
        """Return (B, 2): commands of the face that put each piece at its scene's start."""
        return np.stack([start_command_mm(scene)[:2] for scene in self.scenes])

    def press(self, trials: Sequence[int], commands_mm: FloatArray) -> Presses:
        """Press the pieces of the named ``trials`` at ``commands_mm`` (k, 2); slip stays.

        Every call is a new probe of these trials, with its own draws, as on the bench.
        """
        rows = np.asarray(trials, dtype=np.intp)
        settings = self._first.settings
        conditions = self._conditions(rows)
        carried = self._carried.take(rows)
        state = begin(
            self._points_mm,
            self.surfaces(rows),
            true_offset_mm(commands_mm, conditions, carried.slip) - self._slid_mm[rows],
            conditions,
            carried,
            settings.face.lattice_mm,
        ).on(self._stand(rows))
        noise = [draw_noise(settings, self._rule, self._sensor_rng(i)) for i in rows.tolist()]
        pressed = press(
            state,
            np.array([n.phase_s for n in noise]),
            np.stack([n.force_n for n in noise]),
            self._probe,
            self._rule,
            1e-6 * settings.cycle_us,
        )
        slid = pressed.state.slip[:, :, :2] - carried.slip[:, :, :2]
        valid = usable(pressed, conditions, self._probe)
        after = Carried(pressed.state.slip, pressed.state.relaxed)
        self._carried = self._carried.replaced(rows, after)
        self._slide(rows, pressed.state.pose.slide_mm)
        last = pressed.timeline.values[:, -1, :VALUES]
        return Presses(
            observation=observe(pressed, conditions, settings, noise, self._eye),
            true_mm=true_offset_mm(commands_mm, conditions, after.slip) - self._slid_mm[rows],
            valid=valid,
            press_n=np.asarray(last[:, 2], dtype=np.float64),
            slip_mm=np.asarray(np.hypot(slid[..., 0], slid[..., 1]).max(axis=1)),
            toppled=pressed.state.toppled,
        )

    def _stand(self, rows: NDArray[np.intp]) -> Stand | None:
        stands = [stand for i in rows.tolist() if (stand := self._stands[i]) is not None]
        return join_stands(stands) if stands else None

    def _slide(self, rows: NDArray[np.intp], slide_mm: FloatArray) -> None:
        """Leave the supports where they have slid to (k, m, 2)."""
        for i, slide in zip(rows.tolist(), slide_mm, strict=True):
            if slide.any():
                self.bottoms[i] = slid(self.bottoms[i], slide)
                self._slid_mm[i] += slide.sum(axis=0)
                self._stands[i] = stand_of(self.bottoms[i], self._first.settings.support)

    def _conditions(self, rows: NDArray[np.intp]) -> Conditions:
        draws = []
        for i in rows.tolist():
            self._number[i] += 1
            scene = self.scenes[i]
            rng = nuisance.generator(scene.seed, Scope.PROBE, _MOUNTING, _GRIP, self._number[i])
            each = nuisance.draw_probe(scene.settings, rng)
            draws.append((self._mountings[i], self.grippings[i], each))
        piece = self._first.piece
        return nuisance.conditions_of(
            self._first.settings, self._probe, self._first.grip_height_mm, piece.width_mm, draws
        )

    def _sensor_rng(self, trial: int) -> np.random.Generator:
        seed, number = self.scenes[trial].seed, self._number[trial]
        return nuisance.generator(seed, Scope.PROBE, _MOUNTING, _GRIP, number, _SENSORS)


def _free(scene: Scene) -> int:
    return sum(not body.fixed for body in scene.bottoms.bodies)
