"""The simulated bench in cycles of 10 ms: arm, jaws, piece, contact, sensors.

Random numbers depend only on the seed of the scene. The same scene with the same commands in the
same cycles gives the same bytes for any division of time.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np

from touchdown.backend.config import ProbeSettings
from touchdown.backend.core import FINGERS, IDENTITY_ROTATION, Finger, FloatArray
from touchdown.backend.devices import PressCommand
from touchdown.backend.emulation import DisturbanceScript
from touchdown.backend.simulation import arm, finger_camera, ground_truth
from touchdown.backend.simulation.gripper import HeldPiece, SimulatedJaws, start_command_mm
from touchdown.backend.simulation.ground_truth import Scene, SceneTruth
from touchdown.backend.simulation.marker_fields import Gel, gel_from_settings
from touchdown.backend.simulation.opening import CATCH_RAD, LooseGrip, standing_piece
from touchdown.backend.simulation.pressing import TIMELINE_VALUES
from touchdown.backend.simulation.wrist_sensor import WristLoad, WristSampler, cable_wrench

OPEN_CLEARANCE_MM = 20.0  # at the start the jaws are wider than the piece by this much
DRAG_MM = 1.0  # dragging a pressed piece farther than this knocks a free support over
DRAG_N = 0.5
JIG_MM = 1.0  # released within this distance of the jig, the piece is back in the jig
STILL_PX = 0.01  # dots are drawn again after this creep, a third of the error of the tracker
_TARE_CYCLES = 20
_AIR_HISTORY_US = 400_000  # air samples kept for the baseline of the next press


@dataclass(frozen=True, slots=True)
class CycleRecord:
    """Result of a cycle: wrist samples (n,), (n, 6), images, and ``G`` (3,) at its end."""

    end_us: int
    t_s: FloatArray
    wrench: FloatArray
    shots: Mapping[Finger, list[finger_camera.Exposure]]
    pose_mm: FloatArray


class World:
    """Steps the scene. Commands are given between steps; ``drive`` and ``jaws`` halt at any time.

    Only the noise of an image is drawn anew while no dot has crept by more than ``STILL_PX``.
    """

    def __init__(self, scene: Scene, script: DisturbanceScript | None = None) -> None:
        self.scene, self._script = scene, script or DisturbanceScript()
        settings = scene.settings
        self.cycle_us = settings.cycle_us
        self.now_us = 0
        self.drive = arm.ArmDrive(start_command_mm(scene))
        width_mm = scene.piece.width_mm
        self.jaws = SimulatedJaws(width_mm + OPEN_CLEARANCE_MM, width_mm)
        self._gel = gel_from_settings(settings)
        # Jaws without a piece mostly keep their forces.
        self._empty_px = lru_cache(maxsize=1)(partial(_empty_px, self._gel))
        seeds = np.random.SeedSequence(
            [scene.seed, scene.number, 7, scene.mounting]
        ).generate_state(3)
        day = ground_truth.scene_mounting(scene)
        self._wrist = WristSampler(
            settings.wrist, self.cycle_us, int(seeds[2]), day.wrist_yaw_rad, day.wrist_lever_mm
        )
        self._cable = np.array(day.cable_n_mm) if np.any(day.cable_n_mm) else None
        self._cable_from_mm = self.drive.command_mm.copy()
        self._cameras = _cameras(scene, seeds.tolist())
        self.holding: HeldPiece | None = None  # the present grip
        self._loose: LooseGrip | None = None  # the present grip while the jaws open in steps
        self._bottoms = scene.bottoms
        self._grips = 0
        self._rest = np.zeros(TIMELINE_VALUES)
        self._values = self._rest
        self._heard: tuple[FloatArray, FloatArray] = (np.empty(0), np.empty(0))
        self._air = deque([self._heard], _AIR_HISTORY_US // self.cycle_us)
        self._recent_n: list[float] = []
        self._tare_n = 0.0
        self._put_down: tuple[tuple[float, float], float] | None = None
        self._final: SceneTruth | None = None
        self.knocked_over = False
        self._field_px = self._field(self._values)

    # -- commands ---------------------------------------------------------------------------------

    def travel(self, target_mm: FloatArray, speed_mm_s: float) -> arm.SimTravel:
        """Start a straight move of ``G`` to ``target_mm`` (3,)."""
        program = arm.SimTravel(self.drive.command_mm, target_mm, speed_mm_s)
        self.drive.run(program)
        return program

    def press(self, law: PressCommand) -> arm.SimPress:
        """Start a press: a new probe, whose nuisances are drawn."""
        if self.holding is not None:
            self.holding.begin_probe(ProbeSettings(stiffness_n_mm=law.stiffness_n_mm))
        air_s, air_n = (np.concatenate(part) for part in zip(*self._air, strict=True))
        self._tare_n = float(np.mean(self._recent_n)) if self._recent_n else 0.0
        start_s = self.now_us * 1e-6
        # The air samples are converted to the sensor offset of the new probe.
        air = air_s, air_n + self._sensor_offset()[2]
        program = arm.SimPress(law, float(self.drive.command_mm[2]), start_s, air)
        self.drive.run(program)
        return program

    def unload(self, force_n: float, speed_mm_s: float) -> arm.SimUnload:
        """Start rising until the press force above that in air is ``force_n``."""
        program = arm.SimUnload(force_n, self._tare_n, speed_mm_s, float(self.drive.command_mm[2]))
        self.drive.run(program)
        return program

    def hear(self, t_s: FloatArray, force_n: FloatArray) -> None:
        """Give the arm the samples of the wrist sensor (Fz, untared) of the last cycle."""
        self._heard = (t_s, force_n)
        mean_n = float(force_n.mean()) if len(force_n) else math.nan
        # A mean is finite exactly if all samples are.
        if math.isfinite(mean_n):
            self._air.append((t_s, force_n - self._sensor_offset()[2]))
            self._recent_n = [*self._recent_n, mean_n][-_TARE_CYCLES:]

    # -- time -------------------------------------------------------------------------------------

    @property
    def rests(self) -> bool:
        """True if the forces of the next cycles are those of the last one."""
        moving = self.drive.moving or self.jaws.moving or self._script.disturbances
        return self.holding is None and not moving

    def step(self, watched: Collection[Finger] = FINGERS, cycles: int = 1) -> CycleRecord:
        """Advance by one cycle and return its record, with images of ``watched`` fingers only.

        A world that ``rests`` advances by several ``cycles`` at once, with the same samples.
        """
        start_us, end_us = self.now_us, self.now_us + cycles * self.cycle_us
        before, field_before = self._load(self._values), self._field_px
        command = self.drive.command_mm if cycles > 1 else self._move(start_us, end_us)
        self.now_us = end_us
        strain = WristLoad(before, self._load(self._values), self._sensor_offset())
        t_s, wrench = self._wrist.samples(start_us, end_us, strain)
        shots = {
            finger: self._cameras[finger].shots(
                start_us,
                end_us,
                finger_camera.MarkerMotion(field_before[i], self._field_px[i], self._bias_px(i)),
                watched=finger in watched,
            )
            for i, finger in enumerate(FINGERS)
        }
        return CycleRecord(end_us, t_s, wrench, shots, self._measured_mm(command))

    def _move(self, start_us: int, end_us: int) -> FloatArray:
        """Move arm, jaws and piece for one cycle; return the command (3,) at its end."""
        start_s, dt_s = start_us * 1e-6, self.cycle_us * 1e-6
        command = self.drive.step(
            arm.ArmCycle(start_s, end_us * 1e-6, *self._heard),
            stalled=self._script.active("arm", "stall", start_s),
        )
        if not self._script.active("gripper", "stall", start_s):
            self._grasp(dt_s, command)
        holding = self.holding
        if holding is not None and (turn_rad := self._script.turn_rad(start_s, end_us * 1e-6)):
            holding.turn(turn_rad)
        if holding is not None and self.jaws.loosened:
            self._values = self._loosened(holding, command, dt_s)
        else:
            self._values = self._rest if holding is None else holding.solve(command, dt_s)
        self._watch_dragging(command)
        self._field_px = self._field(self._values)
        return command

    # -- truth ------------------------------------------------------------------------------------

    def truth(self, *, animate: bool = False) -> SceneTruth:
        """Return the ground truth; MuJoCo runs only with ``animate``, and once."""
        if self._final is not None:
            return self._with_opinion(self._final) if animate else self._final
        offset, yaw = self._placed()
        return SceneTruth(
            offset_mm=offset,
            yaw_rad=yaw,
            margin_mm=ground_truth.true_margin_mm(self._scene_now(), offset, yaw),
            stands=False if self.knocked_over else None,
            fall=None,
            slip_mm=0.0 if self.holding is None else self.holding.slip_mm,
            knocked_over=self.knocked_over,
        )

    def clear_mm(self, position_mm: FloatArray) -> float:
        """Return the height of the face of a held piece above first touch."""
        holding = self.holding
        touch = self.scene.grip_height_mm if holding is None else holding.touch_height_mm
        return float(position_mm[2]) - touch

    def set_up_again(self) -> None:
        """Restore the start state except for the hand: bottoms in place, piece not held."""
        self._bottoms, self.knocked_over = self.scene.bottoms, False
        self._put_down = self._final = self._loose = None
        self.jaws.piece_present = True

    # -- inside -----------------------------------------------------------------------------------

    def _placed(self) -> tuple[tuple[float, float], float]:
        if self.holding is not None:
            return self.holding.offset_mm(self.drive.command_mm), self.holding.gripping.yaw_rad
        if self._put_down is not None:
            return self._put_down
        return self.scene.start_mm, 0.0

    def _scene_now(self) -> Scene:
        holding = self.holding
        bottoms = self._bottoms if holding is None else holding.bottoms
        return self.scene if bottoms is self.scene.bottoms else replace(self.scene, bottoms=bottoms)

    def _grasp(self, dt_s: float, command: FloatArray) -> None:
        change = self.jaws.step(dt_s)
        if change.taken:
            self.holding = HeldPiece(self.scene, self._grips, self.jaws.force_n, self._bottoms)
            normal_n_mm = float(self.holding.conditions.normal_n_mm[0])
            self.jaws.squeezed_mm = 2.0 * self.jaws.force_n / normal_n_mm
            self._grips, self._loose = self._grips + 1, None
        elif change.let_go and self.holding is not None:
            self._bottoms = self.holding.bottoms
            self._release(self.holding, command)

    def _loosened(self, holding: HeldPiece, command: FloatArray, dt_s: float) -> FloatArray:
        """Return the values (14,) while the jaws open in steps; in air the piece stays as it is."""
        if self._loose is None:
            if holding.press_n <= 0.0:
                return holding.solve(command, dt_s)
            self._bottoms = holding.bottoms
            kick = ground_truth.release_kick_mm(self.scene, self._grips)
            place = holding.offset_mm(command), holding.gripping.yaw_rad
            piece = standing_piece(self._scene_now(), *place, kick)
            self._loose = LooseGrip(piece, holding.conditions, self._values, holding.weight_g)
        values = self._loose.advance(self.jaws.width_mm - self.scene.piece.width_mm, dt_s)
        if self._loose.turned_rad < CATCH_RAD:
            return values
        self.jaws.lose()
        return self._values

    def _release(self, holding: HeldPiece, command: FloatArray) -> None:
        if self.scene.jig and np.abs(command - start_command_mm(self.scene)).max() <= JIG_MM:
            self.holding = None
            return
        offset, yaw = holding.offset_mm(command), holding.gripping.yaw_rad
        kick = ground_truth.release_kick_mm(self.scene, self._grips)
        margin = ground_truth.true_margin_mm(self._scene_now(), offset, yaw, kick)
        dropped = not holding.gap_mm(command) <= ground_truth.MAX_RELEASE_GAP_MM
        fell = self._loose is not None and self._loose.turned_rad >= CATCH_RAD
        stands = margin > 0.0 and not (dropped or fell or self.knocked_over)
        self._put_down = (offset, yaw)
        self._final = SceneTruth(
            offset, yaw, margin, stands, None, holding.slip_mm, self.knocked_over,
            kick_mm=math.hypot(*kick),
        )  # fmt: skip
        self.holding = None
        # A trial ends with its release: the piece is not gripped again.
        self.jaws.piece_present = False

    def _with_opinion(self, final: SceneTruth) -> SceneTruth:
        if final.contradicted is None and not final.knocked_over:
            kick = ground_truth.release_kick_mm(self.scene, self._grips)
            opinion = ground_truth.mujoco_opinion(
                self._scene_now(), final.offset_mm, final.yaw_rad, kick
            )
            if opinion is not None:
                fall = None if final.stands else opinion[0]
                self._final = replace(final, fall=fall, contradicted=opinion[1])
        return self._final or final

    def _watch_dragging(self, command: FloatArray) -> None:
        holding = self.holding
        if holding is None or self.scene.bottoms.bodies[-1].fixed:
            return
        if self.scene.settings.support.rocks:
            self.knocked_over = self.knocked_over or holding.toppled
        elif holding.press_n > DRAG_N and holding.dragged_mm(command) > DRAG_MM:
            self.knocked_over = True

    def _load(self, values: FloatArray) -> FloatArray:
        """Return (6,) at ``G``, in the axes of the hand: contact, gripper and piece, N and N·mm."""
        turn = self.drive.turn
        if turn is not IDENTITY_ROTATION:
            # The hand rotates in air only, without a contact wrench.
            weights = self._wrist.payload.wrench_g(turn)
            if self.holding is not None:
                weights = weights + self.holding.weight.wrench_g(turn)
            return values[:6] + weights
        load = values[:6] + self._wrist.payload_g
        if self._cable is not None:
            travel = self.drive.command_mm - self._cable_from_mm
            height_mm = self.scene.settings.wrist.cable_height_mm
            load = load + cable_wrench(self._cable, travel, height_mm)
        return load if self.holding is None else load + self.holding.weight_g

    def _field(self, values: FloatArray) -> FloatArray:
        """Return (2, 63, 2) marker displacements in px, gain included."""
        holding = self.holding
        if holding is None:
            return self._empty_px(self.jaws.force_n, max(self.jaws.asked_n, self.jaws.force_n))
        field = self._gel.displacement_px(
            values[6:12].reshape(2, 3), values[12:14], holding.conditions.grip_force_n[0]
        )
        return np.asarray(field * holding.conditions.gain[0][:, None, None])

    def _bias_px(self, finger: int) -> FloatArray:
        """Return the creep since the reference, zero between probes."""
        holding = self.holding
        if holding is None or not holding.sensed:
            return np.zeros(2)
        return np.asarray(holding.conditions.bias_px[0, finger])

    def _sensor_offset(self) -> FloatArray:
        holding = self.holding
        if holding is None or not holding.sensed:
            return np.zeros(6)
        return np.asarray(holding.conditions.ft_offset[0])

    def _measured_mm(self, command: FloatArray) -> FloatArray:
        """Return the measured ``G`` of the compliant arm under the contact force."""
        if self.holding is None:
            return command
        return np.asarray(command + self._values[:3] / self.holding.conditions.robot_n_mm[0])


def _empty_px(gel: Gel, force_n: float, asked_n: float) -> FloatArray:
    """Return the marker field (2, 63, 2) of jaws that close on nothing."""
    pads_n, grip_n = np.full(2, force_n), np.array(max(asked_n, 1e-3))
    return gel.displacement_px(np.zeros((2, 3)), pads_n, grip_n)


def _cameras(
    scene: Scene, seeds: np.ndarray[tuple[int, ...], np.dtype[np.uint32]]
) -> dict[Finger, finger_camera.FingerCamera]:
    look = finger_camera.load_gel_appearance()
    looks = {"left": look, "right": finger_camera.mirror_appearance(look)}
    return {
        finger: finger_camera.FingerCamera(
            scene.settings.tactile,
            finger_camera.TactileRenderer(looks[finger], seed, STILL_PX),
            seed,
        )
        for finger, seed in zip(FINGERS, seeds, strict=False)
    }
