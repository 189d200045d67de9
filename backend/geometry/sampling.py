"""Random sampling of start offsets and of leaning towers.

The same seed gives the same start and tower in experiments, on the simulated bench and in tests.
Offsets are drawn by rejection sampling.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from touchdown.backend.core import FloatArray, InputError
from touchdown.backend.geometry.outlines import Outline, overlap_area_mm2
from touchdown.backend.geometry.pieces import Piece
from touchdown.backend.geometry.tower import Body, Tower, judge_tower

MIN_OVERLAP_MM2 = 6.0  # smallest overlap of a start or a training probe (bench-physics, section 10)

START_MARGIN_MM = -0.2  # A trial starts clearly unstable, outside the band that is not scored

COARSE_SEGMENTS = 48  # corners of a circle while sampling: the area is at most 0.3 % too small

MAX_ROUNDS = 500  # draws before giving up; a few are usual
_START, _COM = 77, 79  # random streams of towers and starts, and of unknown centres of mass
COM_SHARE = 0.3  # largest distance of an unknown centre of mass, as a share of the half extents


def draw_offset(rng: np.random.Generator, face: Outline, bottom: Outline, count: int) -> FloatArray:
    """Return (count, 2) offsets in mm, uniform over those with enough overlap.

    Raises ``InputError`` if such offsets are too rare.
    """
    reach = np.add(face.half_extents_mm, bottom.half_extents_mm)
    found = np.empty((0, 2))
    for _ in range(MAX_ROUNDS):
        if len(found) >= count:
            return found[:count]
        tried = rng.uniform(-reach, reach, size=(max(8, min(count, 256)), 2))
        area = overlap_area_mm2(face, tried, bottom, segments=COARSE_SEGMENTS)
        found = np.concatenate([found, tried[area >= MIN_OVERLAP_MM2]])
    what, fix = f"The two faces hardly overlap by {MIN_OVERLAP_MM2:g} mm².", "Choose larger faces."
    raise InputError(what, "piece and bottom", fix)


def scene_number(piece: str, *bottoms: str) -> int:
    """Return the number of a piece over bottoms (bottom-up) in seeds.

    Scenes of one seed with other pieces or bottoms have other draws.
    """
    return zlib.crc32(f"{piece}/{'+'.join(bottoms)}".encode())


def start_generator(seed: int, piece: str, *bottoms: str) -> np.random.Generator:
    """Return the generator of tower and start of a trial, the same on all benches."""
    return np.random.default_rng([seed, scene_number(piece, *bottoms), _START])


def with_true_com(piece: Piece, seed: int) -> Piece:
    """Return ``piece`` as simulated: an unknown centre of mass is drawn from the seed.

    Uniform within ``COM_SHARE`` of the half extents of the face along x and y.
    """
    if piece.com_known:
        return piece
    rng = np.random.default_rng([seed, scene_number(piece.name), _COM])
    x, y = (rng.uniform(-COM_SHARE, COM_SHARE, 2) * piece.face.half_extents_mm).tolist()
    return replace(piece, com_xy_mm=(x, y))


def draw_start(rng: np.random.Generator, piece: Body, bottoms: Tower) -> tuple[float, float]:
    """Return an offset of ``piece`` from the topmost bottom at which the stack would fall.

    Uniform over offsets in mm (frame ``O``) with an overlap of at least ``MIN_OVERLAP_MM2`` and a
    margin of the stack of at most ``START_MARGIN_MM``. Raises ``InputError`` if the bottoms cannot
    carry a piece, do not stand, or no such offset is found.
    """
    carrier = bottoms.bodies[-1]
    where = f"{piece.name} on {carrier.name}"
    if carrier.upper is None:
        raise InputError(f"'{carrier.name}' carries nothing.", where, "Choose another bottom.")
    if not judge_tower(bottoms).stands:
        raise InputError("The bottoms do not stand by themselves.", where, "Move them.")
    for _ in range(MAX_ROUNDS):
        x, y = draw_offset(rng, piece.lower, carrier.upper, 1)[0].tolist()
        at = (carrier.at_mm[0] + x, carrier.at_mm[1] + y)
        if judge_tower(bottoms.with_top(replace(piece, at_mm=at))).margin_mm <= START_MARGIN_MM:
            return x, y
    raise InputError("No unstable start was found.", where, "Choose another bottom.")


MAX_LEAN_MM = 6.0  # upper bottoms are displaced by 0 to this, uniformly, in any direction
PLACEMENT_PITCH_MM = 2.0  # pitch of the grid on which a stable position is searched


def draw_tower(rng: np.random.Generator, bottoms: Sequence[Piece]) -> Tower:
    """Return a tower of ``bottoms`` (bottom-up), the upper ones displaced at random.

    The tower may be unstable. Raises ``InputError``.
    """
    tower = Tower((bottoms[0].body(),))
    for piece in bottoms[1:]:
        x, y = tower.bodies[-1].at_mm
        reach, angle = rng.uniform(0.0, MAX_LEAN_MM), rng.uniform(0.0, 2.0 * math.pi)
        at = (x + reach * math.cos(angle), y + reach * math.sin(angle))
        tower = tower.with_top(piece.body(at))
    return tower


def can_be_placed(piece: Piece, tower: Tower) -> bool:
    """Return True if the tower stands, also with ``piece`` at some position of a coarse grid."""
    if not judge_tower(tower).stands:
        return False
    carrier = tower.bodies[-1]
    if carrier.upper is None:
        return False
    reach = max(carrier.upper.half_extents_mm)
    steps = PLACEMENT_PITCH_MM * np.arange(
        -(reach // PLACEMENT_PITCH_MM), reach // PLACEMENT_PITCH_MM + 1
    )
    places = sorted(((x, y) for x in steps for y in steps), key=lambda p: math.hypot(*p))
    return any(
        judge_tower(tower.with_top(piece.body((carrier.at_mm[0] + x, carrier.at_mm[1] + y)))).stands
        for x, y in places
    )
