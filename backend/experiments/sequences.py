"""Sequences of probes to learn fusion from: many mountings, grippings, pieces and bottoms.

A sequence is one gripping on one mounting of its own, whose tilt and grasp stay the same from probe
to probe as on the bench. Most sequences go about as a trial does: from any place in steps of
at most 3 mm, more or less to where the press acted; the others probe anywhere.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import pi
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from backend.config.bench_facts import bench_sha256
from backend.config.load import parse
from backend.config.simulation import SimulationSettings
from backend.core.flow import CHANNELS, TACTILE_CHANNELS, FloatArray
from backend.experiments.family import Family
from backend.jobs.running import Workplace
from backend.jobs.spec import JobSpec
from backend.learning.device import one_thread
from backend.learning.fused.summary import SENSOR_MM, TICKS, Face, acting_mm
from backend.objects.catalogue import Piece, load_catalogue
from backend.objects.shapes import Outline
from backend.objects.starts import draw_offset
from backend.objects.surface import face_points
from backend.objects.tower import Body, Tower
from backend.sensing.episode import EpisodeLimits
from backend.simulation.lockstep import Lockstep
from backend.simulation.mechanics import Region
from backend.simulation.scene import Scene

PROBES = 5
LONGEST_MM = 3.0
ANYWHERE, ASTRAY = 0.25, 0.2
"""Share of sequences that probe anywhere; share of steps in any direction."""
AIM_SD_MM = 2.0
ATTEMPTS = 4
CORNERS = 128
DATA = "sequences.npz"
OF_PROBES = ("wrench", "field", "offset_mm", "true_mm")
_DRAWS = 79


def probe_sequences(spec: JobSpec, place: Workplace) -> Mapping[str, Any]:
    """Press sequences of ``pieces`` random pieces, each over bottoms of its own; one file.

    ``free``: the bottoms rock and slide, as in a trial; ``probes``: how many a sequence has.
    """
    p, catalogue = spec.params, load_catalogue()
    settings = parse(SimulationSettings, p["bench"], "job")
    one_thread()
    family = Family.of(catalogue)
    rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence([spec.seed, _DRAWS])))
    parts = []
    for number in range(p["pieces"]):
        first = spec.seed + number * p["sequences"]
        seeds = list(range(first, first + p["sequences"]))
        bottoms = [family.bottom(rng, free=p["free"]) for _ in seeds]
        piece = family.piece(rng)
        parts.append(sequences_of(piece, bottoms, settings, seeds, rng, p["probes"]))
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    np.savez(place.folder / DATA, **joined)  # type: ignore[arg-type]
    return {
        "bench_sha256": bench_sha256(settings),
        "sequences": len(joined["count"]),
        "probes": int(joined["count"].sum()),
    }


class Mixed(Lockstep):
    """Trials over bottoms of their own, all fixed to the table or none of them."""

    @staticmethod
    def shared(scene: Scene) -> tuple[object, ...]:
        """Return what must be the same in all scenes."""
        return scene.piece, scene.settings, scene.bottoms.bodies[-1].fixed

    def surfaces(self, rows: NDArray[np.intp]) -> Region:
        """Return the outline of each trial's own bottom."""
        return _Outlines(tuple(self.scenes[row].surface for row in rows.tolist()))


@dataclass(frozen=True, slots=True)
class _Outlines:
    """An outline of its own under each face."""

    each: tuple[Outline, ...]

    def contains(self, points_mm: FloatArray, /) -> NDArray[np.bool_]:
        pairs = zip(self.each, points_mm, strict=True)
        return np.stack([outline.contains(points) for outline, points in pairs])


def sequences_of(
    piece: Piece,
    bottoms: Sequence[Body],
    settings: SimulationSettings,
    seeds: Sequence[int],
    rng: np.random.Generator,
    probes: int = PROBES,
) -> dict[str, NDArray[Any]]:
    """Return s sequences of one piece as arrays, one row for each of ``bottoms``.

    ``wrench`` (s, P, T, 6) in N and N·m, ``field`` (s, P, T, 252) in px at ``TICKS``,
    ``offset_mm`` commanded and ``true_mm`` (s, P, 2), the latter from where the bottom has slid
    to, ``count`` (s,): how many of P = ``probes`` a sequence has, the rest is zero.
    ``support_mm`` (s, 128, 2): outline of the bottom, its last corner repeated; ``reach_mm``
    (s, 16), ``com_mm`` (s, 2), ``grip_height_mm`` (s,): the face.
    """
    scenes = [
        Scene(piece, Tower((bottom,)), (0.0, 0.0), seed, settings)
        for bottom, seed in zip(bottoms, seeds, strict=True)
    ]
    bench, limits, n = Mixed(scenes), EpisodeLimits(), len(scenes)
    anywhere, lever = rng.random(n) < ANYWHERE, np.asarray(scenes[0].grip_height_mm + SENSOR_MM)
    offset, true = np.zeros((n, probes, 2)), np.zeros((n, probes, 2))
    seen = np.zeros((n, probes, len(TICKS), CHANNELS), np.float32)
    count = np.zeros(n, np.int64)
    for probe in range(probes):
        waiting = np.flatnonzero(count == probe)
        for _ in range(ATTEMPTS):
            if not len(waiting):
                break
            free = np.stack(
                [draw_offset(rng, piece.face, bottoms[k].lower, 1)[0] for k in waiting.tolist()]
            )
            goes = ~anywhere[waiting] & (probe > 0)
            wrench = seen[waiting, probe - 1, :, TACTILE_CHANNELS:]
            acted = acting_mm((wrench[:, -1] - wrench[:, 0]).astype(np.float64), lever)
            wanted = stepped(offset[waiting, probe - 1], acted, rng)
            wanted = np.where(goes[:, None], wanted, free)
            felt = bench.press(waiting.tolist(), wanted)
            good = felt.valid & (felt.press_n >= limits.contact_n) & ~felt.toppled
            good &= felt.slip_mm <= limits.slip_mm
            rows = waiting[good]
            offset[rows, probe], true[rows, probe] = wanted[good], felt.true_mm[good]
            seen[rows, probe] = felt.observation[good][:, TICKS]
            count[rows] += 1
            waiting = waiting[~good & ~felt.toppled]
    height = np.asarray(scenes[0].grip_height_mm)
    face = Face.of(face_points(piece.face), np.asarray(piece.com_xy_mm), height)
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


def stepped(last: FloatArray, acted: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return (n, 2) places after a step from ``last``: about to where the press acted, or astray.

    Nothing but what was felt decides: a step that knew the truth would tell it to the network.
    """
    n = len(last)
    aim = rng.uniform(0.5, 1.5, (n, 1)) * acted + AIM_SD_MM * rng.standard_normal((n, 2))
    angle = rng.uniform(0.0, 2.0 * pi, n)
    around = rng.uniform(0.5, LONGEST_MM, n)[:, None] * np.stack(
        [np.cos(angle), np.sin(angle)], axis=1
    )
    aim = np.where(rng.random((n, 1)) < ASTRAY, around, aim)
    length = np.hypot(aim[:, 0], aim[:, 1])[:, None]
    return np.asarray(last + aim * np.minimum(1.0, LONGEST_MM / np.maximum(length, 1e-9)))


def corners_mm(outline: Outline) -> NDArray[np.float32]:
    """Return (128, 2) corners of an outline, the last one repeated where it has fewer."""
    polygon = outline.polygon(CORNERS)
    filled = np.repeat(polygon[-1:], CORNERS - len(polygon), axis=0)
    return np.concatenate([polygon, filled]).astype(np.float32)


def load_sequences(folders: Sequence[Path]) -> dict[str, NDArray[Any]]:
    """Return the sequences of all folders, joined in order; shorter ones end in zeros."""
    parts = [dict(np.load(folder / DATA)) for folder in folders]
    longest = max(part["true_mm"].shape[1] for part in parts)
    for part in parts:
        for name in OF_PROBES:
            missing = longest - part[name].shape[1]
            wide = [(0, 0), (0, missing)] + (part[name].ndim - 2) * [(0, 0)]
            part[name] = np.pad(part[name], wide)
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
