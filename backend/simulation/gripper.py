"""The simulated gripper: jaws and held piece.

Applies the batched mechanics to a single piece over many probes. Random conditions are drawn per
mounting, grip and probe; slip and gel state persist until the jaws open.
"""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass, replace

import numpy as np

from touchdown.backend.config import ProbeSettings
from touchdown.backend.core import FloatArray
from touchdown.backend.geometry import Tower, face_points
from touchdown.backend.simulation import conditions, mechanics
from touchdown.backend.simulation.ground_truth import Scene, scene_mounting, true_com_xy_mm
from touchdown.backend.simulation.pressing import TIMELINE_VALUES, pack_equilibrium
from touchdown.backend.simulation.supports import slide_bottoms, support_stack
from touchdown.backend.simulation.wrist_sensor import WristLoad, WristSampler, held_piece_load

CLOSING_TIME_S = 0.5  # time to reach the piece from the open position
SQUEEZE_TIME_S = 0.1  # time from touching the piece to full force
WEIGH_CYCLE_US = 1_000_000
POSE_CYCLES = 6  # from one pose of a weighing to the next, as long as the simulated arm needs
LET_GO_MM = 0.1  # jaws that open at once release the piece when wider than it by this much
AGAIN_MM_S = 40.0  # speed at which loosened jaws close again
STEP_MM = 0.15  # jaws that open by less in one command loosen the grip


@dataclass(frozen=True, slots=True)
class JawEvents:
    """Changes of the held piece in a cycle."""

    taken: bool = False
    let_go: bool = False


class SimulatedJaws:
    """Jaws stepped in cycles; ``halt`` from any thread. Widths in mm, force per finger in N.

    ``squeezed_mm``: how much both pads together are squeezed by the grip. Jaws that open in steps
    are ``loosened``: a finger may still touch the piece, which is not held any more.
    """

    def __init__(self, open_mm: float, piece_mm: float) -> None:
        self.width_mm, self.force_n, self.holding = open_mm, 0.0, False
        self.piece_present, self.loosened = True, False
        self.squeezed_mm, self._grip_n = LET_GO_MM, 0.0
        self._piece_mm = piece_mm
        self.asked_n = 0.0
        self._target_mm: float | None = None
        self._speed_mm_s = 0.0
        self._slips_out = False
        self._lock = threading.Lock()

    @property
    def moving(self) -> bool:
        """True if a command is in progress."""
        return self._target_mm is not None

    def close(self, force_n: float) -> None:
        """Start closing until the piece is held with ``force_n`` per finger, or completely."""
        with self._lock:
            self._target_mm = self._piece_mm if self.piece_present else 0.0
            way = max(self.width_mm - self._target_mm, 0.0)
            self._speed_mm_s = -max(way / CLOSING_TIME_S, AGAIN_MM_S if self.loosened else 1.0)
            self.asked_n = force_n

    def open_to(self, width_mm: float, speed_mm_s: float) -> None:
        """Start opening (or closing, at most to the piece) to ``width_mm``."""
        with self._lock:
            least = self._piece_mm if self.piece_present else 0.0
            self._target_mm = max(width_mm, least)
            self._speed_mm_s = math.copysign(speed_mm_s, self._target_mm - self.width_mm)
            self.asked_n = 0.0
            gripped = self.holding or self.loosened
            self.loosened = gripped and 0.0 < self._target_mm - self.width_mm <= STEP_MM
            self.holding = gripped and not self.loosened

    def lose(self) -> None:
        """Lose the piece for good in the next step."""
        with self._lock:
            self.piece_present, self._slips_out = False, self.holding or self.loosened

    def halt(self) -> None:
        """Stop; the grip is kept."""
        with self._lock:
            self._target_mm = None

    def step(self, dt_s: float) -> JawEvents:
        """Move for ``dt_s``."""
        with self._lock:
            if self._slips_out:
                self._slips_out = self.holding = self.loosened = False
                self._target_mm, self.force_n = None, 0.0
                return JawEvents(let_go=True)
            target = self._target_mm
            if target is None:
                return JawEvents()
            step = self._speed_mm_s * dt_s
            arrived = abs(target - self.width_mm) <= abs(step)
            self.width_mm = target if arrived else self.width_mm + step
            if self.asked_n > 0.0:
                return self._squeeze(dt_s) if arrived else JawEvents()
            if arrived:
                self._target_mm = None
            return self._loosen()

    def _squeeze(self, dt_s: float) -> JawEvents:
        if not self.piece_present:
            self._target_mm = None
            return JawEvents()
        self.force_n = min(self.force_n + self.asked_n * dt_s / SQUEEZE_TIME_S, self.asked_n)
        if self.force_n < self.asked_n:
            return JawEvents()
        self._target_mm, self._grip_n = None, self.force_n
        taken, self.holding, self.loosened = not self.holding, True, False
        return JawEvents(taken=taken)

    def _loosen(self) -> JawEvents:
        opened_mm = self.width_mm - self._piece_mm
        if self.loosened:
            self.force_n = self._grip_n * max(1.0 - max(opened_mm, 0.0) / self.squeezed_mm, 0.0)
            return JawEvents()
        if opened_mm <= LET_GO_MM:
            return JawEvents()
        let_go, self.holding, self.force_n = self.holding, False, 0.0
        return JawEvents(let_go=let_go)


NEAR_MM = 1.0  # contact is solved below this height above first touch; above, the piece is in air


class HeldPiece:
    """One grip of the piece. Positions are commands of ``G`` (3,), mm in ``O``."""

    def __init__(
        self, scene: Scene, grip: int, force_n: float, bottoms: Tower | None = None
    ) -> None:
        """``grip``: number of this grip; ``force_n``: commanded force per finger.

        ``bottoms``: those of the scene at the positions to which they slid.
        """
        self._scene, self._grip = scene, grip
        self._bottoms = bottoms or scene.bottoms
        self.mounting = scene_mounting(scene)
        rng = conditions.scoped_generator(
            scene.seed, conditions.SeedScope.GRIPPING, scene.number, scene.mounting, grip
        )
        self.gripping = conditions.draw_gripping(scene.settings, force_n, rng)
        self.probe = 0
        self.conditions = self._draw(ProbeSettings())
        face = scene.settings.face
        self._points_mm = face_points(scene.piece.face, face.lattice_mm / face.subcells)
        self._state: mechanics.ContactState | None = None
        self._base_mm = np.zeros(2)
        self._fresh = True
        self.air = np.zeros(TIMELINE_VALUES)
        self.air[12:] = self.gripping.grip_force_n
        self._values = self.air
        self.weight = held_piece_load(
            scene.piece.mass_g,
            (*true_com_xy_mm(scene), scene.piece.com_height_mm),
            scene.grip_height_mm,
            self.gripping.grasp_offset_mm,
        )
        self.weight_g = self.weight.wrench_g()  # (6,) weight of the piece at ``G``, N and N·mm
        # Whether the sensor errors of the probe apply: from its press until it is lifted off.
        self.sensed = False
        self._lowered = False

    def begin_probe(self, probe: ProbeSettings) -> None:
        """Draw the nuisances of the next probe, valid until the one after it."""
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
        gives = self.conditions.alpha[0] + self.conditions.creep[0] > 0.0
        relaxing = self._state is not None and bool(gives)
        if not near and not relaxing:
            self._values = self.air
            return self._values
        state = self._contact(command_mm)
        relative = np.array([[*(command_mm[:2] - self._base_mm), height]])
        self._state, solved = mechanics.advance_probes(state, relative, dt_s)
        self._values = pack_equilibrium(solved)[0]
        return self._values

    def turn(self, angle_rad: float) -> None:
        """Rotate the piece between the pads, as torsion slip of both; effective in contact only."""
        if self._state is not None:
            slip = self._state.slip + np.array([0.0, 0.0, angle_rad])
            self._state = replace(self._state, slip=slip)

    @property
    def touch_height_mm(self) -> float:
        """Height of first touch without slip."""
        return self._scene.grip_height_mm + float(self.conditions.grasp_offset_mm[0, 1])

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
        """The tower below; free bottoms stay where they slid to."""
        if self._state is None or not self._state.pose.slide_mm.any():
            return self._bottoms
        return slide_bottoms(self._bottoms, self._state.pose.slide_mm[0])

    @property
    def toppled(self) -> bool:
        """True if the press has tipped the bottoms beyond return."""
        return self._state is not None and bool(self._state.toppled[0])

    @property
    def slip_mm(self) -> float:
        """Largest slip of a pad in this grip."""
        if self._state is None:
            return 0.0
        return float(np.hypot(self._state.slip[0, :, 0], self._state.slip[0, :, 1]).max())

    def dragged_mm(self, command_mm: FloatArray) -> float:
        """Return the lateral travel of the arm since the start of contact, 0 in air."""
        if self._state is None or self.press_n <= 0.0:
            return 0.0
        return float(np.hypot(*(command_mm[:2] - self._base_mm)))

    def offset_mm(self, command_mm: FloatArray) -> tuple[float, float]:
        """Return the true displacement of the face in ``O`` for a command."""
        true = conditions.true_offset_mm(command_mm[None, :2], self.conditions)[0]
        now, first = self.bottoms.bodies[-1].at_mm, self._scene.bottoms.bodies[-1].at_mm
        x, y = now[0] - first[0], now[1] - first[1]
        slip_x_mm = 0.0 if self._state is None else float(self._state.slip[0, :, 0].mean())
        return float(true[0] + slip_x_mm - x), float(true[1] - y)

    def gap_mm(self, command_mm: FloatArray) -> float:
        """Return the height of the face above first touch, 0 while pressing."""
        if self.press_n > 0.0:
            return 0.0
        return max(float(command_mm[2]) - self.touch_height_mm, 0.0)

    def _contact(self, command_mm: FloatArray) -> mechanics.ContactState:
        """Return the contact state at this position; a new one after a move in air."""
        state, here = self._state, command_mm[:2]
        moved = bool(np.abs(here - self._base_mm).max() > 1e-6)
        settled = self.press_n > 0.0 or not moved
        if state is not None and settled and not self._fresh:
            return state
        self._base_mm = here.copy()
        self._fresh = False
        offset = np.array([self.offset_mm(command_mm)])
        self._bottoms = self.bottoms
        face = self._scene.settings.face
        return mechanics.begin_probes(
            self._points_mm,
            self._scene.surface,
            offset,
            self.conditions,
            previous=state,
            pitch_mm=face.lattice_mm / face.subcells,
            subcells=face.subcells,
            surfaces=[self._bottoms.bodies[-1].surface],
        ).on(support_stack(self._bottoms, self._scene.settings.support))

    def _draw(self, probe: ProbeSettings) -> conditions.Conditions:
        scene = self._scene
        place = (scene.number, scene.mounting, self._grip, self.probe)
        rng = conditions.scoped_generator(scene.seed, conditions.SeedScope.PROBE, *place)
        draw = conditions.draw_probe(scene.settings, rng)
        if self.probe == 0:
            # Before the first press the piece is at the start of the scene.
            still = (0.0, 0.0)
            draw = replace(draw, label_error_mm=still, reseat_mm=still, pitch_rad=0.0)
        return conditions.conditions_from_draws(
            scene.settings,
            probe,
            scene.grip_height_mm,
            scene.piece.width_mm,
            [(self.mounting, self.gripping, draw)],
        )


def start_command_mm(scene: Scene) -> FloatArray:
    """Return the command (3,) of ``G`` that places the first grip of the piece at the start.

    The position of a jig does not include the errors of the grip.
    """
    if scene.jig:
        return np.array([*scene.start_mm, scene.grip_height_mm + scene.start_height_mm])
    holding = HeldPiece(scene, 0, ProbeSettings().grip_force_n)
    true = conditions.true_offset_mm(np.zeros((1, 2)), holding.conditions)[0]
    x, y = scene.start_mm
    return np.array([x - true[0], y - true[1], scene.grip_height_mm + scene.start_height_mm])


def simulate_weighing(scene: Scene, turns: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the readings of the wrist sensor with the empty hand, then with the held piece.

    Grasp, noise, drift and place of the sensor are those of the scene. The pull of the cables is
    left out: it is the same with and without the piece.

    Parameters
    ----------
    scene : Scene
        Scene with its first gripping.
    turns : ndarray, shape (n, 3, 3)
        Rotations of the hand.

    Returns
    -------
    t_s : ndarray, shape (2, n)
        Middle of each mean over 1 s.
    wrenches, sigmas : ndarray, shape (2, n, 6)
        Mean untared wrench, N and N·m in the axes of the hand, and its standard error.

    """
    held, day = HeldPiece(scene, 0, ProbeSettings().grip_force_n), scene_mounting(scene)
    sampler = WristSampler(
        scene.settings.wrist, WEIGH_CYCLE_US, scene.seed, day.wrist_yaw_rad, day.wrist_lever_mm
    )
    times, means, errors = [], [], []
    cycle = 0
    for load in (None, held.weight):
        for turn in turns:
            weight = sampler.payload.wrench_g(turn)
            weight = weight if load is None else weight + load.wrench_g(turn)
            strain = WristLoad(weight, weight, np.zeros(6))
            for _ in range(POSE_CYCLES):  # only the last one is read
                start_us, cycle = cycle * WEIGH_CYCLE_US, cycle + 1
                _, rows = sampler.samples(start_us, cycle * WEIGH_CYCLE_US, strain)
            times.append(1e-6 * (start_us + 0.5 * WEIGH_CYCLE_US))
            means.append(rows.mean(axis=0))
            errors.append(rows.std(axis=0, ddof=1) / math.sqrt(len(rows)))
    shape = 2, len(turns), 6
    return (
        np.reshape(times, shape[:2]), np.reshape(means, shape), np.reshape(errors, shape)
    )  # fmt: skip
