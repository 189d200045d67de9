"""Batch version of the simulated bench, for labelled episodes and for whole trials.

The same physics as the stepped bench. For episodes, the probes of one grip follow each other, since
slip persists, and the grips of one chunk are solved side by side. Each probe has its own generator,
so that results do not depend on the distribution of chunks. For trials, mounting, grip and probe
are drawn as on the stepped bench with the same scene; only the noise within a probe (white, drift,
frame times, lost markers) differs, and nothing is rendered or tracked.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.config import (
    SAMPLES_PER_PROBE,
    ProbeSettings,
    SimulationSettings,
    WristSettings,
)
from touchdown.backend.core import CHANNELS, TACTILE_CHANNELS, FloatArray, OnsetRule
from touchdown.backend.geometry import FLAT, Outline, Surface, Tower, face_points, scene_number
from touchdown.backend.simulation import conditions as nuisance
from touchdown.backend.simulation import marker_fields, pressing
from touchdown.backend.simulation.conditions import Conditions, SeedScope, true_offset_mm
from touchdown.backend.simulation.contact import RESIDUAL_LIMIT
from touchdown.backend.simulation.gripper import start_command_mm
from touchdown.backend.simulation.ground_truth import Scene, scene_mounting
from touchdown.backend.simulation.marker_fields import CameraDraw, Gel, gel_from_settings
from touchdown.backend.simulation.mechanics import ContactState, GraspHistory, Region, begin_probes
from touchdown.backend.simulation.supports import (
    SupportStack,
    join_support_stacks,
    slide_bottoms,
    support_stack,
)
from touchdown.backend.simulation.wrist_sensor import cable_wrench, wrist_wrench

MAX_ATTEMPTS = 20
MIN_OVERLAP_MM2 = 6.0
REGRASP_MM = 1.0  # A piece that slipped farther is gripped again, as an operator would do
LARGEST_FORCE_RATIO = 1.3  # upper bound of the press force over series stiffness times depth


@dataclass(frozen=True, slots=True)
class BatchPlan:
    """Episodes to be simulated for one pair of piece and bottom.

    ``face_points_mm`` (N, 2): lattice of the face; ``width_mm``: distance of the pads.
    ``bottoms``: tower of the touched outline if it can rock and slide; None: rigid. It is reset
    before each probe, as by an operator. A flat bottom gets the heights that the settings draw for
    each mounting.
    """

    piece: str
    bottom: str
    face: Outline
    bottom_outline: Outline
    face_points_mm: FloatArray
    grip_height_mm: float
    width_mm: float
    episodes: int
    seed: int
    probes_per_grip: int = 50
    grips_per_mounting: int = 10
    settings: SimulationSettings = field(default_factory=SimulationSettings)
    probe: ProbeSettings = field(default_factory=ProbeSettings)
    bottoms: Tower | None = None

    @property
    def pair(self) -> int:
        """Number of the pair in seeds."""
        return scene_number(self.piece, self.bottom)

    @property
    def grips(self) -> int:
        """Number of grips."""
        return -(-self.episodes // self.probes_per_grip)

    def probes_of(self, grip: int) -> int:
        """Return the number of probes of ``grip``."""
        return min(self.probes_per_grip, self.episodes - grip * self.probes_per_grip)


@dataclass(frozen=True, slots=True)
class EpisodeBatch:
    """n labelled episodes.

    ``observation`` (n, 20, 258) float32; ``offset_mm`` (n, 2) commanded, ``true_offset_mm`` (n, 2);
    ``patch`` (n, N) bool, overlap at the commanded displacement (the label); ``slip_mm`` (largest
    change of shear slip in this probe), ``residual``: (n,); ``episode``, ``grip``, ``mounting``:
    (n,) numbers within the plan; ``rejected``: probes drawn again, of which ``unsolved`` found
    contact and had no balance in the simulation.
    """

    observation: NDArray[np.float32]
    offset_mm: FloatArray
    true_offset_mm: FloatArray
    patch: NDArray[np.bool_]
    slip_mm: FloatArray
    residual: FloatArray
    episode: NDArray[np.intp]
    grip: NDArray[np.intp]
    mounting: NDArray[np.intp]
    rejected: int
    unsolved: int = 0


@dataclass(frozen=True, slots=True)
class SensorNoise:
    """Sensor errors of one press.

    ``phase_s``: phase of the cycle boundaries relative to the contact; ``force_n``: errors of the
    press force on the sample grid; ``wrench`` (20, 6) at the ticks, N and N·m.
    """

    phase_s: float
    force_n: FloatArray
    wrench: FloatArray
    camera: CameraDraw


@dataclass(frozen=True, slots=True)
class _ProbeNoise:
    """Random numbers of one probe."""

    offset_mm: FloatArray
    probe: nuisance.ProbeDraw
    noise: SensorNoise


def simulate_episodes(
    plan: BatchPlan, grips: Sequence[int] | None = None
) -> Iterator[EpisodeBatch]:
    """Yield the episodes of ``grips`` (default: all), one probe of each grip at a time.

    Probes without contact are drawn again and counted, and so are probes that do not converge or
    exceed the force bound: errors of the simulation, which no device reports. Raises
    ``RuntimeError`` if a probe fails ``MAX_ATTEMPTS`` times.
    """
    chosen = list(range(plan.grips) if grips is None else grips)
    bench = _BatchBench(plan)
    held = {grip: bench.gripping(grip) for grip in chosen}
    carried = GraspHistory.fresh(len(chosen))
    for number in range(max(map(plan.probes_of, chosen), default=0)):
        rows = np.array([i for i, g in enumerate(chosen) if plan.probes_of(g) > number])
        batch, after = bench.probe([chosen[i] for i in rows], number, held, carried.take(rows))
        carried = carried.replaced(rows, after)
        yield batch


class _BatchBench:
    """Common parts of all probes of a plan."""

    def __init__(self, plan: BatchPlan) -> None:
        self.plan = plan
        self.gel = gel_from_settings(plan.settings)
        self.rule = onset_rule(plan.settings, plan.probe)
        tower = plan.bottoms
        self.contact_mm = contact_points(plan.face, plan.settings, plan.face_points_mm)
        self.stand = None if tower is None else support_stack(tower, plan.settings.support)

    def gripping(self, grip: int) -> tuple[nuisance.MountingDraw, nuisance.GripDraw]:
        """Draw mounting and grip number ``grip``."""
        plan = self.plan
        mounting = grip // plan.grips_per_mounting
        at_mounting = nuisance.scoped_generator(plan.seed, SeedScope.MOUNTING, plan.pair, mounting)
        at_grip = nuisance.scoped_generator(
            plan.seed, SeedScope.GRIPPING, plan.pair, mounting, grip
        )
        return (
            nuisance.draw_mounting(plan.settings, at_mounting),
            nuisance.draw_gripping(plan.settings, plan.probe.grip_force_n, at_grip),
        )

    def surface(self, grip: int) -> Surface:
        """Return the heights of the bottom in the mounting of ``grip``."""
        plan = self.plan
        own = plan.bottoms.bodies[-1].surface if plan.bottoms else FLAT
        if not own.flat:
            return own
        mounting = grip // plan.grips_per_mounting
        rng = nuisance.scoped_generator(plan.seed, SeedScope.SURFACE, plan.pair, mounting)
        half_mm = max(plan.bottom_outline.half_extents_mm)
        return nuisance.draw_surface(plan.settings.surface, half_mm, rng)

    def probe(
        self,
        grips: list[int],
        number: int,
        held: dict[int, tuple[nuisance.MountingDraw, nuisance.GripDraw]],
        carried: GraspHistory,
    ) -> tuple[EpisodeBatch, GraspHistory]:
        """Simulate probe ``number`` of each of the ``grips``; failed ones are repeated."""
        parts: dict[int, tuple[EpisodeBatch, GraspHistory, int]] = {}
        waiting = np.arange(len(grips))
        rejected = unsolved = 0
        for attempt in range(MAX_ATTEMPTS):
            names = [grips[i] for i in waiting]
            drawn = [self._draw(grip, number, attempt) for grip in names]
            batch, after, good = self._press(
                names, number, drawn, [held[g] for g in names], carried.take(waiting)
            )
            for k in np.flatnonzero(good):
                parts[int(waiting[k])] = (batch, after, int(k))
            rejected += int((~good).sum())
            unsolved += batch.unsolved
            waiting = waiting[~good]
            if not len(waiting):
                batch, after = _join_rows([parts[i] for i in range(len(grips))])
                return replace(batch, rejected=rejected, unsolved=unsolved), after
        raise RuntimeError(
            f"{len(waiting)} probes of {self.plan.piece} failed {MAX_ATTEMPTS} times"
        )

    def _draw(self, grip: int, number: int, attempt: int) -> _ProbeNoise:
        plan = self.plan
        rng = nuisance.scoped_generator(
            plan.seed, SeedScope.PROBE, plan.pair, grip, number, attempt
        )
        offset = self._draw_offset(rng)
        probe = nuisance.draw_probe(plan.settings, rng)
        return _ProbeNoise(offset, probe, draw_noise(plan.settings, self.rule, rng))

    def _draw_offset(self, rng: np.random.Generator) -> FloatArray:
        """Return (2,) uniform over displacements with enough overlap."""
        plan = self.plan
        reach = np.add(plan.face.half_extents_mm, plan.bottom_outline.half_extents_mm)
        cell = plan.settings.face.lattice_mm**2
        while True:
            tried = reach * (2.0 * rng.random((4, 2)) - 1.0)
            inside = plan.bottom_outline.contains(plan.face_points_mm + tried[:, None, :])
            enough = np.flatnonzero(cell * inside.sum(axis=1) >= MIN_OVERLAP_MM2)
            if len(enough):
                return np.asarray(tried[enough[0]], dtype=np.float64)

    def _press(
        self,
        grips: list[int],
        number: int,
        drawn: list[_ProbeNoise],
        held: list[tuple[nuisance.MountingDraw, nuisance.GripDraw]],
        carried: GraspHistory,
    ) -> tuple[EpisodeBatch, GraspHistory, NDArray[np.bool_]]:
        plan = self.plan
        draws = [(m, g, d.probe) for (m, g), d in zip(held, drawn, strict=True)]
        conditions = nuisance.conditions_from_draws(
            plan.settings, plan.probe, plan.grip_height_mm, plan.width_mm, draws
        )
        commanded = np.stack([d.offset_mm for d in drawn])
        true = true_offset_mm(commanded, conditions, carried.slip)
        state = begin_probes(
            self.contact_mm,
            plan.bottom_outline,
            true,
            conditions,
            carried,
            plan.settings.face.lattice_mm / plan.settings.face.subcells,
            plan.settings.face.subcells,
            [self.surface(grip) for grip in grips],
        ).on(None if self.stand is None else join_support_stacks([self.stand] * len(drawn)))
        pressed = press_with_noise(
            state, [d.noise for d in drawn], plan.settings, plan.probe, self.rule
        )
        slipped = pressed.state.slip[:, :, :2] - carried.slip[:, :, :2]
        after = GraspHistory(pressed.state.slip, pressed.state.relaxed)
        # A piece that slid too far is gripped again.
        slid = np.hypot(after.slip[..., 0], after.slip[..., 1]).max(axis=1) > REGRASP_MM
        after = after.replaced(np.flatnonzero(slid), GraspHistory.fresh(int(slid.sum())))
        mounting = np.array(grips) // plan.grips_per_mounting
        usable = usable_presses(pressed, conditions, plan.probe)
        batch = EpisodeBatch(
            observation=observe_presses(
                pressed, conditions, plan.settings, [d.noise for d in drawn], self.gel
            ),
            offset_mm=commanded,
            true_offset_mm=true,
            patch=plan.bottom_outline.contains(plan.face_points_mm + commanded[:, None, :]),
            slip_mm=np.hypot(slipped[..., 0], slipped[..., 1]).max(axis=1),
            residual=pressed.state.residual,
            episode=np.array(grips) * plan.probes_per_grip + number,
            grip=np.array(grips),
            mounting=mounting,
            rejected=0,
            unsolved=int((pressed.detected & ~usable).sum()),
        )
        return batch, after, usable


def contact_points(
    face: Outline, settings: SimulationSettings, lattice_mm: FloatArray
) -> FloatArray:
    """Return the points of the contact: ``lattice_mm`` (N, 2), or a finer lattice of ``face``."""
    if settings.face.subcells == 1:
        return lattice_mm
    return face_points(face, settings.face.lattice_mm / settings.face.subcells)


def onset_rule(settings: SimulationSettings, probe: ProbeSettings) -> OnsetRule:
    """Return the rule of contact detection."""
    return OnsetRule(threshold_n=probe.threshold_n, rate_hz=settings.wrist.rate_hz)


def draw_noise(
    settings: SimulationSettings, rule: OnsetRule, rng: np.random.Generator
) -> SensorNoise:
    """Draw the sensor errors of one press."""
    cycle_s = 1e-6 * settings.cycle_us
    phase_s = cycle_s * float(rng.random())
    force_n = settings.wrist.white_n * rng.standard_normal(pressing.noise_samples(rule, cycle_s))
    wrench = _wrench_noise(settings, rng)
    return SensorNoise(phase_s, force_n, wrench, marker_fields.draw_camera(settings.tactile, rng))


def press_with_noise(
    state: ContactState,
    noise: Sequence[SensorNoise],
    settings: SimulationSettings,
    probe: ProbeSettings,
    rule: OnsetRule,
) -> pressing.PressBatch:
    """Press B probes with drawn sensor errors."""
    phase_s = np.array([n.phase_s for n in noise])
    force_n = np.stack([n.force_n for n in noise])
    return pressing.press_batch(state, phase_s, force_n, probe, rule, 1e-6 * settings.cycle_us)


def observe_presses(
    pressed: pressing.PressCourse,
    conditions: Conditions,
    settings: SimulationSettings,
    noise: Sequence[SensorNoise],
    gel: Gel,
) -> NDArray[np.float32]:
    """Return the observations (n, 20, 258) of n presses."""
    sight = marker_fields.PadImaging(
        gel,
        conditions.gain,
        conditions.bias_px,
        conditions.grip_force_n,
        settings.tactile.border_px,
    )
    fields = marker_fields.fields_at_ticks(
        pressed.timeline, pressed.air, pressed.ticks_s, [n.camera for n in noise], sight
    )
    at_wrist = _at_wrist(_mean_wrench(pressed), pressed.travel_mm, conditions, settings.wrist)
    at_wrist += conditions.ft_offset[:, None, :]
    at_wrist += np.stack([n.wrench for n in noise])
    count = len(noise)
    seen = np.empty((count, SAMPLES_PER_PROBE, CHANNELS), dtype=np.float32)
    in_order = fields.swapaxes(-1, -2).reshape(count, SAMPLES_PER_PROBE, TACTILE_CHANNELS)
    seen[:, :, :TACTILE_CHANNELS] = in_order
    seen[:, :, TACTILE_CHANNELS:] = at_wrist
    return seen


TARE_HEIGHT_MM = 3.0  # height of the face above first touch at the tare


def _at_wrist(
    wrench_g: FloatArray, travel_mm: FloatArray, conditions: Conditions, wrist: WristSettings
) -> FloatArray:
    """Return (n, 20, 6) at the sensor, whose place differs; the cables pull since the tare."""
    if conditions.cable_n_mm.any():
        moved = np.zeros((*travel_mm.shape, 3))
        moved[..., 2] = -TARE_HEIGHT_MM - travel_mm
        pull = cable_wrench(conditions.cable_n_mm[:, None], moved, wrist.cable_height_mm)
        wrench_g = wrench_g + pull
    lever = conditions.wrist_lever_mm[:, None] if conditions.wrist_lever_mm.any() else None
    yaw = wrist.yaw_rad + conditions.wrist_yaw_rad[:, None]
    return wrist_wrench(wrench_g, wrist.height_mm, yaw, lever)


def _mean_wrench(pressed: pressing.PressCourse) -> FloatArray:
    """Return (n, 20, 6) mean over the 100 samples of 1 ms up to each tick, N and N·mm."""
    # Ten groups of ten samples; the mean of a group is the value at its centre.
    centre = -0.1 + 1e-3 * (10.0 * np.arange(10) + 5.5)
    t_s = (pressed.ticks_s[:, :, None] + centre).reshape(len(pressed.ticks_s), -1)
    values = pressed.timeline.at(t_s)[:, :, :6]
    return np.asarray(
        values.reshape(len(t_s), SAMPLES_PER_PROBE, 10, 6).mean(axis=2), dtype=np.float64
    )


def _wrench_noise(settings: SimulationSettings, rng: np.random.Generator) -> FloatArray:
    """Return (20, 6) error of the 10 Hz wrench without its constant offset, N and N·m."""
    wrist = settings.wrist
    white = np.repeat([wrist.white_n, wrist.white_nm], 3)
    drift = np.repeat([wrist.drift_n_sqrt_min, wrist.drift_nm_sqrt_min], 3)
    per_tick = np.sqrt(0.1 * wrist.rate_hz)
    tare = rng.standard_normal(6) / np.sqrt(0.2 * wrist.rate_hz)
    noise = white * (rng.standard_normal((SAMPLES_PER_PROBE, 6)) / per_tick - tare)
    walk = np.sqrt(marker_fields.SINCE_REFERENCE_S / 60.0)[:, None]
    noise += drift * np.cumsum(walk * rng.standard_normal((SAMPLES_PER_PROBE, 6)), axis=0)
    return np.asarray(noise, dtype=np.float64)


def usable_presses(
    pressed: pressing.PressBatch, conditions: Conditions, probe: ProbeSettings
) -> NDArray[np.bool_]:
    """Return (n,) True for presses that converged, found contact, and are below the force bound."""
    both = 2.0 * conditions.shear_n_mm * (1.0 + conditions.alpha + conditions.creep)
    series = both * conditions.robot_n_mm[:, 2] / (both + conditions.robot_n_mm[:, 2])
    bound = LARGEST_FORCE_RATIO * series * (probe.depth_mm + 0.1)
    largest = pressed.timeline.values[:, :, 2].max(axis=1)
    converged = pressed.state.residual <= RESIDUAL_LIMIT
    return np.asarray(pressed.detected & converged & (largest <= bound))


def _join_rows(
    parts: list[tuple[EpisodeBatch, GraspHistory, int]],
) -> tuple[EpisodeBatch, GraspHistory]:
    def pick(name: str) -> NDArray[np.generic]:
        return np.stack([getattr(batch, name)[k] for batch, _, k in parts])

    names = [n for n in EpisodeBatch.__dataclass_fields__ if n not in ("rejected", "unsolved")]
    joined = EpisodeBatch(**{n: pick(n) for n in names}, rejected=0)  # type: ignore[arg-type]
    slip = np.stack([after.slip[k] for _, after, k in parts])
    return joined, GraspHistory(slip, np.stack([after.relaxed[k] for _, after, k in parts]))


_MOUNTING = 0
_SENSORS = 1


@dataclass(frozen=True, slots=True)
class PressTruth:
    """Simulated truth of k presses, which no sensor measures: for outcomes and scores only.

    ``offset_mm`` (k, 2): displacement of the face afterwards, slip in the hand and sliding of the
    bottom included; ``slip_mm`` (k,): largest slip of a pad in this press; ``toppled`` (k,): the
    supports will not return upright; ``solved`` (k,): an equilibrium was found at every instant.
    """

    offset_mm: FloatArray
    slip_mm: FloatArray
    toppled: NDArray[np.bool_]
    solved: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class TrialPresses:
    """Result of k presses: measurements, and the ``truth``.

    ``observation`` (k, 20, 258) float32; ``detected`` (k,): the arm found contact; ``travel_mm``
    (k, 20): measured travel of the arm at the ticks, downwards from the onset.
    """

    observation: NDArray[np.float32]
    detected: NDArray[np.bool_]
    travel_mm: FloatArray
    truth: PressTruth


@dataclass(frozen=True, slots=True)
class _OutlinePerTrial:
    """One outline per face of the batch."""

    each: tuple[Outline, ...]

    def contains(self, points_mm: FloatArray, /) -> NDArray[np.bool_]:
        pairs = zip(self.each, points_mm, strict=True)
        return np.stack([outline.contains(points) for outline, points in pairs])


class BatchedTrials:
    """Trials with the same piece and settings; scenes differ in seed and tower.

    ``grips``: number of the gripping in each scene, the first by default. Equal scenes with
    different numbers are grippings on one mounting. Raises ValueError for scenes of different
    pieces, settings or numbers of free bodies.
    """

    def __init__(
        self,
        scenes: Sequence[Scene],
        probe: ProbeSettings | None = None,
        grips: Sequence[int] | None = None,
    ) -> None:
        first = scenes[0]
        free = [sum(not body.fixed for body in s.bottoms.bodies) for s in scenes]
        shared = [(s.piece, s.settings, n) for s, n in zip(scenes, free, strict=True)]
        if any(one != shared[0] for one in shared):
            raise ValueError("trials in lockstep share piece, settings and number of free bodies")
        self.scenes, self._first = scenes, first
        self._probe = probe or ProbeSettings()
        points = face_points(first.piece.face, first.settings.face.lattice_mm)
        self._points_mm = contact_points(first.piece.face, first.settings, points)
        self._rule = onset_rule(first.settings, self._probe)
        self._gel = gel_from_settings(first.settings)
        force_n = self._probe.grip_force_n
        self._grips = list(grips or [0] * len(scenes))
        self.grippings = [
            nuisance.draw_gripping(
                s.settings,
                force_n,
                nuisance.scoped_generator(s.seed, SeedScope.GRIPPING, s.number, _MOUNTING, grip),
            )
            for s, grip in zip(scenes, self._grips, strict=True)
        ]
        self._mountings = [scene_mounting(scene) for scene in scenes]
        self._carried = GraspHistory.fresh(len(scenes))
        self._number = [0] * len(scenes)
        # The towers below, as far as they have slid by now.
        self.bottoms = [scene.bottoms for scene in scenes]
        self._slid_mm = np.zeros((len(scenes), 2))
        self._stands = [support_stack(tower, first.settings.support) for tower in self.bottoms]

    def start_commands_mm(self) -> FloatArray:
        """Return (B, 2): commands of the face that place each piece at the start of its scene."""
        return np.stack([start_command_mm(scene)[:2] for scene in self.scenes])

    def press(self, trials: Sequence[int], commands_mm: FloatArray) -> TrialPresses:
        """Press the pieces of ``trials`` at ``commands_mm`` (k, 2); slip persists.

        Each call is a new probe of these trials with its own draws, as on the bench.
        """
        rows = np.asarray(trials, dtype=np.intp)
        settings = self._first.settings
        conditions = self._conditions(rows)
        carried = self._carried.take(rows)
        state = begin_probes(
            self._points_mm,
            self._outlines(rows),
            true_offset_mm(commands_mm, conditions, carried.slip) - self._slid_mm[rows],
            conditions,
            carried,
            settings.face.lattice_mm / settings.face.subcells,
            settings.face.subcells,
            [self.bottoms[i].bodies[-1].surface for i in rows.tolist()],
        ).on(self._stand(rows))
        noise = [draw_noise(settings, self._rule, self._sensor_rng(i)) for i in rows.tolist()]
        pressed = press_with_noise(state, noise, settings, self._probe, self._rule)
        slid = pressed.state.slip[:, :, :2] - carried.slip[:, :, :2]
        after = GraspHistory(pressed.state.slip, pressed.state.relaxed)
        self._carried = self._carried.replaced(rows, after)
        self._slide(rows, pressed.state.pose.slide_mm)
        return TrialPresses(
            observation=observe_presses(pressed, conditions, settings, noise, self._gel),
            detected=pressed.detected,
            travel_mm=pressed.travel_mm,
            truth=PressTruth(
                true_offset_mm(commands_mm, conditions, after.slip) - self._slid_mm[rows],
                np.asarray(np.hypot(slid[..., 0], slid[..., 1]).max(axis=1)),
                pressed.state.toppled,
                pressed.state.residual <= RESIDUAL_LIMIT,
            ),
        )

    def _outlines(self, rows: NDArray[np.intp]) -> Region:
        each = tuple(self.scenes[row].surface for row in rows.tolist())
        return each[0] if each.count(each[0]) == len(each) else _OutlinePerTrial(each)

    def _stand(self, rows: NDArray[np.intp]) -> SupportStack | None:
        stands = [stand for i in rows.tolist() if (stand := self._stands[i]) is not None]
        return join_support_stacks(stands) if stands else None

    def _slide(self, rows: NDArray[np.intp], slide_mm: FloatArray) -> None:
        """Move the supports to the positions they slid to (k, m, 2)."""
        for i, slide in zip(rows.tolist(), slide_mm, strict=True):
            if slide.any():
                self.bottoms[i] = slide_bottoms(self.bottoms[i], slide)
                self._slid_mm[i] += slide.sum(axis=0)
                self._stands[i] = support_stack(self.bottoms[i], self._first.settings.support)

    def _conditions(self, rows: NDArray[np.intp]) -> Conditions:
        draws = []
        for i in rows.tolist():
            self._number[i] += 1
            scene = self.scenes[i]
            place = (scene.number, _MOUNTING, self._grips[i], self._number[i])
            rng = nuisance.scoped_generator(scene.seed, SeedScope.PROBE, *place)
            each = nuisance.draw_probe(scene.settings, rng)
            draws.append((self._mountings[i], self.grippings[i], each))
        piece = self._first.piece
        return nuisance.conditions_from_draws(
            self._first.settings, self._probe, self._first.grip_height_mm, piece.width_mm, draws
        )

    def _sensor_rng(self, trial: int) -> np.random.Generator:
        scene = self.scenes[trial]
        place = (scene.number, _MOUNTING, self._grips[trial], self._number[trial], _SENSORS)
        return nuisance.scoped_generator(scene.seed, SeedScope.PROBE, *place)
