"""Groups of probes at random displacements, scored for Tables 1 and 2.

Every group is one gripping on its own mounting. Its first probe belongs to a balanced sample of
stable and unstable places, the further ones are random. Groups are independent of each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.config import (
    BeliefSettings,
    SimulationSettings,
    StabilitySettings,
    bench_sha256,
)
from touchdown.backend.core import ContactPatch, FloatArray
from touchdown.backend.experiments.statistics import reliability_curve
from touchdown.backend.experiments.trials import (
    BatchModel,
    SceneSetup,
    balanced_offset,
    pair_of,
    probing_scene,
    refused_presses,
    rounded_margins,
    uniform_offset,
)
from touchdown.backend.geometry import face_points, judge_tower
from touchdown.backend.learning import CONTACT_LEVEL
from touchdown.backend.placement import Belief, judge_stability
from touchdown.backend.sensing import EpisodeLimits
from touchdown.backend.simulation import BatchedTrials, tower_with_piece

ATTEMPTS = 30
SLIPPED_MM = 0.02  # larger motions of a pad in one press are slip


@dataclass(frozen=True, slots=True)
class ProbeGroups:
    """g groups of p probes.

    ``observation`` (g, p, 20, 258); ``offset_mm`` (g, p, 2) commanded, ``true_mm`` (g, p, 2);
    ``label`` (g, p, N): patch at the commanded displacement, as data is labelled; ``truth`` (g, p,
    N): true patch; ``slip_mm`` (g, p). ``margin_mm`` (g, 2): signed margin at the first place, for
    the top interface and for all interfaces. ``rejected``: probes drawn again. ``left_out``: groups
    with a probe that was invalid in all attempts.
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

    def predictions(self, model: BatchModel) -> FloatArray:
        """Return the contact probabilities (g, p, N) of a model."""
        g, p = self.observation.shape[:2]
        flat = self.observation.reshape(g * p, *self.observation.shape[2:])
        return model.predict(flat).reshape(g, p, -1)

    def as_json(self, bench: SimulationSettings) -> dict[str, Any]:
        """Return margins, slip and counts; a margin without support is None."""
        return {
            "bench_sha256": bench_sha256(bench),
            "margin_mm": [rounded_margins(pair) for pair in self.margin_mm],
            "slipped": float((self.slip_mm > SLIPPED_MM).mean()),
            "rejected": self.rejected,
            "left_out": self.left_out,
        }


def probe_groups(
    case: SceneSetup, seeds: list[int], probes: int, world: type[BatchedTrials] = BatchedTrials
) -> ProbeGroups:
    """Press ``probes`` times in each of the grippings of ``seeds``.

    Half of the groups begin at a stable place. An invalid press is drawn again; a group without all
    its probes (for example, a grip that always slips) is left out and counted. ``world``: class of
    the simulation.
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
            wanted = np.stack(
                [
                    uniform_offset(case, seeds[g], probe, attempt)
                    if probe
                    else balanced_offset(case, seeds[g], attempt, stable=g % 2 == 0)
                    for g in waiting
                ]
            )
            press = bench.press(waiting, wanted)
            # Who sees the bottom topple sets it up again.
            good = ~press.truth.toppled & [not why for why in refused_presses(press, limits)]
            rows = np.array(waiting)[good]
            offset[rows, probe], true[rows, probe] = wanted[good], press.truth.offset_mm[good]
            seen[rows, probe] = press.observation[good]
            slip[rows, probe] = press.truth.slip_mm[good]
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
        judge_tower(tower_with_piece(scenes[g], pair_of(at), bench.grippings[g].yaw_rad))
        for g, at in zip(going, true[:, 0], strict=True)
    ]
    return ProbeGroups(
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


def join_groups(parts: Sequence[ProbeGroups]) -> ProbeGroups:
    """Return all groups in order."""
    counts = ("rejected", "left_out")
    names = [f.name for f in fields(ProbeGroups) if f.name not in counts]
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in names
    }
    return ProbeGroups(**joined, **{name: sum(getattr(p, name) for p in parts) for name in counts})


PROBE_COUNTS = (1, 2, 3, 5)
RELIABLE_AFTER = 3
DIGITS = 4


def score_patches(probability: FloatArray, groups: ProbeGroups) -> dict[str, list[float]]:
    """Return for each group the mean IoU and point accuracy of its random probes.

    ``probability`` (g, p, N). The first probe belongs to a balanced sample and is left out.
    ``..._true``: compared with the true patch instead of the label.
    """
    predicted = probability[:, 1:] > CONTACT_LEVEL
    scores = {}
    for name, patch in (("", groups.label[:, 1:]), ("_true", groups.truth[:, 1:])):
        both, either = (predicted & patch).sum(-1), (predicted | patch).sum(-1)
        iou = np.where(either == 0, 1.0, both / np.maximum(either, 1)).mean(axis=1)
        scores["iou" + name] = _plain(iou)
        scores["accuracy" + name] = _plain((predicted == patch).mean(axis=(1, 2)))
    return scores


def score_fused_verdicts(
    probability: FloatArray, groups: ProbeGroups, model: BatchModel, case: SceneSetup
) -> dict[str, Any]:
    """Fuse the first n probes of each group and judge the first place.

    Returns ``says`` per n, the reliability of all covered cells after three probes, and the IoU of
    that map with the true support; with a calibration also ``calibrated``: per n, more likely
    stable than not by calibrated fusion.
    """
    says: dict[str, list[bool]] = {str(n): [] for n in PROBE_COUNTS if n <= probability.shape[1]}
    calibrated: dict[str, list[bool]] = {n: [] for n in says}
    even = StabilitySettings(delta=CONTACT_LEVEL)
    promised, real = [], []
    iou: list[float] = []
    for g in range(len(probability)):
        first = pair_of(groups.offset_mm[g, 0])
        belief = Belief.unknown(BeliefSettings(), first, model.base_rate)
        other = Belief.unknown(BeliefSettings(), first, model.base_rate, model.calibration)
        for k, p in enumerate(probability[g]):
            patch = ContactPatch(model.points_mm.copy(), p.copy())
            belief = belief.updated(patch, pair_of(groups.offset_mm[g, k]))
            other = other.updated(patch, pair_of(groups.offset_mm[g, k]))
            if str(k + 1) in says:
                com, rules = case.piece.com_xy_mm, StabilitySettings()
                says[str(k + 1)].append(judge_stability(belief, patch, com, first, rules).stable)
                likely = judge_stability(other, patch, com, first, even).stable
                calibrated[str(k + 1)].append(likely)
            if k + 1 == RELIABLE_AFTER:
                cells, support = _support(belief, groups, g, case)
                promised.append(cells)
                real.append(support)
                iou.append(overlap_share(cells > CONTACT_LEVEL, support))
    chart = reliability_curve(np.concatenate(promised), np.concatenate(real))
    found = {"says": says, "map_iou": iou, "reliability": chart.as_json()}
    return found if model.calibration is None else {**found, "calibrated": calibrated}


def _support(
    belief: Belief, groups: ProbeGroups, g: int, case: SceneSetup
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return probability and truth of the covered cells; the map is in commanded places."""
    covered = belief.map.covered
    centres = belief.map.cell_centres_mm()[covered]
    shift = groups.true_mm[g, 0] - groups.offset_mm[g, 0]
    return belief.map.probability[covered], case.bottoms[0].face.contains(centres + shift)


def overlap_share(predicted: NDArray[np.bool_], real: NDArray[np.bool_]) -> float:
    """Return the intersection over union, 1 if both are empty."""
    either = int((predicted | real).sum())
    return round(float((predicted & real).sum() / either), DIGITS) if either else 1.0


def _plain(values: FloatArray) -> list[float]:
    return [round(float(v), DIGITS) for v in values]
