"""Probes at drawn displacements: what Tables 1 and 2 and the reliability of a model are made of.

Every group is one gripping on one mounting of its own: its first probe at a displacement of a
balanced sample, the further ones at random. Groups are independent of each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from backend.core.flow import FloatArray
from backend.experiments.scenes import Case, balanced_offset, probing_scene, uniform_offset
from backend.objects.surface import face_points
from backend.objects.tower import judge
from backend.sensing.episode import EpisodeLimits
from backend.simulation.lockstep import Lockstep
from backend.simulation.scoring import stacked

ATTEMPTS = 30


@dataclass(frozen=True, slots=True)
class Groups:
    """g groups of p probes.

    ``observation`` (g, p, 20, 258); ``offset_mm`` (g, p, 2) commanded, ``true_mm`` (g, p, 2);
    ``label`` (g, p, N): patch at the commanded displacement, as data is labelled; ``truth``
    (g, p, N): the real one; ``slip_mm`` (g, p). ``margin_mm`` (g, 2): signed margin of the first
    probe's place, top interface alone and all interfaces. ``rejected``: probes drawn again.
    ``left_out``: groups in which a probe was no observation however often it was drawn.
    """

    observation: NDArray[np.float32]
    offset_mm: FloatArray
    true_mm: FloatArray
    label: NDArray[np.bool_]
    truth: NDArray[np.bool_]
    slip_mm: FloatArray
    margin_mm: FloatArray
    rejected: int
    left_out: int


def probe_groups(
    case: Case, seeds: list[int], probes: int, world: type[Lockstep] = Lockstep
) -> Groups:
    """Press ``probes`` times in each of the grippings named by ``seeds``.

    Half of the groups begin at a stable place. A press that is no observation is drawn again;
    a group that never gets all its probes (a grip that always slips) is left out and counted.
    ``world``: in which to press.
    """
    scenes = [probing_scene(case, seed) for seed in seeds]
    bench, limits = world(scenes), EpisodeLimits()
    points = face_points(case.piece.face)
    shape = (len(seeds), probes)
    offset, true = np.zeros((*shape, 2)), np.zeros((*shape, 2))
    seen = np.zeros((*shape, 20, 258), np.float32)
    slip = np.zeros(shape)
    rejected = 0
    going = list(range(len(seeds)))
    for probe in range(probes):
        waiting = going
        for attempt in range(ATTEMPTS):
            wanted = np.stack([_offset(case, seeds[g], g, probe, attempt) for g in waiting])
            felt = bench.press(waiting, wanted)
            good = (
                felt.valid & (felt.press_n >= limits.contact_n) & (felt.slip_mm <= limits.slip_mm)
            )
            good &= ~felt.toppled
            rows = np.array(waiting)[good]
            offset[rows, probe], true[rows, probe] = wanted[good], felt.true_mm[good]
            seen[rows, probe], slip[rows, probe] = felt.observation[good], felt.slip_mm[good]
            rejected += int((~good).sum())
            waiting = [g for g, ok in zip(waiting, good, strict=True) if not ok]
            if not waiting:
                break
        going = [g for g in going if g not in waiting]
        if not going:
            raise RuntimeError(f"no group got {probes} observations in {ATTEMPTS} attempts each")
    seen, offset, true, slip = seen[going], offset[going], true[going], slip[going]
    outline = case.bottoms[0].face
    verdicts = [
        judge(stacked(scenes[g], (float(x), float(y)), bench.grippings[g].yaw_rad))
        for g, (x, y) in zip(going, true[:, 0], strict=True)
    ]
    return Groups(
        seen,
        offset,
        true,
        outline.contains(points + offset[:, :, None]),
        outline.contains(points + true[:, :, None]),
        slip,
        np.array([[v.margins_mm[-1], v.margin_mm] for v in verdicts]),
        rejected,
        len(seeds) - len(going),
    )


def join_groups(parts: Sequence[Groups]) -> Groups:
    """Return all groups in order."""
    counts = ("rejected", "left_out")
    names = [f.name for f in fields(Groups) if f.name not in counts]
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in names
    }
    return Groups(**joined, **{name: sum(getattr(p, name) for p in parts) for name in counts})


def _offset(case: Case, seed: int, group: int, probe: int, attempt: int) -> FloatArray:
    if probe == 0:
        return balanced_offset(case, seed, attempt, stable=group % 2 == 0)
    return uniform_offset(case, seed, probe, attempt)
