"""Detectability of a piece that begins to turn while the jaws open in stages.

``python -m tests.release_study --out DIR`` writes ``release.json`` and prints a table; it resumes.
Each trial puts a piece down at a random place with a drawn margin, as after an unloading until the
support carries the weight. The jaws open in small held steps. Frames and wrench are compared with
those before the step, or with the first ones after it. A piece counts as caught if the alarm leaves
time to close the jaws before it has turned too far; an alarm at a stable piece is a false stop.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from touchdown.backend.bench import SimulatedBenchChoice, simulated_session
from touchdown.backend.config import (
    ProbeSettings,
    SimulationSettings,
    StackSettings,
    bench_sha256,
    load_simulation,
    parse_settings,
)
from touchdown.backend.core import (
    FloatArray,
    PlaceAction,
    Stability,
    SupportKind,
    package_version,
    write_atomically,
)
from touchdown.backend.experiments import PIECES
from touchdown.backend.experiments.document import ReportTable
from touchdown.backend.experiments.statistics import estimate_rate
from touchdown.backend.geometry import Piece, face_points, load_pieces, overlap_polygon
from touchdown.backend.jobs import JobContext, JobSpec, JobStore, ProcessPool, run_campaign
from touchdown.backend.placement import PlaceDecision, ProbeObservation
from touchdown.backend.placement.belief import Belief
from touchdown.backend.runs import NoEstimator, StackRequest
from touchdown.backend.runs.release import lean_sigmas
from touchdown.backend.runs.requests import STAGES
from touchdown.backend.sensing import TurnDetector
from touchdown.backend.simulation import gel_from_settings, opening
from touchdown.backend.simulation.opening import LoosePads, StandingPiece, TurningPiece

FORMAT = "touchdown-staged-release/1"
MODEL = Path(opening.__file__)
STUDY_BOTTOMS = ("short", "long", "hex20", "rect12x28")
SEED = 8_000_000
UNSTABLE_MM, STABLE_MM = (-2.0, 0.0), (0.0, 4.0)  # ranges of the drawn margins
FIRST_N = (1.0, 1.5)  # pad force before the first step
CARRIED_N = 0.012  # standard deviation of the weight that the hand still carries
# From the exposure of a frame until the jaws are closed: frame and transfer 40 ms, tracker 5 ms,
# command 20 ms, motion of the fingers 30 ms.
REACTION_S = 0.095
CATCH_RAD = np.radians(5.0)  # closing jaws set a piece upright that has turned by less
FALSE_STOPS = 0.05
BEFORE, FIRST_FRAMES = 10, 3  # frames of the two references
DETECTORS = tuple(
    f"{what}, {against}" for against in ("step", "hold") for what in ("markers", "wrench", "both")
)
DIRECTIONS = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)
Json = dict[str, Any]
SUPPORTED_S = 0.5  # time between the unloading and the first step


@dataclass(frozen=True, slots=True)
class OpeningPlan:
    """Opening in steps of the width: ``step_mm`` at ``speed_mm_s``, each held for ``hold_s``.

    ``steps``: number of them. Times count from the start; the first step begins at ``SUPPORTED_S``.
    """

    step_mm: float = 0.1
    hold_s: float = 1.0
    speed_mm_s: float = 5.0
    steps: int = 8

    @property
    def starts_s(self) -> FloatArray:
        """(steps,) times at which the steps begin."""
        return np.asarray(SUPPORTED_S + self.hold_s * np.arange(self.steps), dtype=np.float64)

    @property
    def end_s(self) -> float:
        """End of the last hold."""
        return SUPPORTED_S + self.hold_s * self.steps

    def opened_mm(self, t_s: float) -> float:
        """Return how far the width has grown."""
        if t_s < SUPPORTED_S:
            return 0.0
        whole, rest_s = divmod(t_s - SUPPORTED_S, self.hold_s)
        within = min(self.step_mm, self.speed_mm_s * rest_s)
        return min(self.steps * self.step_mm, whole * self.step_mm + within)


@dataclass(frozen=True, slots=True)
class OpeningCourse:
    """The motion, sampled at ``t_s`` (T,).

    ``angle_rad`` (B, T), constant after the fall; ``strain`` (B, T, 2, 3); ``normal_n`` (B, T, 2);
    ``wrench_g`` (B, T, 6): force (N) and moment (N·mm at the pivot ``G``) of the piece on the hand.
    """

    t_s: FloatArray
    angle_rad: FloatArray
    strain: FloatArray
    normal_n: FloatArray
    wrench_g: FloatArray

    def reached_s(self, angle_rad: float) -> FloatArray:
        """Return the time (B,) at which the angle first has this size; infinite if never."""
        beyond = np.abs(self.angle_rad) >= angle_rad
        return np.where(beyond.any(axis=1), self.t_s[beyond.argmax(axis=1)], np.inf)


def open_in_steps(
    piece: StandingPiece,
    pads: LoosePads,
    plan: OpeningPlan,
    dt_s: float = 2e-4,
    sample_s: float = 0.01,
) -> OpeningCourse:
    """Simulate the opening.

    Parameters
    ----------
    piece, pads : StandingPiece, LoosePads
        B pieces and their grips, at rest and flat on the support.
    plan : OpeningPlan
        Motion of the jaws.
    dt_s : float
        Step of the integration (semi-implicit Euler).
    sample_s : float
        Interval of the result, a multiple of ``dt_s``.

    Returns
    -------
    OpeningCourse

    """
    moving = TurningPiece(piece, pads, dt_s)
    every = round(sample_s / dt_s)
    times, samples = [], []
    for k in range(round(plan.end_s / dt_s) + 1):
        if k % every == 0:
            times.append(k * dt_s)
            samples.append(moving.sample())
        moving.advance(0.5 * plan.opened_mm(k * dt_s))
    angle, strain, normal, wrench = (np.stack(part, axis=1) for part in zip(*samples, strict=True))
    return OpeningCourse(np.array(times), angle, strain, normal, wrench)


@dataclass(frozen=True, slots=True)
class ReleaseStudy:
    """Forced releases: ``unstable`` and ``stable`` ones of each piece and factor of its weight.

    ``left`` scales what the unloading leaves in the pads; 0: a perfect unloading.
    """

    bench: SimulationSettings
    code: str
    pieces: tuple[str, ...] = PIECES
    unstable: int = 70
    stable: int = 170
    weights: tuple[float, ...] = (1.0, 10.0)
    step_mm: float = 0.1
    steps: int = 8
    hold_s: float = 1.0
    left: float = 1.0

    def jobs(self) -> list[JobSpec]:
        """Return one job per piece and weight."""
        return [
            JobSpec(
                "staged-release",
                {
                    "piece": piece,
                    "bench": self.bench.model_dump(mode="json"),
                    "unstable": self.unstable,
                    "stable": self.stable,
                    "factor": factor,
                    "step_mm": self.step_mm,
                    "steps": self.steps,
                    "hold_s": self.hold_s,
                    "left": self.left,
                },
                SEED + PIECES.index(piece),
                (),
                f"{self.code}+{sha256(MODEL.read_bytes()).hexdigest()[:16]}",
            )
            for piece in self.pieces
            for factor in self.weights
        ]

    def answer(self, store: JobStore) -> Json:
        """Return the finished trials with the ROC of each detector and group."""
        done = [spec for spec in self.jobs() if store.has(spec.id)]
        trials = [trial for spec in done for trial in store.result(spec.id)["trials"]]
        return {
            "format": FORMAT,
            "simulated": True,
            "bench_sha256": bench_sha256(self.bench),
            "code": self.code,
            "step_mm": self.step_mm,
            "hold_s": self.hold_s,
            "steps": self.steps,
            "left": self.left,
            "reaction_s": REACTION_S,
            "groups": [
                {"group": name, **roc_of(group, detector)}
                for name, group in _groups(trials)
                for detector in DETECTORS
            ],
            "trials": {key: [trial[key] for trial in trials] for key in trials[0]}
            if trials
            else {},
        }


def simulate_releases(spec: JobSpec, place: JobContext) -> Mapping[str, Any]:
    """Release one piece many times; one row a trial."""
    p = spec.params
    settings = parse_settings(SimulationSettings, p["bench"], "job")
    rng = np.random.default_rng([spec.seed, round(10 * p["factor"])])
    piece = load_pieces().top(p["piece"])
    margins = np.concatenate([rng.uniform(*UNSTABLE_MM, p["unstable"]),
                              rng.uniform(*STABLE_MM, p["stable"])])  # fmt: skip
    standing = draw_standing(piece, margins, p["factor"], rng)
    pads = draw_pads(settings, standing, piece, rng)
    pads.strain[:] *= p["left"]
    plan = OpeningPlan(p["step_mm"], p["hold_s"], steps=p["steps"])
    course = open_in_steps(standing, pads, plan)
    grip_n = np.full(len(margins), ProbeSettings().grip_force_n)
    scores = alarm_scores(course, settings, plan, grip_n, rng)
    late_s = course.reached_s(CATCH_RAD)
    trials = []
    for i, margin in enumerate(margins.tolist()):
        seen = scores.t_s + REACTION_S <= late_s[i]
        best = scores.values[i][:, seen].max(axis=1, initial=0.0)
        trials.append(
            {
                "piece": piece.name,
                "margin_mm": round(margin, 4),
                "axis_deg": round(_folded_deg(float(standing.axis_rad[i])), 2),
                "weight_n": round(float(standing.weight_n[i]), 4),
                "stable": margin > 0.0,
                "turned_deg": round(float(np.degrees(np.abs(course.angle_rad[i]).max())), 3),
                "late_s": round(float(late_s[i]), 3) if np.isfinite(late_s[i]) else None,
                "scores": dict(zip(DETECTORS, np.round(best, 3).tolist(), strict=True)),
            }
        )
    return {"bench_sha256": bench_sha256(settings), "trials": trials}


def draw_standing(
    piece: Piece, margins_mm: FloatArray, factor: float, rng: np.random.Generator
) -> StandingPiece:
    """Return the piece at a random place with each margin, on random bottoms.

    ``factor`` multiplies the mass. The centre of mass is in the middle of the grip.
    """
    catalogue = load_pieces()
    rows = []
    for margin in margins_mm.tolist():
        bottom = catalogue.bottom(STUDY_BOTTOMS[rng.integers(len(STUDY_BOTTOMS))])
        at = place_with_margin(piece, bottom, margin, float(rng.uniform(0.0, 2.0 * np.pi)))
        reach = _reach_mm(piece, bottom, at)
        k = int(reach.argmin())
        opposite = (k + len(DIRECTIONS) // 2) % len(DIRECTIONS)
        rows.append((reach[k] + reach[opposite], DIRECTIONS[k]))
    span_mm, axis_rad = np.array(rows).T
    count, mass_kg = len(margins_mm), 1e-3 * factor * piece.mass_g
    x, y = piece.face.half_extents_mm
    share = 1 / 4 if piece.face.kind == "circle" else 1 / 3
    across = share * np.where(np.abs(np.cos(axis_rad)) > np.sqrt(0.5), x, y) ** 2
    assert piece.grip_height_mm is not None
    sideways = 0.5 * piece.width_mm * np.sin(axis_rad)
    return StandingPiece(
        margin_mm=margins_mm,
        span_mm=span_mm,
        axis_rad=axis_rad,
        com_height_mm=np.full(count, piece.com_height_mm),
        weight_n=np.full(count, 9.80665 * mass_kg),
        inertia_kg_mm2=mass_kg * (across + piece.height_mm**2 / 12.0),
        grip_height_mm=np.full(count, piece.grip_height_mm),
        pads_mm=margins_mm[:, None] - np.stack([sideways, -sideways], axis=1),
    )


def place_with_margin(
    piece: Piece, bottom: Piece, margin_mm: float, direction_rad: float
) -> tuple[float, float]:
    """Return the displacement along a direction at which the piece has this signed margin."""
    along, across = float(np.cos(direction_rad)), float(np.sin(direction_rad))
    low, high = 0.0, 40.0  # the margin falls along the way
    for _ in range(24):
        middle = 0.5 * (low + high)
        if _reach_mm(piece, bottom, (middle * along, middle * across)).min() > margin_mm:
            low = middle
        else:
            high = middle
    return low * along, low * across


def _reach_mm(piece: Piece, bottom: Piece, offset_mm: tuple[float, float]) -> FloatArray:
    """Return the extent of the support beyond the centre of mass in each of ``DIRECTIONS``.

    The smallest value is the signed margin; all are -inf without overlap.
    """
    corners = overlap_polygon(piece.face, offset_mm, bottom.face)
    if not len(corners):
        return np.full(len(DIRECTIONS), -np.inf)
    normals = np.stack([np.cos(DIRECTIONS), np.sin(DIRECTIONS)])
    beyond = (corners - np.add(offset_mm, piece.com_xy_mm)) @ normals
    return np.asarray(beyond.max(axis=0), dtype=np.float64)


def draw_pads(
    settings: SimulationSettings, standing: StandingPiece, piece: Piece, rng: np.random.Generator
) -> LoosePads:
    """Draw the pads after an unloading.

    The face came flat on a support tilted against the hand; the hand still carries a part of the
    weight; the lateral load is within the friction of the foot.
    """
    count, grasp, spread = len(standing.margin_mm), settings.grasp, settings.spread
    gel = np.clip(1.0 + spread.gel * rng.standard_normal(count), 0.7, 1.3)
    shear = gel * grasp.shear_n_mm
    tilt = np.clip(spread.tilt_rad * rng.standard_normal((count, 2)), -0.02, 0.02)
    strain = np.zeros((count, 2, 3))
    lateral = settings.mu * standing.weight_n * rng.uniform(-1.0, 1.0, count)
    strain[:, :, 0] = (0.5 * lateral / shear)[:, None]
    strain[:, :, 1] = (0.5 * CARRIED_N * rng.standard_normal(count) / shear)[:, None]
    strain[:, :, 1] += 0.5 * piece.width_mm * tilt[:, :1] * np.array([1.0, -1.0])
    strain[:, :, 2] = tilt[:, 1:]
    return LoosePads(
        stiffness=np.stack([shear, shear, gel * grasp.torsion_nmm_rad], axis=1),
        normal_n_mm=gel * grasp.normal_n_mm,
        mu_grip=settings.mu_grip * np.clip(1.0 + spread.mu_grip * rng.standard_normal(count),
                                           0.5, 1.5),
        limit_radius_mm=np.full(count, grasp.limit_radius_mm),
        half_width_mm=np.full(count, 0.5 * piece.width_mm),
        force_n=rng.uniform(*FIRST_N, count),
        strain=strain,
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class AlarmScores:
    """Evidence of a change: ``values`` (B, detectors, F), in standard deviations of the noise.

    ``t_s`` (F,): exposure of the last frame used.
    """

    t_s: FloatArray
    values: FloatArray


def alarm_scores(
    course: OpeningCourse,
    settings: SimulationSettings,
    plan: OpeningPlan,
    force_n: FloatArray,
    rng: np.random.Generator,
) -> AlarmScores:
    """Return the scores of all detectors at each frame after a step."""
    markers, wrench = _sight(course, settings, force_n, rng), _feeling(course, settings, rng)
    period_s, per_hold = 1.0 / settings.tactile.rate_hz, settings.tactile.rate_hz * plan.hold_s
    times, values = [], []
    for start_s in plan.starts_s:
        moved_s = start_s + plan.step_mm / plan.speed_mm_s
        before = _frame_at(start_s, period_s) - 1
        first = _frame_at(moved_s + period_s, period_s)
        for last in range(first, _frame_at(start_s, period_s) + int(per_hold)):
            chi2 = []
            hold = first + FIRST_FRAMES
            for reference, begin in ((slice(before - BEFORE + 1, before + 1), first),
                                     (slice(first, hold), hold)):  # fmt: skip
                for signal in (markers, wrench):
                    chi2.append(
                        signal.change(reference, slice(begin, last + 1), period_s)
                        if last >= begin
                        else np.zeros(len(force_n))
                    )
            sights = np.array(chi2).reshape(2, 2, -1)
            both = np.concatenate([sights, sights.sum(axis=1, keepdims=True)], axis=1)
            values.append(np.sqrt(both.reshape(len(DETECTORS), -1).T))
            times.append(last * period_s)
    return AlarmScores(np.array(times), np.stack(values, axis=2))


def _frame_at(t_s: float, period_s: float) -> int:
    return int(np.ceil(t_s / period_s - 1e-9))


@dataclass(frozen=True, slots=True)
class _Signal:
    """``values`` (B, F, n) of each frame; covariances (n, n): ``white`` of a frame, ``walk`` a
    second.
    """

    values: FloatArray
    white: FloatArray
    walk: FloatArray

    def change(self, reference: slice, now: slice, period_s: float) -> FloatArray:
        """Return chi² (B,) of the change of the mean between two groups of frames."""
        change = self.values[:, now].mean(axis=1) - self.values[:, reference].mean(axis=1)
        n, m = now.stop - now.start, reference.stop - reference.start
        apart_s = period_s * (now.start - reference.stop + (n + m) / 3.0)
        covariance = (1.0 / n + 1.0 / m) * self.white + max(apart_s, period_s) * self.walk
        return np.asarray((change * np.linalg.solve(covariance, change.T).T).sum(axis=1))


def _sight(
    course: OpeningCourse,
    settings: SimulationSettings,
    force_n: FloatArray,
    rng: np.random.Generator,
) -> _Signal:
    """Return the pad motions (B, F, 7) that the marker fields show, with noise and drift.

    x, z and torsion of both fingers, and the difference of the two normal forces: both fall with
    every step of the jaws.
    """
    tactile, gel = settings.tactile, gel_from_settings(settings)
    frames = _frames(course, settings)
    squeeze = course.normal_n / force_n[:, None, None]
    true = np.concatenate([course.strain, squeeze[..., None]], axis=-1)[:, frames]
    count, shots = true.shape[:2]
    white, walk = np.zeros((8, 8)), np.zeros((8, 8))
    seen = np.empty((count, shots, 8))
    for k in range(2):
        fit = np.linalg.pinv(gel.map[k])
        part = slice(4 * k, 4 * k + 4)
        white[part, part] = tactile.white_px**2 * fit.T @ fit
        # A drift moves all markers by the same u and v.
        drift = np.stack([fit[0::2].sum(axis=0), fit[1::2].sum(axis=0)])
        step = tactile.drift_px_sqrt_s * drift
        walk[part, part] = step.T @ step
        way = rng.standard_normal((count, shots, 2)) / np.sqrt(tactile.rate_hz)
        noise = rng.standard_normal((count, shots, 4)) @ np.linalg.cholesky(white[part, part]).T
        seen[:, :, part] = true[:, :, k] + noise + np.cumsum(way, axis=1) @ step
    known = np.delete(np.eye(8), 7, axis=0)
    known[3, 7] = -1.0
    return _Signal(seen @ known.T, known @ white @ known.T, known @ walk @ known.T)


def _feeling(
    course: OpeningCourse, settings: SimulationSettings, rng: np.random.Generator
) -> _Signal:
    """Return the noisy wrench (B, F, 6) averaged over a frame period, N and N·mm."""
    wrist, rate_hz = settings.wrist, settings.tactile.rate_hz
    true = course.wrench_g[:, _frames(course, settings)]
    white = np.repeat([wrist.white_n, 1e3 * wrist.white_nm], 3) / np.sqrt(wrist.rate_hz / rate_hz)
    drift = np.repeat([wrist.drift_n_sqrt_min, 1e3 * wrist.drift_nm_sqrt_min], 3) / np.sqrt(60.0)
    way = drift * rng.standard_normal(true.shape) / np.sqrt(rate_hz)
    seen = true + white * rng.standard_normal(true.shape) + np.cumsum(way, axis=1)
    return _Signal(seen, np.diag(white**2), np.diag(drift**2))


def _frames(course: OpeningCourse, settings: SimulationSettings) -> NDArray[np.intp]:
    """Return the samples of the course at the frames."""
    step_s = course.t_s[1] - course.t_s[0]
    shots = int(course.t_s[-1] * settings.tactile.rate_hz + 1e-9) + 1
    at = np.arange(shots) / settings.tactile.rate_hz / step_s
    return np.asarray(np.round(at), dtype=np.intp)


def roc_of(trials: list[Json], detector: str) -> Json:
    """Return the ROC of a detector: area, threshold at 5 % false stops, share caught there."""
    stable = np.array([t["scores"][detector] for t in trials if t["stable"]])
    turning = np.array([t["scores"][detector] for t in trials if not t["stable"]])
    found: Json = {"detector": detector, "stable": len(stable), "unstable": len(turning)}
    if not len(stable) or not len(turning):
        return {**found, "area": None, "threshold": None, "caught": None}
    ranks = rankdata(np.concatenate([turning, stable]))[: len(turning)].sum()
    area = (ranks - 0.5 * len(turning) * (len(turning) + 1)) / (len(turning) * len(stable))
    threshold = float(np.quantile(stable, 1.0 - FALSE_STOPS, method="higher"))
    caught = estimate_rate(int((turning > threshold).sum()), len(turning))
    return {**found, "area": round(float(area), 4), "threshold": round(threshold, 3),
            "caught": caught.as_json()}  # fmt: skip


def _groups(trials: list[Json]) -> Iterator[tuple[str, list[Json]]]:
    """Yield groups of trials; stable ones of the same weight belong to each group of margins."""
    weights = sorted({(t["piece"], t["weight_n"]) for t in trials}, key=lambda w: w[1])
    yield "all", trials
    for light, title in ((True, "weights up to 0.5 N"), (False, "weights above 0.5 N")):
        rows = [t for t in trials if (t["weight_n"] <= 0.5) is light]
        if not rows:
            continue
        yield title, rows
        for low, high in ((-2.0, -1.0), (-1.0, -0.5), (-0.5, 0.0)):
            kept = [t for t in rows if t["stable"] or low <= t["margin_mm"] < high]
            yield f"{title}, margin {low:g} to {high:g} mm", kept
        beyond = [t for t in rows if t["stable"] or t["margin_mm"] < -0.5]
        yield f"{title}, beyond 0.5 mm outside", beyond
        for low, high, axis in ((0, 30, "along the pads"), (30, 60, "between"),
                                (60, 90.01, "towards a finger")):  # fmt: skip
            kept = [t for t in rows if low <= t["axis_deg"] < high]
            yield f"{title}, falls {axis}", kept
    for piece, weight in weights:
        yield f"{piece}, {weight:.2f} N", [t for t in trials if t["weight_n"] == weight]


def _folded_deg(axis_rad: float) -> float:
    """Return the angle between an axis and x, 0 to 90 degrees."""
    return float(np.degrees(np.arcsin(abs(np.sin(axis_rad)))))


def release_table(answer: Json) -> ReportTable:
    """Return the share caught at 5 % false stops by group and detector."""
    names = list(dict.fromkeys(row["group"] for row in answer["groups"]))
    cells = {(row["group"], row["detector"]): row for row in answer["groups"]}
    rows = []
    for name in names:
        counts = cells[name, DETECTORS[0]]
        row = [name, str(counts["unstable"]), str(counts["stable"])]
        for detector in DETECTORS:
            found = cells[name, detector]
            share = found["caught"] and f"{100 * found['caught']['value']:.0f}"
            row.append("-" if share is None else f"{share} ({found['area']:.2f})")
        rows.append(tuple(row))
    return ReportTable.of_texts(
        "Caught % at 5 % false stops (area under the ROC)",
        ("group", "unstable", "stable", *DETECTORS),
        rows,
    )


@dataclass
class ForcedRelease:
    """Strategy that releases after every probe."""

    settings: StackSettings
    regrasps: int = 0

    def conclude(self, touched: ProbeObservation) -> PlaceDecision:
        """Release, with a margin that is always enough."""
        here = touched.offset_mm
        stable = Stability(True, 9.0, SupportKind.AREA, np.zeros((0, 2)), here, "belief")
        belief = Belief.unknown(self.settings.belief, here)
        action = PlaceAction("release", (0.0, 0.0), None, False, "Forced.")
        return PlaceDecision(belief.map, stable, action)


def release_on_bench(spec: JobSpec, place: JobContext) -> Mapping[str, Any]:
    """Press once at a place with about a drawn margin, then release by the simulated bench.

    Returns the true margin, the outcome of the first release, and the largest scores: within the
    holds, of the growth and of the lean (None if the jaws closed before the last step).
    """
    p, rng, catalogue = spec.params, np.random.default_rng([spec.seed, 11]), load_pieces()
    piece, bottom = p["piece"], STUDY_BOTTOMS[rng.integers(len(STUDY_BOTTOMS))]
    margin_mm = rng.uniform(*(STABLE_MM if p["stable"] else UNSTABLE_MM))
    at = place_with_margin(
        catalogue.top(piece), catalogue.bottom(bottom), margin_mm, rng.uniform(0.0, 2.0 * np.pi)
    )
    method = StackSettings.model_validate({"release": p["release"]})
    best: dict[str, float] = {}

    def note(name: str, score: float) -> float:
        best[name] = max(best.get(name, 0.0), round(score, 2))
        return score

    class Watched(TurnDetector):
        def hold(self, since_s: float, now_s: float) -> float:
            return note("hold", super().hold(since_s, now_s))

        def growth(self) -> float:
            return note("growth", super().growth())

    def lean(load: FloatArray) -> float:
        return note("lean", lean_sigmas(load))

    runs = "touchdown.backend.runs"
    with (
        mock.patch("touchdown.backend.placement.make_strategy", return_value=ForcedRelease(method)),
        mock.patch("touchdown.backend.bench.assembly.draw_start", return_value=at),
        mock.patch(f"{runs}.release.TurnDetector", Watched),
        mock.patch(f"{runs}.stack.MOST_TURNS", 1),
        mock.patch(f"{runs}.release.lean_sigmas", lean),
    ):
        session = simulated_session(
            SimulatedBenchChoice(preset=p["preset"]),
            method=method,
            estimate=lambda _: NoEstimator(face_points(catalogue.top(piece).face)),
        )
        (trial,) = session.run(StackRequest(piece, (bottom,), seed=spec.seed)).trials
        session.close()
    return {
        "piece": piece, "bottom": bottom, "seed": spec.seed, "margin_mm": trial.margin_mm,
        "outcome": trial.outcome.name, "reason": trial.reason,
        "hold": best.get("hold"), "growth": best.get("growth"), "lean": best.get("lean"),
    }  # fmt: skip


RIG_SEED, RIG_PRESET = 9_000_000, "bench-v2"
RIG_FORMAT = "touchdown-staged-release-rig/1"


def rig_jobs(
    pieces: Sequence[str], count: int, release: Mapping[str, Any], code: str
) -> list[JobSpec]:
    """Return ``count`` unstable and as many stable releases of each piece, one a job."""
    return [
        JobSpec("rig-release", {"piece": piece, "stable": stable, "preset": RIG_PRESET,
                                "release": dict(release)},
                RIG_SEED + 10_000 * number + 2 * trial + stable, (), code)
        for number, piece in enumerate(pieces)
        for trial in range(count)
        for stable in (False, True)
    ]  # fmt: skip


def rig_answer(jobs: Sequence[JobSpec], store: JobStore) -> Json:
    """Return the finished releases, and by piece: caught, false stops, harm with and without."""
    trials = [dict(store.result(spec.id)) for spec in jobs if store.has(spec.id)]
    ended = {"PLACED", "FELL", "GAVE_UP"}
    groups = []
    for piece in dict.fromkeys(trial["piece"] for trial in trials):
        own = [t for t in trials if t["piece"] == piece and t["outcome"] in ended]
        sides = {
            "unstable": [t for t in own if t["margin_mm"] <= 0.0],
            "beyond": [t for t in own if t["margin_mm"] < -0.5],
            "stable": [t for t in own if t["margin_mm"] > 0.0],
        }
        counts: Json = {name: len(of) for name, of in sides.items()}
        for name, of in sides.items():
            held = sum(t["outcome"] == "GAVE_UP" for t in of)
            counts[f"{name}_held_again"] = estimate_rate(held, len(of)).as_json() if of else None
        fell = sum(t["outcome"] == "FELL" for t in own)
        groups.append({"piece": piece, "fell": fell, **counts})
    return {"format": RIG_FORMAT, "simulated": True, "preset": RIG_PRESET, "groups": groups,
            "trials": trials}  # fmt: skip


KINDS = {"staged-release": simulate_releases, "rig-release": release_on_bench}


def study_rig(pieces: Sequence[str], count: int, out: Path, workers: int) -> int:
    """Run the releases through the rig and print the counts; return 1 if a job failed."""
    release, code = {"stages": STAGES}, package_version("touchdown")
    jobs, store = rig_jobs(pieces, count, release, code), JobStore(out / "jobs")
    for result in run_campaign(jobs, ProcessPool(KINDS, store, workers), store):
        sys.stdout.write(f"{result.kind}: {result.state}\n")
    answer = rig_answer(jobs, store)
    write_atomically(out / "release-rig.json", json.dumps(answer, sort_keys=True).encode() + b"\n")
    for group in answer["groups"]:
        sys.stdout.write(f"{group}\n")
    return 0 if all(store.has(spec.id) for spec in jobs) else 1


def main(argv: list[str] | None = None) -> int:
    """Run the study; return 1 if a job failed."""
    parser = argparse.ArgumentParser(description=__doc__, prog="python -m tests.release_study")
    parser.add_argument("--out", type=Path, default=Path("output/release"))
    parser.add_argument("--pieces", default=",".join(PIECES))
    parser.add_argument("--unstable", type=int, default=70, help="of each piece and weight")
    parser.add_argument("--stable", type=int, default=170)
    parser.add_argument("--weights", default="1,10", help="factors of the weight of the pieces")
    parser.add_argument("--jaw-step", type=float, default=0.1, help="mm of the width")
    parser.add_argument("--jaw-steps", type=int, default=8)
    parser.add_argument("--hold", type=float, default=1.0, help="s after each step")
    parser.add_argument("--left", type=float, default=1.0,
                        help="factor of what the unloading leaves in the pads")  # fmt: skip
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--rig", type=int, default=0, metavar="N", help="instead: N unstable and N "
                        "stable releases of each piece through the simulated bench")  # fmt: skip
    args = parser.parse_args(argv)
    if args.rig:
        return study_rig(args.pieces.split(","), args.rig, args.out, args.workers)
    plan = ReleaseStudy(
        load_simulation(preset="bench-v1"),
        package_version("touchdown"),
        tuple(args.pieces.split(",")),
        args.unstable,
        args.stable,
        tuple(float(text) for text in args.weights.split(",")),
        args.jaw_step,
        args.jaw_steps,
        args.hold,
        args.left,
    )
    store = JobStore(args.out / "jobs")
    for result in run_campaign(plan.jobs(), ProcessPool(KINDS, store, args.workers), store):
        sys.stdout.write(f"{result.kind}: {result.state}\n")
    answer = plan.answer(store)
    text = json.dumps(answer, sort_keys=True).encode() + b"\n"
    write_atomically(args.out / "release.json", text)
    table = release_table(answer)
    lines = [table.title, " | ".join(table.texts()[0]), *map(" | ".join, table.texts()[1])]
    sys.stdout.write("\n".join(lines) + "\n")
    return 0 if all(store.has(spec.id) for spec in plan.jobs()) else 1


if __name__ == "__main__":
    sys.exit(main())
