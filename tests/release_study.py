"""Detectability of a piece that begins to turn while the jaws open in stages.

``python -m tests.release_study --out DIR`` writes ``release.json`` and prints a table; it resumes.
Each trial puts a piece down at a random place with a drawn margin, as after an unloading until the
support carries the weight. The jaws open in small held steps. Frames and wrench are compared with
those before the step, or with the first ones after it. A piece counts as caught if the alarm leaves
time to close the jaws before it has turned too far; an alarm at a stable piece is a false stop. The
model is ``tests.staged_release``.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from tests import staged_release
from tests.staged_release import LoosePads, OpeningCourse, OpeningPlan, StandingPiece, open_in_steps
from touchdown.backend.config import (
    ProbeSettings,
    SimulationSettings,
    bench_sha256,
    load_simulation,
    parse_settings,
)
from touchdown.backend.core import FloatArray, package_version, write_atomically
from touchdown.backend.experiments import PIECES
from touchdown.backend.experiments.document import ReportTable
from touchdown.backend.experiments.statistics import estimate_rate
from touchdown.backend.geometry import Piece, load_pieces, overlap_polygon
from touchdown.backend.jobs import JobContext, JobSpec, JobStore, ProcessPool, run_campaign
from touchdown.backend.simulation import gel_from_settings

FORMAT = "touchdown-staged-release/1"
MODEL = Path(staged_release.__file__)
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


KINDS = {"staged-release": simulate_releases}


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
    args = parser.parse_args(argv)
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
