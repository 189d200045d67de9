"""Learned fusion: simulated probe sequences, and training of the network.

A sequence is one gripping on one mounting with constant tilt and grasp. Most sequences step as a
trial does, by at most 3 mm towards the centre of pressure; the others probe at random places.
Bottoms are drawn from a ``ShapeFamily``. The training target of the wide family is the margin:
the signed distance of the centre of mass to the convex hull of the contact under the piece's own
weight; on a face that is not flat, the shortest shift that changes the result of a release. Needs
torch.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from math import pi
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.backend import config, core, geometry
from touchdown.backend.episodes import TrainingRows
from touchdown.backend.experiments.nuisances import bench_within
from touchdown.backend.experiments.tables import job_code
from touchdown.backend.experiments.trials import refused_presses
from touchdown.backend.jobs import SPEC_FILE, JobContext, JobSpec, JobStore
from touchdown.backend.learning import (
    DeviceName,
    device_name,
    fused,
    save_checkpoint,
    select_device,
    use_one_thread,
)
from touchdown.backend.sensing import EpisodeLimits
from touchdown.backend.simulation import BatchedTrials, Scene, touched_margins_mm, true_com_xy_mm

MARGIN_STEP_MM = 1.5  # between the nodes of the margins
PROBES = 5
MAX_STEP_MM = 3.0
# share of sequences at random places; share of steps in a random direction
RANDOM_SEQUENCE_SHARE, RANDOM_STEP_SHARE = 0.25, 0.2
AIM_SD_MM = 2.0
MAX_ATTEMPTS = 4
CORNERS = 128
DATA = "sequences.npz"
_DRAWS = 79


def probe_sequences(spec: JobSpec, place: JobContext) -> Mapping[str, Any]:
    """Simulate sequences of ``pieces`` random pieces, each over its own bottoms, into one file.

    ``free``: the bottoms rock and slide, as in a trial; ``probes``: length of a sequence;
    ``surface``: shares of faces that are not flat, with pieces of any height of the centre of mass.
    """
    p, catalogue = spec.params, geometry.load_pieces()
    settings = config.parse_settings(config.SimulationSettings, p["bench"], "job")
    if "surface" in p:
        uneven = config.SurfaceSettings.model_validate(p["surface"])
        settings = settings.model_copy(update={"surface": uneven})
    use_one_thread()
    kinds = p.get("outlines", "convex")
    family = geometry.ShapeFamily.of(catalogue, kinds)
    rng = np.random.default_rng([spec.seed, _DRAWS])
    parts = []
    for number in range(p["pieces"]):
        first = spec.seed + number * p["sequences"]
        seeds = list(range(first, first + p["sequences"]))
        bottoms = [family.bottom(rng, free=p["free"]) for _ in seeds]
        piece = family.piece(rng)
        if "surface" in p:
            piece = replace(piece, com_height_mm=float(rng.uniform(*COM_HEIGHTS_MM)))
        scenes = [
            Scene(piece, geometry.Tower((bottom,)), (0.0, 0.0), seed, settings)
            for bottom, seed in zip(bottoms, seeds, strict=True)
        ]
        part = simulate_sequences(scenes, rng, p["probes"])
        if kinds == "any":
            part["margin_mm"] = np.stack(list(map(margin_field, scenes)))
        parts.append(part)
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    np.savez(place.folder / DATA, **joined)  # type: ignore[arg-type]
    return {
        "bench_sha256": config.bench_sha256(settings),
        "sequences": len(joined["count"]),
        "probes": int(joined["count"].sum()),
    }


def simulate_sequences(
    scenes: Sequence[Scene], rng: np.random.Generator, probes: int = PROBES
) -> dict[str, NDArray[Any]]:
    """Return s sequences of one piece as arrays, one row per scene.

    ``wrench`` (s, P, T, 6) in N and N·m, ``field`` (s, P, T, 252) in px at ``TICKS``, ``offset_mm``
    commanded and ``true_mm`` (s, P, 2), the latter relative to the displaced bottom, with the error
    of the entered centre of mass added, so that margins are those of the true one, ``count``
    (s,): number of valid probes of P = ``probes``; the rest is zero. ``support_mm`` (s, 128, 2):
    outline of the bottom, its last corner repeated; ``reach_mm`` (s, 16), ``com_mm`` (s, 2),
    ``grip_height_mm`` (s,): the face. ``true_com_mm`` (s, 2): true centre of mass in ``F``.
    """
    bench, limits, n = BatchedTrials(scenes), EpisodeLimits(), len(scenes)
    piece = scenes[0].piece
    anywhere = rng.random(n) < RANDOM_SEQUENCE_SHARE
    lever = np.asarray(scenes[0].grip_height_mm + fused.SENSOR_MM)
    offset, true = np.zeros((n, probes, 2)), np.zeros((n, probes, 2))
    seen = np.zeros((n, probes, len(fused.TICKS), core.CHANNELS), np.float32)
    count = np.zeros(n, np.int64)
    for probe in range(probes):
        waiting = np.flatnonzero(count == probe)
        for _ in range(MAX_ATTEMPTS):
            if not len(waiting):
                break
            below = [scenes[k].surface for k in waiting.tolist()]
            free = np.stack(
                [geometry.draw_offset(rng, piece.face, outline, 1)[0] for outline in below]
            )
            goes = ~anywhere[waiting] & (probe > 0)
            wrench = seen[waiting, probe - 1, :, core.TACTILE_CHANNELS :]
            acted = fused.acting_point_mm((wrench[:, -1] - wrench[:, 0]).astype(np.float64), lever)
            wanted = next_places(offset[waiting, probe - 1], acted, rng)
            wanted = np.where(goes[:, None], wanted, free)
            press = bench.press(waiting.tolist(), wanted)
            good = np.array([not why for why in refused_presses(press, limits)])
            rows = waiting[good]
            offset[rows, probe], true[rows, probe] = wanted[good], press.truth.offset_mm[good]
            seen[rows, probe] = press.observation[good][:, fused.TICKS]
            count[rows] += 1
            waiting = waiting[~good]
    true_com = np.array([true_com_xy_mm(scene) for scene in scenes])
    com_error = true_com - piece.com_xy_mm
    return {
        "wrench": seen[..., core.TACTILE_CHANNELS :],
        "field": seen[..., : core.TACTILE_CHANNELS].astype(np.float16),
        "offset_mm": offset.astype(np.float32),
        "true_mm": (true + com_error[:, None]).astype(np.float32),
        "count": count,
        "support_mm": np.stack([corners_mm(scene.surface) for scene in scenes]),
        **_face_arrays(piece, n),
        "true_com_mm": true_com,
    }


def _face_arrays(piece: geometry.Piece, n: int) -> dict[str, NDArray[Any]]:
    height_mm, com = np.asarray(piece.grip_height_mm), np.asarray(piece.com_xy_mm)
    face = fused.GraspedFace.of(geometry.face_points(piece.face), com, height_mm)
    return {
        "reach_mm": np.tile(face.reach_mm.astype(np.float32), (n, 1)),
        "com_mm": np.tile(face.com_mm.astype(np.float32), (n, 1)),
        "grip_height_mm": np.full(n, face.grip_height_mm, np.float32),
    }


def next_places(
    last: core.FloatArray, acted: core.FloatArray, rng: np.random.Generator
) -> core.FloatArray:
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


def margin_field(scene: Scene) -> NDArray[np.float16]:
    """Return the margins (m, m) with the centre of mass at the nodes, row y and column x, mm."""
    axis = np.arange(-fused.MARGIN_REACH_MM, fused.MARGIN_REACH_MM + 0.1, MARGIN_STEP_MM)
    places = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    margin = touched_margins_mm(scene, true_com_xy_mm(scene), places)
    return margin.reshape(len(axis), len(axis)).astype(np.float16)


def corners_mm(outline: geometry.Outline) -> NDArray[np.float32]:
    """Return the (128, 2) corners of an outline, the last one repeated as padding."""
    polygon = outline.polygon(CORNERS)
    filled = np.repeat(polygon[-1:], CORNERS - len(polygon), axis=0)
    return np.concatenate([polygon, filled]).astype(np.float32)


def labelled_sequences(
    rows: TrainingRows, library: geometry.PieceLibrary, sensor_mm: float
) -> dict[str, NDArray[Any]]:
    """Return labelled probes as the arrays of ``simulate_sequences``, one sequence a gripping.

    Labels stand for the true displacements, and their steps for the commanded ones. ``sensor_mm``:
    height of the wrist sensor above the grasp pivot. Raises ``InputError`` for a bottom that is not
    convex, or of which the face is not flat.
    """
    groups: dict[tuple[str, ...], list[int]] = {}
    for row, key in enumerate(zip(rows.mounting_id, rows.grip_id, rows.bottom, strict=True)):
        groups.setdefault(key, []).append(row)
    piece, n = library.top(rows.piece), len(groups)
    count = np.array([len(group) for group in groups.values()])
    there = np.arange(count.max()) < count[:, None]
    order = np.concatenate(list(groups.values()))
    seen = rows.inputs(order)[:, fused.TICKS]
    arrays: dict[str, NDArray[Any]] = {
        "wrench": fused.wrench_at_sensor(seen[..., core.TACTILE_CHANNELS :], sensor_mm),
        "field": seen[..., : core.TACTILE_CHANNELS].astype(np.float16),
        "offset_mm": rows.offset_mm[order].astype(np.float32),
    }
    for name, values in arrays.items():
        arrays[name] = np.zeros((*there.shape, *values.shape[1:]), values.dtype)
        arrays[name][there] = values
    support = []
    for _, _, name in groups:
        below = library.bottom(name)
        outline = below.upper or below.face
        if outline.kind == "region" or below.surface != geometry.FLAT:
            raise core.InputError(
                f"The bottom {name} is not convex and flat.", "fine-tuning of fused",
                "Use probes on circles, rectangles and other convex bottoms.",
            )  # fmt: skip
        support.append(corners_mm(outline))
    return {
        **arrays,
        "true_mm": arrays["offset_mm"],
        "count": count,
        "support_mm": np.stack(support),
        **_face_arrays(piece, n),
        "true_com_mm": np.tile(np.asarray(piece.com_xy_mm), (n, 1)),
    }


def read_sequences(folders: Iterable[Path]) -> Iterator[dict[str, NDArray[Any]]]:
    """Yield the sequences of each folder."""
    for folder in folders:
        yield dict(np.load(folder / DATA))


WEIGHTS, LABELLED = "fused.safetensors", ("labelled.npz", "labelled-held-out.npz")
Json = dict[str, Any]
FIRST_SEED, SEEDS_PER_JOB = 40_000_000, 1000  # disjoint from the seeds of all tables
LABELLED_HELD_OUT = 5  # every fifth labelled gripping
HELD_OUT = 16  # one job in HELD_OUT of each portion is held out: other pieces, bottoms, mountings
BATCH = 128
NETWORK_SEEDS = 1000  # between the trainings of an ensemble
REPORTED = 500
FAMILY_TEXT = (
    "faces and bottoms: circles, rectangles up to 1.5 to 1, rounded ones, random convex polygons; "
    "{more}bottoms of 8 to 32 mm, {stands}, faces of 10 to 30 mm; "
    "nothing that covers a shape left out by more than 90 % (intersection over union)"
)
SURFACE_TEXT = ", some tilted, stepped or domed"
REGION_TEXT = (
    "half to two thirds of the bottoms rings, crescents, L, U, stars, feet, triangles or slivers; "
)
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
    free: bool  # bottoms rock and slide, as in a trial; such a press takes three times longer
    uneven: bool = False  # tilted, stepped or domed


# The first two are alike, so that two machines can start at once. The others press 120 bottoms side
# by side: a press on a free bottom takes 6 ms then, with 30 side by side 42 ms.
PORTIONS = {
    "short": DataPortion(0, 60, 3, 80, 5, free=False),
    "more": DataPortion(60, 60, 3, 80, 5, free=False),
    "free": DataPortion(500, 100, 2, 120, 8, free=True),
    "long": DataPortion(600, 400, 2, 120, 8, free=False),
    "longest": DataPortion(300, 200, 2, 120, 12, free=False),
    "surface": DataPortion(120, 180, 2, 120, 8, free=False, uneven=True),
}
# As in resources/benches/bench-v2-surfaces.toml.
UNEVEN = {"tilted_share": 0.3333, "stepped_share": 0.3333, "domed_share": 0.3334}
COM_HEIGHTS_MM = (15.0, 35.0)  # above the face, of the pieces on them
COUNTS = {"short": 50, "more": 50}


@dataclass(frozen=True, slots=True)
class FusionRecipe:
    """Jobs of each of ``portions``, followed by a training of ``steps`` steps; none with 0.

    ``ready``: finished jobs of sequences, perhaps of an earlier version of the program, by portion.
    They replace the portions. ``ranges``: low and high of settings, drawn for each job of
    sequences. ``tuning``: of ``adopt_tuning``; each training then starts from a network.
    """

    bench: config.SimulationSettings
    code: str
    counts: Mapping[str, int] = field(default_factory=lambda: COUNTS)
    steps: int = 6000
    seed: int = 0
    device: DeviceName = "auto"
    portions: Mapping[str, DataPortion] = field(default_factory=lambda: PORTIONS)
    outlines: geometry.OutlineKinds = "convex"  # of the bottoms
    ready: Mapping[str, Sequence[JobSpec]] = field(default_factory=dict)
    batch: int = BATCH  # sequences a step
    networks: int = 1  # of an ensemble, each with its own initial weights and order of the data
    ranges: Mapping[str, Sequence[float]] = field(default_factory=dict)  # settings drawn by job
    tuning: Mapping[str, Any] = field(default_factory=dict)  # adopted network and labelled probes
    wrench_alone: bool = False  # the network does not read the marker fields

    def jobs(self) -> list[JobSpec]:
        """Return the data in turn from each portion, then the training."""
        portions = self.ready or {
            name: [self._part(portion, portion.first + k) for k in range(self.counts.get(name, 0))]
            for name, portion in self.portions.items()
        }
        turns = zip_longest(*portions.values()) if not self.ready else ()
        parts = [part for turn in turns for part in turn if part is not None]
        if not self.steps:
            return parts
        facts = {
            "bench_sha256": config.bench_sha256(self.bench),
            "steps": self.steps,
            "free": len(portions.get("free", ())),
            "counts": [len(some) for some in portions.values() if some],
            **({"surfaces": len(portions["surface"])} if portions.get("surface") else {}),
            "device": self.device,
            **self._wide,
            **({"batch": self.batch} if self.batch != BATCH else {}),
            **({"kick_mm": kick} if (kick := self.bench.release_disturbance_mm) else {}),
            **({"wrench_alone": True} if self.wrench_alone else {}),
            **self.tuning,
        }
        inputs = tuple(part.id for some in portions.values() for part in some)
        code = job_code("fuse", self.code)
        seeds = [self.seed + NETWORK_SEEDS * k for k in range(self.networks)]
        trained = [JobSpec("fuse", facts, seed, inputs, code) for seed in seeds]
        if self.networks == 1:
            return [*parts, *trained]
        members = tuple(job.id for job in trained)
        code = job_code("fuse-join", self.code)
        return [*parts, *trained, JobSpec("fuse-join", {}, self.seed, members, code)]

    def _part(self, portion: DataPortion, place: int) -> JobSpec:
        first = FIRST_SEED + SEEDS_PER_JOB * (1000 * self.seed + place)
        params = {
            "bench": bench_within(self.bench, self.ranges, first).model_dump(mode="json"),
            "pieces": portion.pieces,
            "sequences": portion.bottoms,
            "probes": portion.probes,
            "free": portion.free,
            **({"surface": UNEVEN} if portion.uneven else {}),
            **self._wide,
        }
        return JobSpec("sequences", params, first, (), job_code("sequences", self.code))

    @property
    def _wide(self) -> Json:
        """Parameters of the wide family; none for the convex one, whose jobs keep their ids."""
        return {} if self.outlines == "convex" else {"outlines": self.outlines}


def ready_sequences(
    store: JobStore,
    bench: config.SimulationSettings,
    outlines: geometry.OutlineKinds,
    ranges: Mapping[str, Sequence[float]] | None = None,
) -> dict[str, list[JobSpec]]:
    """Return the finished jobs of sequences of a bench and a family, by portion, by seed.

    Of jobs with the same seed, made by several versions of the program, one is taken.
    """
    found: dict[str, dict[int, JobSpec]] = {name: {} for name in PORTIONS}
    for path in sorted(store.root.glob(f"*/{SPEC_FILE}")):
        spec = JobSpec.parse(path.read_text(encoding="utf-8"))
        p = spec.params
        if spec.kind != "sequences" or not store.has(spec.id):
            continue
        if p["bench"] != bench_within(bench, ranges or {}, spec.seed).model_dump(mode="json"):
            continue
        sizes = p["pieces"], p["sequences"], p["probes"], p["free"]
        for name, portion in PORTIONS.items():
            own = portion.pieces, portion.bottoms, portion.probes, portion.free
            place = (spec.seed - FIRST_SEED) // SEEDS_PER_JOB % 1000 - portion.first
            inside = 0 <= place < portion.most
            if inside and sizes == own and p.get("outlines", "convex") == outlines:
                found[name][spec.seed] = spec
    return {name: [some[seed] for seed in sorted(some)] for name, some in found.items()}


FINE_TUNING_RATE = 2e-4  # a tenth of the rate of a training from scratch [U]


def adopt_tuning(
    store: JobStore,
    network: Path,
    rows: TrainingRows | None,
    sensor_mm: float,
    share: float,
    learning_rate: float = FINE_TUNING_RATE,
) -> Json:
    """Store a network, and labelled probes if any, for jobs that fine-tune it.

    Returns the parameters of these jobs. Every fifth gripping is held out. ``sensor_mm``: height of
    the wrist sensor above the grasp pivot; ``share``: of simulated sequences. Raises ``InputError``
    for probes or a network that cannot be used.
    """
    found = fused.load_fused(network)
    if rows is not None and found.card.outlines != "convex":
        what = "Only networks for convex outlines can be fine-tuned on labelled probes."
        fix = "Name another one."
        raise core.InputError(what, str(network), fix)
    own = {} if rows is None else labelled_sequences(rows, geometry.load_pieces(), sensor_mm)
    count = len(own.get("count", ()))
    held = np.arange(count) % LABELLED_HELD_OUT == LABELLED_HELD_OUT - 1
    if own and not held.any():
        what = f"The labelled probes come from {count} grippings, {LABELLED_HELD_OUT} are needed."
        raise core.InputError(what, "--data", "Label probes of more grippings.")
    facts = {"weights_sha256": found.card.weights_sha256, "data_sha256": fused.data_sha256(own)}
    spec = JobSpec("tuning", facts)
    if not store.has(spec.id):
        with store.writing(spec) as part:
            save_checkpoint(part / WEIGHTS, found.arrays, found.card)
            for name, rest in zip(LABELLED if own else (), (~held, held), strict=False):
                chosen = {key: values[rest] for key, values in own.items()}
                np.savez(part / name, **chosen)
            store.finish(spec, part, {"sequences": count})
    return {"tuning": spec.id, "share": share, "learning_rate": learning_rate}


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
    simulated, kept = split_folders(folders, spec.params["counts"])
    train, held_out = read_sequences(simulated), read_sequences(kept)
    kinds = spec.params.get("outlines", "convex")
    settings = fused.FusedTraining(
        steps=spec.params["steps"],
        batch=spec.params.get("batch", BATCH),
        seed=spec.seed,
        kick_mm=spec.params.get("kick_mm", 0.0),
        wrench_alone=spec.params.get("wrench_alone", False),
    )
    origin, metrics = dict[str, Any](), dict[str, Any]()
    if tuning := spec.params.get("tuning"):
        folder = place.store.folder(tuning)
        start, own = fused.load_fused(folder / WEIGHTS), 0
        if start.card.outlines != kinds:
            what = f"This network is of outlines {start.card.outlines}, the sequences are not."
            raise core.InputError(what, "--from", f"Give --outlines {start.card.outlines}.")
        if (folder / LABELLED[0]).exists():
            labelled, judged = (dict(np.load(folder / name)) for name in LABELLED)
            own, held_out = len(labelled["count"]), iter([judged])
            train = mix_sequences(labelled, simulated, spec.params["share"])
        member = spec.seed // NETWORK_SEEDS % start.card.hyper.networks
        settings = replace(
            settings,
            start=fused.one_network(start, member).arrays,
            shape=replace(start.card.hyper, networks=1),
            learning_rate=spec.params["learning_rate"],
        )
        origin = {"pretrained": start.card.weights_sha256, "labelled_sequences": own}
    device = select_device(spec.params["device"])
    trainer = fused.FusedTrainer(train, held_out, settings, device)
    if tuning:
        metrics["pretrained_held_out_loss"] = round(trainer.held_out_loss(), 4)
    losses = list(trainer.steps())
    metrics |= {
        "train_loss": round(float(np.mean(losses[-REPORTED:])), 4),
        "held_out_loss": round(trainer.held_out_loss(), 4),
    }
    card = fused.FusedCard(
        hyper=settings.shape,
        family=FAMILY_TEXT.format(
            more=REGION_TEXT if kinds == "any" else "",
            stands=SUPPORT_TEXTS[bool(spec.params["free"])]
            + SURFACE_TEXT * ("surfaces" in spec.params),
        ),
        outlines=kinds,
        left_out=(*geometry.UNSEEN_PIECES, *geometry.UNSEEN_BOTTOMS),
        bench_sha256=spec.params["bench_sha256"],
        data_sha256=trainer.data["sha256"],
        seed=spec.seed,
        training={
            "sequences": trainer.data["sequences"],
            "probes": trainer.data["probes"],
            "held_out_sequences": trainer.held_out_count,
            "steps": settings.steps,
            "batch": settings.batch,
            "learning_rate": settings.learning_rate,
            "device": device_name(device),
            "kick_mm": settings.kick_mm,
            "wrench_alone": settings.wrench_alone,
            **origin,
        },
        metrics=metrics,
        program_version=core.program_version(),
    )
    card = save_checkpoint(place.folder / WEIGHTS, trainer.arrays(), card)
    return {"weights_sha256": card.weights_sha256, **metrics}


def mix_sequences(
    own: Mapping[str, NDArray[Any]], folders: Sequence[Path], share: float
) -> Iterator[dict[str, NDArray[Any]]]:
    """Yield the sequences of ``folders`` and those of ``own``, repeated until the former are
    ``share`` of all.
    """
    total = sum(len(np.load(folder / DATA)["count"]) for folder in folders)
    rows = np.arange(max(1, round(total * (1.0 - share) / share))) % len(own["count"])
    for part in read_sequences(folders):
        yield {name: part[name] for name in own}
    yield {name: values[rows] for name, values in own.items()}


def join_trained(spec: JobSpec, place: JobContext) -> Mapping[str, Any]:
    """Join the networks of the input jobs to an ensemble."""
    members = [fused.load_fused(place.store.folder(source) / WEIGHTS) for source in spec.inputs]
    joined = fused.join_networks(members)
    card = save_checkpoint(place.folder / WEIGHTS, joined.arrays, joined.card)
    return {"weights_sha256": card.weights_sha256, **card.metrics}
