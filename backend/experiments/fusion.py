"""Learned fusion: simulated probe sequences, training of the network, release threshold.

A sequence is one gripping on one mounting with constant tilt and grasp. Most sequences step as a
trial does, by at most 3 mm towards the centre of pressure; the others probe at random places.
Bottoms are circles, rectangles up to 1.5 to 1, rounded rectangles and random convex polygons in
random orientations. An outline that overlaps a held-out one by more than ``SIMILAR_IOU``
(intersection over union, aligned centroids, best of many orientations) is drawn again. The wide
family adds rings, crescents, L, U, stars and feet. Its training target is the margin: the signed
distance of the centre of mass to the convex hull of the contact under the piece's own weight.

Trials for the release threshold never release: the strategy moves on after every press, and its
belief about the centre of mass is stored with the truth, so that all thresholds are compared on the
same trials. They use no bottoms or seeds of the tables. Imports torch.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import pi
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.config import (
    FusedSettings,
    SimulationSettings,
    StackSettings,
    bench_sha256,
    parse_settings,
)
from touchdown.backend.core import CHANNELS, TACTILE_CHANNELS, FloatArray, Outcome
from touchdown.backend.experiments.results import program_version
from touchdown.backend.experiments.strategies import uninformed_model
from touchdown.backend.experiments.tables import job_code
from touchdown.backend.experiments.trials import (
    BatchTrialResult,
    SceneSetup,
    grasped_piece_in,
    refused_presses,
    stack_in_lockstep,
    start_scene,
)
from touchdown.backend.geometry import (
    Body,
    Outline,
    Piece,
    PieceLibrary,
    Tower,
    channel,
    circle,
    contact_margins_mm,
    convex_polygon,
    crescent,
    draw_offset,
    ell,
    enclosed_area_mm2,
    face_points,
    feet,
    inset_mm,
    load_pieces,
    overlap_edges,
    rectangle,
    region,
    ring,
    rotated,
    square,
    star,
)
from touchdown.backend.jobs import JobContext, JobFunctions, JobSpec
from touchdown.backend.learning import (
    DeviceName,
    device_name,
    save_checkpoint,
    select_device,
    use_one_thread,
)
from touchdown.backend.learning.fused import (
    MARGIN_REACH_MM,
    SENSOR_MM,
    TICKS,
    FusedCard,
    FusedTrainer,
    FusedTraining,
    GraspedFace,
    InputPart,
    acting_point_mm,
    data_sha256,
)
from touchdown.backend.placement import (
    XY,
    FusedStrategy,
    GraspedPiece,
    PlaceDecision,
    ProbeObservation,
    convex_hull,
)
from touchdown.backend.sensing import EpisodeLimits
from touchdown.backend.simulation import BatchedTrials, Region, Scene

UNSEEN_BOTTOMS = ("short", "long", "hex20", "rect12x28")
UNSEEN_PIECES = ("pot", "barrel", "mushroom")
SIMILAR_IOU = 0.90
ROTATIONS = 36
SIZES_MM = (8.0, 32.0)  # mean diameter of a bottom
FACES_MM = (10.0, 30.0)
MAX_ASPECT_RATIO = 1.5
WIDTH_MM, HEIGHT_MM = 30.0, 20.0
HEIGHTS_MM, MASSES_G = (15.0, 45.0), (15.0, 60.0)  # of free bottoms


OutlineKinds = Literal["convex", "any"]
REGION_SHARE = 0.5  # of the bottoms of the wide family
MARGIN_STEP_MM = 1.5  # between the nodes of the margins


@dataclass(frozen=True, slots=True)
class ShapeFamily:
    """Random outlines that resemble none of ``unseen_bottoms`` and no face of ``unseen_faces``.

    ``kinds``: of the bottoms, convex or any.
    """

    unseen_bottoms: tuple[Outline, ...]
    unseen_faces: tuple[Outline, ...]
    kinds: OutlineKinds = "convex"

    @classmethod
    def of(cls, catalogue: PieceLibrary, kinds: OutlineKinds = "convex") -> ShapeFamily:
        """Return the family without the bottoms and pieces of the tables."""
        return cls(
            tuple(catalogue.bottom(name).face for name in UNSEEN_BOTTOMS),
            tuple(catalogue.top(name).face for name in UNSEEN_PIECES),
            kinds,
        )

    def bottom(self, rng: np.random.Generator, *, free: bool = False) -> Body:
        """Return a random bottom: fixed to the table, or free to rock and slide, which is several
        times slower.
        """
        if self.kinds == "any" and rng.random() < REGION_SHARE:
            face = draw_region(rng, float(rng.uniform(LEAST_REGION_MM, SIZES_MM[1])))
        else:
            face = _draw_outline(rng, SIZES_MM, self.unseen_bottoms)
        if not free:
            return Body("bottom", face, face, HEIGHT_MM, 0.0, 0.5 * HEIGHT_MM, fixed=True)
        height, mass = float(rng.uniform(*HEIGHTS_MM)), float(rng.uniform(*MASSES_G))
        return Body("bottom", face, face, height, mass, 0.5 * height)

    def piece(self, rng: np.random.Generator) -> Piece:
        """Return a random piece: face, grip height and a centre of mass within 2 mm."""
        face = _draw_outline(rng, FACES_MM, self.unseen_faces, round_share=0.5)
        reach = 2.0 * float(rng.random()) * bool(rng.random() < 0.5)
        angle = float(rng.uniform(0.0, 2.0 * pi))
        return Piece(
            name="piece",
            title="Piece",
            roles=("top",),
            face=face,
            upper=None,
            lower=face,
            height_mm=45.0,
            com_height_mm=22.0,
            com_xy_mm=(reach * float(np.cos(angle)), reach * float(np.sin(angle))),
            mass_g=20.0,
            grip_height_mm=float(rng.uniform(27.0, 43.0)),
            width_mm=WIDTH_MM,
            fixed=False,
            nominal=True,
            sha256="",
            source="family",
        )


def similarity(first: Outline, second: Outline) -> float:
    """Return the intersection over union of two outlines: aligned centroids, best of many
    orientations.
    """
    a, b = _centred(first.polygon(48)), _centred(second.polygon(48))
    angles = 2.0 * pi * np.arange(ROTATIONS) / ROTATIONS
    turns = np.stack([rotated(b, float(angle)) for angle in angles])
    common = float(enclosed_area_mm2(overlap_edges(a[None], turns)).max())
    return common / (area_mm2(a) + area_mm2(b) - common)


def is_similar(first: Outline, second: Outline) -> bool:
    """Return True if the similarity exceeds ``SIMILAR_IOU``; areas that differ too much decide
    early.
    """
    areas = sorted((first.area_mm2, second.area_mm2))
    return areas[0] > SIMILAR_IOU * areas[1] and similarity(first, second) > SIMILAR_IOU


def area_mm2(polygon_mm: FloatArray) -> float:
    """Return the area of an ordered polygon (k, 2)."""
    x, y = polygon_mm.T
    return 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def _draw_outline(
    rng: np.random.Generator,
    sizes_mm: tuple[float, float],
    unseen: tuple[Outline, ...],
    round_share: float = 0.3,
) -> Outline:
    while True:
        size = float(rng.uniform(*sizes_mm))
        outline = circle(size) if rng.random() < round_share else _polygon(rng, size)
        if outline is not None and not any(is_similar(outline, other) for other in unseen):
            return outline


def _polygon(rng: np.random.Generator, size_mm: float) -> Outline | None:
    """Return a rectangle, a rounded one or a random convex polygon of the given mean diameter."""
    kind = int(rng.integers(3))
    ratio = float(rng.uniform(1.0, MAX_ASPECT_RATIO)) ** 0.5
    if kind < 2:
        half = 0.5 * 0.886 * size_mm * np.array([ratio, 1.0 / ratio])
        radius = float(half.min() * rng.uniform(0.2, 0.8)) if kind else 0.0
        corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * (half - radius)
        around = 2.0 * pi * np.arange(32 if kind else 1) / (32 if kind else 1)
        arcs = radius * np.stack([np.cos(around), np.sin(around)], axis=1)
        points = (corners[:, None] + arcs).reshape(-1, 2)
    else:
        angle = np.sort(rng.uniform(0.0, 2.0 * pi, int(rng.integers(5, 12))))
        points = 0.5 * size_mm * np.stack([ratio * np.cos(angle), np.sin(angle) / ratio], axis=1)
    hull = _centred(convex_hull(rotated(points, float(rng.uniform(0.0, 2.0 * pi)))))
    span = hull.max(axis=0) - hull.min(axis=0)
    if len(hull) < 3 or span.min() < 0.5 * size_mm:
        return None
    try:
        return convex_polygon(tuple((float(x), float(y)) for x, y in hull))
    except ValueError:
        return None  # nearly collinear corners


LEAST_REGION_MM = 14.0


def draw_region(rng: np.random.Generator, size_mm: float) -> Outline:
    """Return a ring, crescent, L, U, star or set of feet about ``size_mm`` wide, turned at random.

    T, frames and crosses are left to the tests.
    """
    while True:
        kind, a, b = int(rng.integers(6)), float(rng.uniform()), float(rng.uniform())
        wall = size_mm * (0.2 + 0.2 * a)
        try:
            if kind == 0:
                outline = ring(size_mm, size_mm * (0.3 + 0.5 * a))
            elif kind == 1:
                outline = crescent(size_mm, size_mm * (0.7 + 0.3 * a), size_mm * (0.3 + 0.2 * b))
            elif kind in (2, 3):
                build = ell if kind == 2 else channel
                outline = build(size_mm, size_mm * (0.7 + 0.3 * b), wall)
            elif kind == 4:
                outline = star(4 + int(4 * b), size_mm, size_mm * (0.4 + 0.3 * a))
            else:
                count = 2 + int(3 * b)
                angle = 2.0 * pi * (np.arange(count) + 0.3 * rng.uniform(-1.0, 1.0, count)) / count
                at = 0.5 * (size_mm - wall) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
                outline = feet([(float(x), float(y)) for x, y in at], wall)
            return _turned(outline, float(rng.uniform(0.0, 2.0 * pi)))
        except ValueError:
            continue  # too narrow, or the face centre is outside


def _turned(outline: Outline, angle_rad: float) -> Outline:
    def turn(corners: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
        return [(float(x), float(y)) for x, y in rotated(np.array(corners), angle_rad)]

    return region(
        (turn(outside), [turn(hole) for hole in holes]) for outside, holes in outline.parts
    )


def _centred(polygon_mm: FloatArray) -> FloatArray:
    if len(polygon_mm) < 3:
        return polygon_mm
    x, y = polygon_mm.T
    cross = x * np.roll(y, -1) - np.roll(x, -1) * y
    sums = polygon_mm + np.roll(polygon_mm, -1, axis=0)
    return np.asarray(polygon_mm - (sums * cross[:, None]).sum(axis=0) / (3.0 * cross.sum()))


PROBES = 5
MAX_STEP_MM = 3.0
# share of sequences at random places; share of steps in a random direction
RANDOM_SEQUENCE_SHARE, RANDOM_STEP_SHARE = 0.25, 0.2
AIM_SD_MM = 2.0
MAX_ATTEMPTS = 4
CORNERS = 128
DATA = "sequences.npz"
PROBE_ARRAYS = ("wrench", "field", "offset_mm", "true_mm")
_DRAWS = 79


def probe_sequences(spec: JobSpec, place: JobContext) -> Mapping[str, Any]:
    """Simulate sequences of ``pieces`` random pieces, each over its own bottoms, into one file.

    ``free``: the bottoms rock and slide, as in a trial; ``probes``: length of a sequence.
    """
    p, catalogue = spec.params, load_pieces()
    settings = parse_settings(SimulationSettings, p["bench"], "job")
    use_one_thread()
    kinds = p.get("outlines", "convex")
    family = ShapeFamily.of(catalogue, kinds)
    rng = np.random.default_rng([spec.seed, _DRAWS])
    parts = []
    for number in range(p["pieces"]):
        first = spec.seed + number * p["sequences"]
        seeds = list(range(first, first + p["sequences"]))
        bottoms = [family.bottom(rng, free=p["free"]) for _ in seeds]
        piece = family.piece(rng)
        part = simulate_sequences(piece, bottoms, settings, seeds, rng, p["probes"])
        if kinds == "any":
            part["margin_mm"] = np.stack([margin_field(piece, bottom.lower) for bottom in bottoms])
        parts.append(part)
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    np.savez(place.folder / DATA, **joined)  # type: ignore[arg-type]
    return {
        "bench_sha256": bench_sha256(settings),
        "sequences": len(joined["count"]),
        "probes": int(joined["count"].sum()),
    }


class MixedBottomLockstep(BatchedTrials):
    """Trials over different bottoms, either all fixed to the table or all free."""

    @staticmethod
    def shared(scene: Scene) -> tuple[object, ...]:
        """Return the quantities that are equal in all scenes."""
        return scene.piece, scene.settings, scene.bottoms.bodies[-1].fixed

    def surfaces(self, rows: NDArray[np.intp]) -> Region:
        """Return the outline of each trial's bottom."""
        return _OutlinePerTrial(tuple(self.scenes[row].surface for row in rows.tolist()))


@dataclass(frozen=True, slots=True)
class _OutlinePerTrial:
    """One outline per face of the batch."""

    each: tuple[Outline, ...]

    def contains(self, points_mm: FloatArray, /) -> NDArray[np.bool_]:
        pairs = zip(self.each, points_mm, strict=True)
        return np.stack([outline.contains(points) for outline, points in pairs])


def simulate_sequences(
    piece: Piece,
    bottoms: Sequence[Body],
    settings: SimulationSettings,
    seeds: Sequence[int],
    rng: np.random.Generator,
    probes: int = PROBES,
) -> dict[str, NDArray[Any]]:
    """Return s sequences of one piece as arrays, one row per element of ``bottoms``.

    ``wrench`` (s, P, T, 6) in N and N·m, ``field`` (s, P, T, 252) in px at ``TICKS``, ``offset_mm``
    commanded and ``true_mm`` (s, P, 2), the latter relative to the displaced bottom, ``count``
    (s,): number of valid probes of P = ``probes``; the rest is zero. ``support_mm`` (s, 128, 2):
    outline of the bottom, its last corner repeated; ``reach_mm`` (s, 16), ``com_mm`` (s, 2),
    ``grip_height_mm`` (s,): the face.
    """
    scenes = [
        Scene(piece, Tower((bottom,)), (0.0, 0.0), seed, settings)
        for bottom, seed in zip(bottoms, seeds, strict=True)
    ]
    bench, limits, n = MixedBottomLockstep(scenes), EpisodeLimits(), len(scenes)
    anywhere = rng.random(n) < RANDOM_SEQUENCE_SHARE
    lever = np.asarray(scenes[0].grip_height_mm + SENSOR_MM)
    offset, true = np.zeros((n, probes, 2)), np.zeros((n, probes, 2))
    seen = np.zeros((n, probes, len(TICKS), CHANNELS), np.float32)
    count = np.zeros(n, np.int64)
    for probe in range(probes):
        waiting = np.flatnonzero(count == probe)
        for _ in range(MAX_ATTEMPTS):
            if not len(waiting):
                break
            lowers = [bottoms[k].lower for k in waiting.tolist()]
            free = np.stack([draw_offset(rng, piece.face, lower, 1)[0] for lower in lowers])
            goes = ~anywhere[waiting] & (probe > 0)
            wrench = seen[waiting, probe - 1, :, TACTILE_CHANNELS:]
            acted = acting_point_mm((wrench[:, -1] - wrench[:, 0]).astype(np.float64), lever)
            wanted = next_places(offset[waiting, probe - 1], acted, rng)
            wanted = np.where(goes[:, None], wanted, free)
            press = bench.press(waiting.tolist(), wanted)
            good = ~press.truth.toppled & [not why for why in refused_presses(press, limits)]
            rows = waiting[good]
            offset[rows, probe], true[rows, probe] = wanted[good], press.truth.offset_mm[good]
            seen[rows, probe] = press.observation[good][:, TICKS]
            count[rows] += 1
            waiting = waiting[~good & ~press.truth.toppled]
    height = np.asarray(scenes[0].grip_height_mm)
    face = GraspedFace.of(face_points(piece.face), np.asarray(piece.com_xy_mm), height)
    return {
        "wrench": seen[..., TACTILE_CHANNELS:],
        "field": seen[..., :TACTILE_CHANNELS].astype(np.float16),
        "offset_mm": offset.astype(np.float32),
        "true_mm": true.astype(np.float32),
        "count": count,
        "support_mm": np.stack([corners_mm(bottom.lower) for bottom in bottoms]),
        "reach_mm": np.tile(face.reach_mm.astype(np.float32), (n, 1)),
        "com_mm": np.tile(face.com_mm.astype(np.float32), (n, 1)),
        "grip_height_mm": np.full(n, face.grip_height_mm, np.float32),
    }


def next_places(last: FloatArray, acted: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return (n, 2) places after a step from ``last``: towards the centre of pressure, or random.

    The step depends on measured signals only; otherwise it would reveal the truth to the network.
    """
    n = len(last)
    aim = rng.uniform(0.5, 1.5, (n, 1)) * acted + AIM_SD_MM * rng.standard_normal((n, 2))
    angle = rng.uniform(0.0, 2.0 * pi, n)
    around = rng.uniform(0.5, MAX_STEP_MM, n)[:, None] * np.stack(
        [np.cos(angle), np.sin(angle)], axis=1
    )
    aim = np.where(rng.random((n, 1)) < RANDOM_STEP_SHARE, around, aim)
    length = np.hypot(aim[:, 0], aim[:, 1])[:, None]
    return np.asarray(last + aim * np.minimum(1.0, MAX_STEP_MM / np.maximum(length, 1e-9)))


def margin_field(piece: Piece, bottom: Outline) -> NDArray[np.float16]:
    """Return the margins (m, m) with the centre of mass at the nodes, row y and column x, mm."""
    axis = np.arange(-MARGIN_REACH_MM, MARGIN_REACH_MM + 0.1, MARGIN_STEP_MM)
    places = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    margin = contact_margins_mm(piece.face, piece.com_xy_mm, bottom, places)
    return margin.reshape(len(axis), len(axis)).astype(np.float16)


def corners_mm(outline: Outline) -> NDArray[np.float32]:
    """Return the (128, 2) corners of an outline, the last one repeated as padding."""
    polygon = outline.polygon(CORNERS)
    filled = np.repeat(polygon[-1:], CORNERS - len(polygon), axis=0)
    return np.concatenate([polygon, filled]).astype(np.float32)


def load_sequences(folders: Sequence[Path]) -> dict[str, NDArray[Any]]:
    """Return the sequences of all folders, joined in order and padded with zeros."""
    parts = [dict(np.load(folder / DATA)) for folder in folders]
    longest = max(part["true_mm"].shape[1] for part in parts)
    for part in parts:
        for name in PROBE_ARRAYS:
            missing = longest - part[name].shape[1]
            wide = [(0, 0), (0, missing)] + (part[name].ndim - 2) * [(0, 0)]
            part[name] = np.pad(part[name], wide)
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


# Free bottoms of 30 mm and 30 g, none of the tables.
THRESHOLD_BOTTOMS: Mapping[str, Outline] = {
    "disc 22": circle(22.0),
    "square 17": square(17.0),
    "disc 16": circle(16.0),
    "rectangle 13 x 19": rectangle(13.0, 19.0),
}
WEIGHTS = "fused.safetensors"
THRESHOLD_PIECES = ("mushroom", "barrel", "pot")
THRESHOLD_SEED, CELL_SEEDS = 45_000_000, 10_000
TRIALS_PER_JOB = 8
INSETS_MM = (0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0)
RISKS = (0.1, 0.07, 0.05, 0.03, 0.02, 0.01)
NEVER_MM = 50.0
Json = dict[str, Any]


def threshold_jobs(
    bench: SimulationSettings, code: str, network: str, trials: int
) -> list[JobSpec]:
    """Return the jobs of ``trials`` trials of every piece on every bottom."""
    return [
        JobSpec(
            "fused-trials",
            {
                "bench": bench.model_dump(mode="json"),
                "piece": piece,
                "bottom": bottom,
                "trials": min(TRIALS_PER_JOB, trials - first),
            },
            THRESHOLD_SEED + CELL_SEEDS * (len(THRESHOLD_BOTTOMS) * number + at) + first,
            (network,),
            job_code("fused-trials", code),
        )
        for first in range(0, trials, TRIALS_PER_JOB)
        for number, piece in enumerate(THRESHOLD_PIECES)
        for at, bottom in enumerate(THRESHOLD_BOTTOMS)
    ]


def fused_trials(spec: JobSpec, place: JobContext) -> Mapping[str, Any]:
    """Run trials of one piece on one bottom with the network of the input job."""
    use_one_thread()
    weights = place.store.folder(spec.inputs[0]) / WEIGHTS
    bench = parse_settings(SimulationSettings, spec.params["bench"], "job")
    case = held_out_setup(spec.params["piece"], spec.params["bottom"], bench)
    seeds = [spec.seed + k for k in range(spec.params["trials"])]
    return {"trials": record_trials(case, seeds, weights)}


def held_out_setup(piece: str, bottom: str, bench: SimulationSettings) -> SceneSetup:
    """Return a piece of the catalogue over one of ``THRESHOLD_BOTTOMS``."""
    catalogue = load_pieces()
    face = THRESHOLD_BOTTOMS[bottom]
    below = replace(catalogue.bottom("short"), name="own", face=face, upper=face, lower=face)
    return SceneSetup(catalogue.top(piece), (below,), bench)


def record_trials(case: SceneSetup, seeds: Sequence[int], weights: Path) -> list[Json]:
    """Run one trial per seed; record each press with belief and truth.

    ``exceeds``: probability that the centre of mass lies further inside than each of ``INSETS_MM``.
    """
    scenes = [scene for seed in seeds if (scene := start_scene(case, seed)) is not None]
    never = FusedSettings(weights=str(weights), inset_mm=NEVER_MM)
    settings = StackSettings(strategy="fused", fused=never)
    recorders: list[RecordingFusedStrategy] = []

    def create(scene: Scene, at: XY) -> RecordingFusedStrategy:
        recorders.append(RecordingFusedStrategy(grasped_piece_in(scene, None), settings, at))
        return recorders[-1]

    results = stack_in_lockstep(scenes, uninformed_model(case), settings, EpisodeLimits(), create)
    return [
        _trial_record(case, end, one.exceeds_by_probe)
        for end, one in zip(results, recorders, strict=True)
    ]


class RecordingFusedStrategy(FusedStrategy):
    """Fused strategy that records the inset probabilities of the centre of mass."""

    def __init__(self, held: GraspedPiece, settings: StackSettings, origin_mm: XY) -> None:
        super().__init__(held, settings, origin_mm)
        self.exceeds_by_probe: list[list[float]] = []

    def conclude(self, touched: ProbeObservation) -> PlaceDecision:
        """Return the decision of the fused strategy and record its belief."""
        found = super().conclude(touched)
        inset = self.inset_at(touched.offset_mm)
        if inset is not None:
            self.exceeds_by_probe.append([round(float(inset.exceeds(x)[0]), 5) for x in INSETS_MM])
        return found


def _trial_record(
    case: SceneSetup, end: BatchTrialResult, exceeds_by_probe: Sequence[Sequence[float]]
) -> Json:
    com = np.asarray(case.piece.com_xy_mm)
    places = np.array([step.true_mm for step in end.steps]).reshape(-1, 2)
    true = inset_mm(case.bottoms[0].face, places + com)
    steps = [
        {"inset_mm": round(float(inset), 4), "exceeds": exceeds}
        for inset, exceeds in zip(true, exceeds_by_probe, strict=True)
    ]
    return {"seed": end.seed, "outcome": end.outcome.value, "steps": steps}


def threshold_counts(trials: Sequence[Json]) -> list[Json]:
    """Return the outcome counts for every rule: ``risk`` and required inset."""
    return [
        count_under_threshold(trials, risk, at) for at in range(len(INSETS_MM)) for risk in RISKS
    ]


def count_under_threshold(trials: Iterable[Json], risk: float, at: int) -> Json:
    """Count the outcomes of the trials under one rule, ``INSETS_MM[at]`` and ``risk``."""
    placed, unsafe, other, probes = 0, 0, 0, 0
    for trial in trials:
        steps = enumerate(trial["steps"], start=1)
        let_go = next(((n, s) for n, s in steps if s["exceeds"][at] >= 1.0 - risk), None)
        if let_go is None:
            fell = trial["outcome"] == Outcome.KNOCKED_OVER.value
            unsafe, other = unsafe + fell, other + (not fell)
        elif let_go[1]["inset_mm"] > 0.0:
            placed, probes = placed + 1, probes + let_go[0]
        else:
            unsafe += 1
    return {
        "risk": risk,
        "inset_mm": INSETS_MM[at],
        "placed": placed,
        "unsafe": unsafe,
        "not_released": other,
        "probes": round(probes / placed, 2) if placed else None,
    }


FIRST_SEED, SEEDS_PER_JOB = 40_000_000, 1000  # disjoint from the seeds of all tables
HELD_OUT = 16  # one job in HELD_OUT of each portion is held out: other pieces, bottoms, mountings
REPORTED = 500
FAMILY_TEXT = (
    "faces and bottoms: circles, rectangles up to 1.5 to 1, rounded ones, random convex polygons; "
    "{more}bottoms of 8 to 32 mm, {stands}, faces of 10 to 30 mm; "
    "nothing that covers a shape left out by more than 90 % (intersection over union)"
)
REGION_TEXT = "half of the bottoms rings, crescents, L, U, stars or feet; "
SUPPORT_TEXTS = ("fixed to the table", "most fixed to the table, some free to rock and slide")


@dataclass(frozen=True, slots=True)
class DataPortion:
    """Kind of collection jobs: ``pieces`` per job, each over its own ``bottoms``, with ``probes``
    presses.

    ``first``: first seed; ``most``: number of jobs that fit into the seed range.
    """

    first: int
    most: int
    pieces: int
    bottoms: int
    probes: int
    free: bool  # bottoms rock and slide, as in a trial; such a press takes five times longer


# The first two are alike, so that two machines can start at once.
PORTIONS = {
    "short": DataPortion(0, 60, 3, 80, 5, free=False),
    "more": DataPortion(60, 60, 3, 80, 5, free=False),
    "free": DataPortion(500, 100, 8, 30, 8, free=True),
    "long": DataPortion(600, 400, 8, 30, 8, free=False),
}
COUNTS = {"short": 50, "more": 50}


@dataclass(frozen=True, slots=True)
class FusionRecipe:
    """Jobs of each of ``portions``, followed by a training of ``steps`` steps."""

    bench: SimulationSettings
    code: str
    counts: Mapping[str, int] = field(default_factory=lambda: COUNTS)
    steps: int = 6000
    seed: int = 0
    without: InputPart | None = None  # input left out in an ablation
    device: DeviceName = "auto"
    portions: Mapping[str, DataPortion] = field(default_factory=lambda: PORTIONS)
    outlines: OutlineKinds = "convex"  # of the bottoms

    def jobs(self) -> list[JobSpec]:
        """Return all jobs, the training last."""
        parts = [
            self._part(portion, portion.first + k)
            for name, portion in self.portions.items()
            for k in range(self.counts.get(name, 0))
        ]
        facts = {
            "bench_sha256": bench_sha256(self.bench),
            "steps": self.steps,
            "free": self.counts.get("free", 0),
            "counts": [n for name in self.portions if (n := self.counts.get(name, 0))],
            "without": self.without,
            "device": self.device,
            **self._wide,
        }
        inputs = tuple(part.id for part in parts)
        return [*parts, JobSpec("fuse", facts, self.seed, inputs, job_code("fuse", self.code))]

    def _part(self, portion: DataPortion, place: int) -> JobSpec:
        params = {
            "bench": self.bench.model_dump(mode="json"),
            "pieces": portion.pieces,
            "sequences": portion.bottoms,
            "probes": portion.probes,
            "free": portion.free,
            **self._wide,
        }
        first = FIRST_SEED + SEEDS_PER_JOB * (1000 * self.seed + place)
        return JobSpec("sequences", params, first, (), job_code("sequences", self.code))

    @property
    def _wide(self) -> Json:
        """Parameters of the wide family; none for the convex one, whose jobs keep their ids."""
        return {} if self.outlines == "convex" else {"outlines": self.outlines}

    @staticmethod
    def effort(spec: JobSpec) -> int:
        """Return the relative duration of a job."""
        if spec.kind == "sequences":
            return 8 if spec.params["free"] else 1
        if spec.kind == "fused-trials":
            return int(spec.params["trials"])
        return max(1, int(spec.params["steps"]) // 100)


def split_folders(folders: Sequence[Path], counts: Sequence[int]) -> tuple[list[Path], list[Path]]:
    """Return the folders for training and those held out: the first of each portion."""
    train: list[Path] = []
    held_out: list[Path] = []
    for end, count in zip(np.cumsum(counts), counts, strict=True):
        kept = end - count + max(1, count // HELD_OUT)
        held_out += folders[end - count : kept]
        train += folders[kept:end]
    return train, held_out


def train_fusion(spec: JobSpec, place: JobContext) -> Mapping[str, Any]:
    """Train the network on the sequences of the input jobs."""
    use_one_thread()
    folders = [place.store.folder(source) for source in spec.inputs]
    train, held_out = map(load_sequences, split_folders(folders, spec.params["counts"]))
    without, kinds = spec.params["without"], spec.params.get("outlines", "convex")
    settings = FusedTraining(steps=spec.params["steps"], seed=spec.seed, without=without)
    device = select_device(spec.params["device"])
    trainer = FusedTrainer(train, held_out, settings, device)
    losses = list(trainer.steps())
    metrics = {
        "train_loss": round(float(np.mean(losses[-REPORTED:])), 4),
        "held_out_loss": round(trainer.held_out_loss(), 4),
    }
    card = FusedCard(
        hyper=settings.shape,
        family=FAMILY_TEXT.format(
            more=REGION_TEXT if kinds == "any" else "",
            stands=SUPPORT_TEXTS[bool(spec.params["free"])],
        ),
        outlines=kinds,
        left_out=(*UNSEEN_PIECES, *UNSEEN_BOTTOMS),
        bench_sha256=spec.params["bench_sha256"],
        data_sha256=data_sha256(train),
        seed=spec.seed,
        training={
            "sequences": len(train["count"]),
            "probes": int(train["count"].sum()),
            "held_out_sequences": len(held_out["count"]),
            "steps": settings.steps,
            "batch": settings.batch,
            "learning_rate": settings.learning_rate,
            "without": without,
            "device": device_name(device),
        },
        metrics=metrics,
        program_version=program_version(),
    )
    card = save_checkpoint(place.folder / WEIGHTS, trainer.arrays(), card)
    return {"weights_sha256": card.weights_sha256, **metrics}


FUSED_KINDS: JobFunctions = {
    "sequences": probe_sequences,
    "fuse": train_fusion,
    "fused-trials": fused_trials,
}
