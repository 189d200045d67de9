"""Mass simulation of labelled episodes, batched over grips; the same physics as the bench.

The probes of one gripping follow each other (the grip slip goes along), the grips of one chunk are
solved side by side. Every probe has its own generator, so that results do not depend on how chunks
are shared out.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from backend.config.method import SAMPLES_PER_PROBE, ProbeSettings
from backend.config.simulation import SimulationSettings
from backend.core.flow import CHANNELS, TACTILE_CHANNELS, FloatArray
from backend.core.inference import fill_field
from backend.core.onset import OnsetRule
from backend.objects.shapes import Outline
from backend.objects.tower import Tower
from backend.simulation import camera, nuisance
from backend.simulation.camera import CameraDraw
from backend.simulation.conditions import Conditions, true_offset_mm
from backend.simulation.equilibrium import RESIDUAL_LIMIT
from backend.simulation.gel import Gel, build_gel
from backend.simulation.mechanics import Carried, begin
from backend.simulation.nuisance import Scope
from backend.simulation.pressing import Pressed, noise_samples, press
from backend.simulation.support import join_stands, stand_of
from backend.simulation.timeline import Timeline
from backend.simulation.wrench import wrist_wrench

ATTEMPTS = 20
MIN_OVERLAP_MM2 = 6.0
REGRASP_MM = 1.0
"""An operator would grasp the piece anew when it has slipped this far."""
SANITY = 1.3
"""A press force above this times series stiffness times depth is no equilibrium."""


@dataclass(frozen=True, slots=True)
class Plan:
    """What to simulate for one pair of piece and bottom.

    ``face_points_mm`` (N, 2): lattice of the face; ``width_mm``: held between the pads.
    ``bottoms``: what the touched outline belongs to, where it can rock and slide; None: rigid.
    Every probe finds it where it stood: an operator puts it back.
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
        """Number that stands for the pair in seeds."""
        return zlib.crc32(f"{self.piece}/{self.bottom}".encode())

    @property
    def grips(self) -> int:
        """Number of grippings."""
        return -(-self.episodes // self.probes_per_grip)

    def probes_of(self, grip: int) -> int:
        """Return the number of probes of gripping ``grip``."""
        return min(self.probes_per_grip, self.episodes - grip * self.probes_per_grip)


@dataclass(frozen=True, slots=True)
class EpisodeBatch:
    """n labelled episodes.

    ``observation`` (n, 20, 258) float32; ``offset_mm`` (n, 2) commanded, ``true_offset_mm`` (n, 2);
    ``patch`` (n, N) bool, overlap at the commanded displacement (the label); ``onset_error_s``,
    ``slip_mm`` (largest change of shear slip in this probe), ``residual``: (n,); ``episode``,
    ``grip``, ``mounting``: (n,) numbers within the plan; ``rejected``: probes drawn again.
    """

    observation: NDArray[np.float32]
    offset_mm: FloatArray
    true_offset_mm: FloatArray
    patch: NDArray[np.bool_]
    onset_error_s: FloatArray
    slip_mm: FloatArray
    residual: FloatArray
    episode: NDArray[np.intp]
    grip: NDArray[np.intp]
    mounting: NDArray[np.intp]
    rejected: int


@dataclass(frozen=True, slots=True)
class SensorNoise:
    """What the sensors add to one press.

    ``phase_s``: where the cycle boundaries lie relative to the contact; ``force_n``: errors of the
    press force on the sample grid; ``wrench`` (20, 6) at the ticks, N and N·m.
    """

    phase_s: float
    force_n: FloatArray
    wrench: FloatArray
    camera: CameraDraw


@dataclass(frozen=True, slots=True)
class Eye:
    """How marker fields arise (``gel``) and how unseen markers are filled in (``infer``)."""

    gel: Gel
    infer: camera.Infer = fill_field


@dataclass(frozen=True, slots=True)
class _Drawn:
    """All that is random in one probe."""

    offset_mm: FloatArray
    probe: nuisance.ProbeDraw
    noise: SensorNoise


def simulate(
    plan: Plan,
    grips: Sequence[int] | None = None,
    infer: camera.Infer = fill_field,
) -> Iterator[EpisodeBatch]:
    """Yield the episodes of the named ``grips`` (default: all), one probe of every grip at a time.

    Probes that do not converge, find no contact or exceed the sanity bound are drawn again and
    counted. Raises ``RuntimeError`` if a probe fails ``ATTEMPTS`` times.
    """
    chosen = list(range(plan.grips) if grips is None else grips)
    bench = _Bench(plan, infer)
    held = {grip: bench.gripping(grip) for grip in chosen}
    carried = Carried.fresh(len(chosen))
    for number in range(max(map(plan.probes_of, chosen), default=0)):
        rows = np.array([i for i, g in enumerate(chosen) if plan.probes_of(g) > number])
        batch, after = bench.probe([chosen[i] for i in rows], number, held, carried.take(rows))
        carried = carried.replaced(rows, after)
        yield batch


class _Bench:
    """The parts of a plan that every probe needs."""

    def __init__(self, plan: Plan, infer: camera.Infer) -> None:
        self.plan = plan
        self.eye = Eye(gel_of(plan.settings), infer)
        self.rule = rule_of(plan.settings, plan.probe)
        self.cycle_s = 1e-6 * plan.settings.cycle_us
        tower = plan.bottoms
        self.stand = None if tower is None else stand_of(tower, plan.settings.support)

    def gripping(self, grip: int) -> tuple[nuisance.Mounting, nuisance.Gripping]:
        """Draw mounting and gripping number ``grip``."""
        plan = self.plan
        mounting = grip // plan.grips_per_mounting
        at_mounting = nuisance.generator(plan.seed, Scope.MOUNTING, plan.pair, mounting)
        at_grip = nuisance.generator(plan.seed, Scope.GRIPPING, plan.pair, mounting, grip)
        return (
            nuisance.draw_mounting(plan.settings, at_mounting),
            nuisance.draw_gripping(plan.settings, plan.probe.grip_force_n, at_grip),
        )

    def probe(
        self,
        grips: list[int],
        number: int,
        held: dict[int, tuple[nuisance.Mounting, nuisance.Gripping]],
        carried: Carried,
    ) -> tuple[EpisodeBatch, Carried]:
        """Simulate probe ``number`` of each of the ``grips``, again where it failed."""
        parts: dict[int, tuple[EpisodeBatch, Carried, int]] = {}
        waiting = np.arange(len(grips))
        rejected = 0
        for attempt in range(ATTEMPTS):
            names = [grips[i] for i in waiting]
            drawn = [self._draw(grip, number, attempt) for grip in names]
            batch, after, good = self._press(
                names, number, drawn, [held[g] for g in names], carried.take(waiting)
            )
            for k in np.flatnonzero(good):
                parts[int(waiting[k])] = (batch, after, int(k))
            rejected += int((~good).sum())
            waiting = waiting[~good]
            if not len(waiting):
                return _joined([parts[i] for i in range(len(grips))], rejected)
        raise RuntimeError(f"{len(waiting)} probes of {self.plan.piece} failed {ATTEMPTS} times")

    def _draw(self, grip: int, number: int, attempt: int) -> _Drawn:
        plan = self.plan
        rng = nuisance.generator(plan.seed, Scope.PROBE, plan.pair, grip, number, attempt)
        offset = self._draw_offset(rng)
        probe = nuisance.draw_probe(plan.settings, rng)
        return _Drawn(offset, probe, draw_noise(plan.settings, self.rule, rng))

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
        drawn: list[_Drawn],
        held: list[tuple[nuisance.Mounting, nuisance.Gripping]],
        carried: Carried,
    ) -> tuple[EpisodeBatch, Carried, NDArray[np.bool_]]:
        plan = self.plan
        draws = [(m, g, d.probe) for (m, g), d in zip(held, drawn, strict=True)]
        conditions = nuisance.conditions_of(
            plan.settings, plan.probe, plan.grip_height_mm, plan.width_mm, draws
        )
        commanded = np.stack([d.offset_mm for d in drawn])
        true = true_offset_mm(commanded, conditions, carried.slip)
        state = begin(
            plan.face_points_mm,
            plan.bottom_outline,
            true,
            conditions,
            carried,
            plan.settings.face.lattice_mm,
        ).on(None if self.stand is None else join_stands([self.stand] * len(drawn)))
        pressed = press(
            state,
            np.array([d.noise.phase_s for d in drawn]),
            np.stack([d.noise.force_n for d in drawn]),
            plan.probe,
            self.rule,
            self.cycle_s,
        )
        slipped = pressed.state.slip[:, :, :2] - carried.slip[:, :, :2]
        after = _regrasped(Carried(pressed.state.slip, pressed.state.relaxed))
        mounting = np.array(grips) // plan.grips_per_mounting
        batch = EpisodeBatch(
            observation=observe(
                pressed, conditions, plan.settings, [d.noise for d in drawn], self.eye
            ),
            offset_mm=commanded,
            true_offset_mm=true,
            patch=plan.bottom_outline.contains(plan.face_points_mm + commanded[:, None, :]),
            onset_error_s=pressed.onset_s - pressed.touch_s,
            slip_mm=np.hypot(slipped[..., 0], slipped[..., 1]).max(axis=1),
            residual=pressed.state.residual,
            episode=np.array(grips) * plan.probes_per_grip + number,
            grip=np.array(grips),
            mounting=mounting,
            rejected=0,
        )
        return batch, after, usable(pressed, conditions, plan.probe)


def gel_of(settings: SimulationSettings) -> Gel:
    """Return the gel that the settings describe."""
    tactile = settings.tactile
    return build_gel(tactile.mm_per_px, tactile.pitch_mm, tactile.roll_off_mm, tactile.dilation)


def rule_of(settings: SimulationSettings, probe: ProbeSettings) -> OnsetRule:
    """Return how the wrist sensor's samples become a contact."""
    return OnsetRule(threshold_n=probe.threshold_n, rate_hz=settings.wrist.rate_hz)


def draw_noise(
    settings: SimulationSettings, rule: OnsetRule, rng: np.random.Generator
) -> SensorNoise:
    """Draw what the sensors add to one press."""
    cycle_s = 1e-6 * settings.cycle_us
    phase_s = cycle_s * float(rng.random())
    force_n = settings.wrist.white_n * rng.standard_normal(noise_samples(rule, cycle_s))
    wrench = _wrench_noise(settings, rng)
    return SensorNoise(phase_s, force_n, wrench, camera.draw_camera(settings.tactile, rng))


class Course(Protocol):
    """What ``observe`` reads of B presses; ``Pressed`` is one."""

    @property
    def timeline(self) -> Timeline:
        """Wrench, strain and pad forces over time."""

    @property
    def ticks_s(self) -> FloatArray:
        """(B, 20) instants of the model's input."""

    @property
    def air(self) -> FloatArray:
        """(B, 14) values before the descent."""


def observe(
    pressed: Course,
    conditions: Conditions,
    settings: SimulationSettings,
    noise: Sequence[SensorNoise],
    eye: Eye,
) -> NDArray[np.float32]:
    """Return (n, 20, 258) as the model sees n presses."""
    sight = camera.Sight(
        eye.gel,
        conditions.gain,
        conditions.bias_px,
        conditions.grip_force_n,
        settings.tactile.border_px,
        eye.infer,
    )
    fields = camera.fields_at_ticks(
        pressed.timeline, pressed.air, pressed.ticks_s, [n.camera for n in noise], sight
    )
    at_wrist = wrist_wrench(_mean_wrench(pressed), settings.wrist.height_mm, settings.wrist.yaw_rad)
    at_wrist += conditions.ft_offset[:, None, :]
    at_wrist += np.stack([n.wrench for n in noise])
    count = len(noise)
    seen = np.empty((count, SAMPLES_PER_PROBE, CHANNELS), dtype=np.float32)
    in_order = fields.swapaxes(-1, -2).reshape(count, SAMPLES_PER_PROBE, TACTILE_CHANNELS)
    seen[:, :, :TACTILE_CHANNELS] = in_order
    seen[:, :, TACTILE_CHANNELS:] = at_wrist
    return seen


def _regrasped(carried: Carried) -> Carried:
    """Put a piece that has slipped too far back into the jig: the same grip without slip."""
    slid = np.hypot(carried.slip[..., 0], carried.slip[..., 1]).max(axis=1) > REGRASP_MM
    return carried.replaced(np.flatnonzero(slid), Carried.fresh(int(slid.sum())))


def _mean_wrench(pressed: Course) -> FloatArray:
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
    walk = np.sqrt(np.r_[1.6, np.full(SAMPLES_PER_PROBE - 1, 0.1)] / 60.0)[:, None]
    noise += drift * np.cumsum(walk * rng.standard_normal((SAMPLES_PER_PROBE, 6)), axis=0)
    return np.asarray(noise, dtype=np.float64)


def usable(pressed: Pressed, conditions: Conditions, probe: ProbeSettings) -> NDArray[np.bool_]:
    """Return (n,) which presses converged, found contact and stay below the sanity bound."""
    both = 2.0 * conditions.shear_n_mm * (1.0 + conditions.alpha)
    series = both * conditions.robot_n_mm[:, 2] / (both + conditions.robot_n_mm[:, 2])
    bound = SANITY * series * (probe.depth_mm + 0.1)
    largest = pressed.timeline.values[:, :, 2].max(axis=1)
    converged = pressed.state.residual <= RESIDUAL_LIMIT
    return np.asarray(pressed.detected & converged & (largest <= bound))


def _joined(
    parts: list[tuple[EpisodeBatch, Carried, int]], rejected: int
) -> tuple[EpisodeBatch, Carried]:
    """Pick row k of each part, in order."""

    def pick(name: str) -> NDArray[np.generic]:
        return np.stack([getattr(batch, name)[k] for batch, _, k in parts])

    names = [n for n in EpisodeBatch.__dataclass_fields__ if n != "rejected"]
    joined = EpisodeBatch(**{n: pick(n) for n in names}, rejected=rejected)  # type: ignore[arg-type]
    slip = np.stack([after.slip[k] for _, after, k in parts])
    return joined, Carried(slip, np.stack([after.relaxed[k] for _, after, k in parts]))
