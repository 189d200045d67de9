"""Trials in the second world, in place of the batched trials of the simulated bench.

Mountings, grips, probes and sensors are drawn as on the bench with the same scenes; the physics
differs. Presses are solved one after the other with the same law of the command.

On the bench a pad is a linear spring with a Maxwell branch, slips at a sharp limit, and the markers
show its strain at once. Here the spring hardens, the piece creeps along the pad at any load and
faster towards the limit of friction, and the markers show a saturating strain with a delay. The gel
is an elastic half-space: the piece moves a round patch of the surface of each pad as a whole, and
the surface outside follows (on the bench: a flat top with a steep roll-off). Closed forms for
incompressible gel: traction of a sliding punch (Johnson, Contact Mechanics, 3.7), torsion of a
patch (Reissner and Sagoci), and gel pressed out sideways.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from touchdown.backend.config import SAMPLES_PER_PROBE, TICK_S, ProbeSettings
from touchdown.backend.core import (
    GRID_COLS,
    GRID_ROWS,
    MARKERS,
    FloatArray,
    OnsetRule,
    back_date_onset,
    detect_contact,
    force_over_baseline,
)
from touchdown.backend.simulation import batch
from touchdown.backend.simulation.conditions import Conditions, true_offset_mm
from touchdown.backend.simulation.ground_truth import Scene
from touchdown.backend.simulation.marker_fields import Gel
from touchdown.backend.simulation.mechanics import SIGN, GraspHistory, elastic_zero
from touchdown.backend.simulation.pressing import MAX_CYCLES, PressCourse, Timeline, air_samples
from touchdown.backend.simulation.release_mujoco import surface_points
from touchdown.backend.simulation.second_world.model import (
    HAND_JOINTS,
    HELD_JOINTS,
    STEP_S,
    MountedPiece,
    bottoms_after_press,
    build_model,
    pad_stiffness,
)

PATCH_MM = 5.0  # radius of the gripped patch [U]
POISSON = 0.5


def shear_field(x_mm: FloatArray, z_mm: FloatArray, patch_mm: float) -> FloatArray:
    """Return (n, 2) displacement (x, z) of the points for a patch moved by 1 along x."""
    r = np.maximum(np.hypot(x_mm, z_mm), 1e-9)
    inside = r <= patch_mm
    share = np.where(inside, 1.0, patch_mm / r)
    tail = POISSON * share * np.sqrt(1.0 - share**2)
    cos, sin = x_mm / r, z_mm / r
    scale = 2.0 / (np.pi * (2.0 - POISSON))
    along = (2.0 - POISSON) * np.arcsin(share) + tail * (cos**2 - sin**2)
    across = tail * 2.0 * cos * sin
    return np.asarray(scale * np.stack([along, across], axis=-1))


def torsion_share(r_mm: FloatArray, patch_mm: float) -> FloatArray:
    """Return (n,) rotation of the surface at the radii, for a patch rotated by 1."""
    share = np.minimum(1.0, patch_mm / np.maximum(r_mm, 1e-9))
    turned = np.arcsin(share) - share * np.sqrt(1.0 - share**2)
    return np.asarray(2.0 / np.pi * turned)


def build_half_space_gel(
    mm_per_px: tuple[float, float], pitch_mm: float, dilation: float, patch_mm: float = PATCH_MM
) -> Gel:
    """Return the gel of two sensors; same inputs and marker order as ``build_gel``."""
    row, column = np.divmod(np.arange(MARKERS), GRID_COLS)
    z = (GRID_ROWS // 2 - row) * pitch_mm
    maps, rests = [], []
    for scale, facing in zip(mm_per_px, (1.0, -1.0), strict=True):
        x = facing * (column - GRID_COLS // 2) * pitch_mm
        along_x = shear_field(x, z, patch_mm)
        along_z = shear_field(z, x, patch_mm)[:, ::-1]
        r = np.hypot(x, z)
        turned = torsion_share(r, patch_mm)[:, None] * np.stack([z, -x], axis=-1)
        # Incompressible flow out of the patch: 1/r outside.
        out = dilation * np.minimum(1.0, (patch_mm / np.maximum(r, 1e-9)) ** 2)
        pressed = out[:, None] * np.stack([x, z], axis=-1)
        field = np.stack([along_x, along_z, turned, pressed])
        to_image = np.array([facing, -1.0]) / scale
        maps.append((field * to_image).reshape(4, 2 * MARKERS))
        rests.append(np.stack([160.0 + facing * x / scale, 120.0 - z / scale], axis=-1))
    return Gel(np.stack(maps), np.stack(rests))


HARDENING_MM = 3.0  # shear at which the stiffness of a pad has doubled [U]
# Largest shear that the markers show, and its time constant [U].
SATURATION_MM, SEEN_LATE_S = 2.0, 0.12
# Creep speed at the friction limit, exponent of the load, and load at which the speed saturates
# [U].
CREEP_MM_S, CREEP_POWER, CREEP_CAP = 0.1, 12, 1.3


class CreepingPads:
    """Both pads of one grip. ``slip`` (2, 3): finger; x, z in mm, torsion in rad.

    ``seen`` (2, 3): strain shown by the markers. ``normal_n`` (2,).
    """

    def __init__(self, conditions: Conditions, slip: FloatArray, *, saturates: bool = True) -> None:
        self.slip = slip.copy()
        self._seen = _saturated if saturates else np.copy
        self._half_mm = 0.5 * float(conditions.width_mm[0])
        self._shear_n_mm = float(conditions.shear_n_mm[0])
        self._normal_n_mm = float(conditions.normal_n_mm[0])
        self._torsion_nmm = float(conditions.torsion_nmm[0])
        self._grip_n = float(conditions.grip_force_n[0])
        self._limit = float(conditions.mu_grip[0])
        self._radius_mm = float(conditions.limit_radius_mm[0])
        self._slips = bool(conditions.slips[0])
        self.hardening = 1.0  # stiffness of shear and torsion over that of an unstrained gel
        self.normal_n = np.full(2, self._grip_n)
        self.strain = self._strain(self.rest())
        self.seen = self._seen(self.strain)

    def rest(self) -> FloatArray:
        """Return (6,) displacement of the piece in the hand with unloaded pads."""
        unloaded = np.concatenate([self.slip, np.zeros((2, 1))], axis=1)[None]
        zero = elastic_zero(np.zeros((1, 3)), unloaded, np.array([2.0 * self._half_mm]))
        return np.asarray(zero[0])

    def follow(self, held: FloatArray, dt_s: float) -> None:
        """Advance by ``dt_s`` with the piece at ``held`` (6,) in the hand, mm and rad."""
        self.strain = self._strain(held)
        self.normal_n = np.maximum(self._grip_n + SIGN * self._normal_n_mm * held[1], 0.0)
        size2 = float((self.strain[:, :2] ** 2).sum(axis=1).mean())
        self.hardening = 1.0 + size2 / HARDENING_MM**2
        if self._slips:
            self._creep(dt_s)
        late = dt_s / (dt_s + SEEN_LATE_S)
        self.seen += late * (self._seen(self.strain) - self.seen)

    def _strain(self, held: FloatArray) -> FloatArray:
        swing = self._half_mm * SIGN
        d_x = held[0] - held[5] * swing
        d_z = held[2] + held[3] * swing
        return np.stack([d_x, d_z, np.full(2, held[4])], axis=1) - self.slip

    def _creep(self, dt_s: float) -> None:
        stiffness = self.hardening * np.array([self._shear_n_mm] * 2 + [self._torsion_nmm])
        lever = np.array([1.0, 1.0, self._radius_mm])
        limit = np.maximum(self._limit * self.normal_n, 1e-9)[:, None]
        load = stiffness * self.strain / (limit * lever)
        size = np.linalg.norm(load, axis=1, keepdims=True)
        speed = CREEP_MM_S * np.minimum(size, CREEP_CAP) ** CREEP_POWER
        self.slip += dt_s * speed * load / np.maximum(size, 1e-9) / lever


def _saturated(strain: FloatArray) -> FloatArray:
    """Return the strain (2, 3) shown by the markers; torsion does not saturate."""
    shown = strain.copy()
    size = np.linalg.norm(strain[:, :2], axis=1, keepdims=True)
    shown[:, :2] *= SATURATION_MM * np.tanh(size / SATURATION_MM) / np.maximum(size, 1e-9)
    return shown


START_CLEARANCE_MM = 0.1  # height of the face above the highest possible contact, at the start
BALANCE_N, BALANCE_NMM = 0.1, 2.0  # largest imbalance of contact and springs in a settled press
HAND_Z = HAND_JOINTS.start + 2


@dataclass(frozen=True, slots=True)
class DescentRecord:
    """``t_s`` (M,) from about first touch; ``values`` (M, 14) as in a timeline; ``air`` (14,).

    ``onset_s``: back-dated, NaN where no contact was declared. ``settled``: contact and springs
    balance at the end. ``press_n`` at the end. ``height_mm`` (M,): of the arm, as it measures it.
    """

    t_s: FloatArray
    values: FloatArray
    height_mm: FloatArray
    air: FloatArray
    onset_s: float
    settled: bool

    @property
    def ticks_s(self) -> FloatArray:
        """(20,) instants of the model's input."""
        onset = self.onset_s if np.isfinite(self.onset_s) else 0.0
        return np.asarray(onset + TICK_S * np.arange(1, SAMPLES_PER_PROBE + 1))

    @property
    def travel_mm(self) -> FloatArray:
        """(20,) travel of the arm at the ticks, downwards from the onset."""
        onset = self.onset_s if np.isfinite(self.onset_s) else 0.0
        height = np.interp([onset, *self.ticks_s], self.t_s, self.height_mm)
        return np.asarray(height[0] - height[1:], dtype=np.float64)


class SecondWorldPress:
    """One press of a mounted piece."""

    def __init__(
        self,
        mounted: MountedPiece,
        pads: CreepingPads,
        conditions: Conditions,
        probe: ProbeSettings,
    ) -> None:
        self._mount, self._pads, self._probe = mounted, pads, probe
        self._stiffness = pad_stiffness(conditions)
        self._values: list[FloatArray] = []
        self._height_mm: list[float] = []
        self._force_n: list[float] = []

    def run(
        self, high_mm: float, noise_n: FloatArray, rule: OnsetRule, cycle_s: float
    ) -> DescentRecord:
        """Press from ``high_mm`` over the centre of the support.

        ``noise_n``: errors of the press force on the sample grid, as for ``press_batch``.
        """
        rest = self._pads.rest()
        data, held_z = self._mount.data, float(rest[2])
        data.qpos[HELD_JOINTS] = rest * np.array([1e-3] * 3 + [1.0] * 3)
        start_mm = high_mm - held_z
        data.qpos[HAND_Z] = 1e-3 * start_mm
        air = self._now()
        speed = self._probe.approach_mm_s
        onset_s, acted = float("nan"), 0
        for cycle in range(MAX_CYCLES):
            high = start_mm - speed * cycle * cycle_s
            self._cycle(high, high - speed * cycle_s, cycle_s)
            found = self._onset(noise_n, rule, cycle_s)
            if found is not None:
                onset_s, acted = found, cycle + 1
                break
        if not acted:
            return self._ended(air, onset_s, cycle_s)
        stopped_s = acted * cycle_s
        cycles = int(np.ceil((onset_s + self._probe.duration_s - stopped_s) / cycle_s)) + 1
        times = stopped_s + cycle_s * np.arange(cycles + 1)
        commands = [
            start_mm - speed * onset_s - self._depth_mm(onset_s, stopped_s, t)
            for t in times.tolist()
        ]
        for command, following in pairwise(commands):
            self._cycle(command, following, cycle_s)
        return self._ended(air, onset_s, cycle_s)

    def _depth_mm(self, onset_s: float, stopped_s: float, t_s: float) -> float:
        """Return the commanded depth below the onset at a time after the descent was stopped."""
        probe = self._probe
        reached = probe.approach_mm_s * (stopped_s - onset_s)
        along = min(1.0, (t_s - onset_s) / (probe.ramp_fraction * probe.duration_s))
        return max(reached, probe.depth_mm * along)

    def _cycle(self, from_mm: float, to_mm: float, cycle_s: float) -> None:
        model, data, pads = self._mount.model, self._mount.data, self._pads
        steps = round(cycle_s / STEP_S)
        for command_mm in np.linspace(from_mm, to_mm, steps + 1)[1:].tolist():
            model.qpos_spring[HAND_Z] = 1e-3 * command_mm
            self._mount.engine.mj_step(model, data)
            self._force_n.append(float(data.qfrc_constraint[HELD_JOINTS.start + 2]))
        pads.follow(self._mount.held(), cycle_s)
        model.qpos_spring[HELD_JOINTS] = pads.rest() * np.array([1e-3] * 3 + [1.0] * 3)
        harder = np.array([pads.hardening, 1.0, *[pads.hardening] * 4])
        model.jnt_stiffness[HELD_JOINTS] = self._stiffness * harder
        self._values.append(self._now())
        self._height_mm.append(1e3 * float(data.qpos[HAND_Z]))

    def _now(self) -> FloatArray:
        return np.concatenate(
            [self._mount.wrench_g(), self._pads.seen.ravel(), self._pads.normal_n]
        )

    def _onset(self, noise_n: FloatArray, rule: OnsetRule, cycle_s: float) -> float | None:
        """Return the back-dated onset since the start, once contact is declared."""
        lead = air_samples(rule)
        steps = STEP_S * (np.arange(len(self._force_n)) + 1.0)
        sample_s = (np.arange(round(steps[-1] * rule.rate_hz)) + 1.0) / rule.rate_hz
        force = noise_n[: lead + len(sample_s)].copy()
        force[lead:] += np.interp(sample_s, steps, self._force_n)
        over = force_over_baseline(force[None], rule)
        found = detect_contact(over, rule)
        if found[0] < lead:
            return None
        t_s = np.asarray((np.arange(len(force)) + 1.0 - lead) / rule.rate_hz, dtype=np.float64)
        onset = float(back_date_onset(t_s, over, found, rule)[0])
        return onset if np.isfinite(onset) else None

    def _ended(self, air: FloatArray, onset_s: float, cycle_s: float) -> DescentRecord:
        touched = np.flatnonzero(np.array(self._force_n) > 0.0)
        first_s = STEP_S * float(touched[0]) if len(touched) else 0.0
        zero_s = cycle_s * np.floor(first_s / cycle_s)
        t_s = cycle_s * np.arange(1, len(self._values) + 1) - zero_s
        values, height_mm = np.array(self._values), np.array(self._height_mm)
        return DescentRecord(t_s, values, height_mm, air, onset_s - zero_s, self._settled())

    def _settled(self) -> bool:
        """Return True if contact forces of the engine and pad springs balance."""
        model, data = self._mount.model, self._mount.data
        spring = model.jnt_stiffness[HELD_JOINTS] * (
            data.qpos[HELD_JOINTS] - model.qpos_spring[HELD_JOINTS]
        )
        spring[3:] *= 1e3
        left = np.abs(self._mount.wrench_g() - spring)
        return bool((left[:3] < BALANCE_N).all() and (left[3:] < BALANCE_NMM).all())


class SecondWorldTrials(batch.BatchedTrials):
    """The second world with the interface of the bench."""

    saturates = True  # the markers show strains up to ``SATURATION_MM`` only

    def __init__(self, scenes: Sequence[Scene], probe: ProbeSettings | None = None) -> None:
        super().__init__(scenes, probe)
        tactile = self._first.settings.tactile
        self._gel = build_half_space_gel(tactile.mm_per_px, tactile.pitch_mm, tactile.dilation)

    def press(self, trials: Sequence[int], commands_mm: FloatArray) -> batch.TrialPresses:
        """Press the pieces of ``trials`` at ``commands_mm`` (k, 2); slip persists."""
        rows = np.asarray(trials, dtype=np.intp)
        settings, piece = self._first.settings, self._first.piece
        conditions = self._conditions(rows)
        before = self._carried.take(rows).slip
        true = true_offset_mm(commands_mm, conditions, before) - self._slid_mm[rows]
        noise = [batch.draw_noise(settings, self._rule, self._sensor_rng(i)) for i in rows.tolist()]
        pressed: list[DescentRecord] = []
        slip, toppled = before.copy(), np.zeros(len(rows), dtype=np.bool_)
        for k, trial in enumerate(rows.tolist()):
            own = conditions.take(np.array([k]))
            mounted = build_model(piece, self.bottoms[trial], own, true[k], settings.support)
            pads = CreepingPads(own, before[k], saturates=self.saturates)
            outline = self.scenes[trial].surface
            reach_mm = float(np.hypot(*outline.half_extents_mm))
            high_mm = START_CLEARANCE_MM + float(np.hypot(*own.tilt_rad[0])) * reach_mm
            surface = self.bottoms[trial].bodies[-1].surface
            if not surface.flat:
                high_mm += max(0.0, float(surface_points(outline, surface)[:, 2].max()))
            high_mm += self._probe.approach_mm_s * noise[k].phase_s
            press = SecondWorldPress(mounted, pads, own, self._probe)
            record = press.run(high_mm, noise[k].force_n, self._rule, 1e-6 * settings.cycle_us)
            pressed.append(self._shown(record, own))
            slip[k] = pads.slip
            slide_mm, toppled[k] = bottoms_after_press(mounted, self.bottoms[trial])
            self._slide(rows[k : k + 1], slide_mm[None])
        self._carried = self._carried.replaced(
            rows, replace(GraspHistory.fresh(len(rows)), slip=slip)
        )
        moved = slip[:, :, :2] - before[:, :, :2]
        course = _join_presses(pressed)
        return batch.TrialPresses(
            observation=batch.observe_presses(course, conditions, settings, noise, self._gel),
            detected=np.array([bool(np.isfinite(p.onset_s)) for p in pressed]),
            travel_mm=course.travel_mm,
            truth=batch.PressTruth(
                true_offset_mm(commands_mm, conditions, slip) - self._slid_mm[rows],
                np.asarray(np.hypot(moved[..., 0], moved[..., 1]).max(axis=1)),
                toppled,
                np.array([p.settled for p in pressed]),
            ),
        )

    def _shown(self, record: DescentRecord, conditions: Conditions) -> DescentRecord:
        """Return the record with the inputs of the marker field."""
        return record


def _join_presses(pressed: list[DescentRecord]) -> PressCourse:
    """Join presses; shorter ones are extended with their last values."""
    longest = max(len(p.t_s) for p in pressed)
    index = [np.minimum(np.arange(longest), len(p.t_s) - 1) for p in pressed]
    return PressCourse(
        Timeline(
            np.stack([p.t_s[i] for p, i in zip(pressed, index, strict=True)]),
            np.stack([p.values[i] for p, i in zip(pressed, index, strict=True)]),
        ),
        np.stack([p.ticks_s for p in pressed]),
        np.stack([p.air for p in pressed]),
        np.stack([p.travel_mm for p in pressed]),
    )
