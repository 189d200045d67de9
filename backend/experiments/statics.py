"""Groups of probes at random displacements, scored for Tables 1 and 2 in two protocols.

``balanced``: every group is one gripping on its own mounting. Its first probe belongs to a balanced
sample of stable and unstable places, the further ones are random. Groups are independent.

``paper``: a jig hands over the piece, so that its position in the grip varies by ``spread.jig_mm``
only, and several grippings share a mounting. All probes are random over the whole range, and every
probe is judged, together with the other ones of its gripping. A mounting is one repetition of the
paper's experiment, which had one mounting for each bottom; intervals are by mounting.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.backend import config
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
from touchdown.backend.geometry import face_points
from touchdown.backend.learning import CONTACT_LEVEL, overlap_shares
from touchdown.backend.placement import Belief, judge_stability
from touchdown.backend.sensing import EpisodeLimits
from touchdown.backend.simulation import BatchedTrials, judge_release

ATTEMPTS = 30
COUNTS = ("rejected", "left_out", "toppled", "unsolved")
PER_GROUP = ("mounting", *COUNTS)  # fields without an axis of probes
SLIPPED_MM = 0.02  # larger motions of a pad in one press are slip


@dataclass(frozen=True, slots=True)
class ProbeGroups:
    """g groups of p probes.

    ``observation`` (g, p, 20, 258); ``offset_mm`` (g, p, 2) commanded, ``true_mm`` (g, p, 2);
    ``label`` (g, p, N): patch at the commanded displacement, as data is labelled; ``truth`` (g, p,
    N): true patch; ``slip_mm`` (g, p). ``margins_mm`` (g, p, 2): signed margin at each place, for
    the top interface and for all interfaces. ``mounting`` (g,): seed of
    the mounting. ``rejected``: probes drawn again. ``left_out``: groups with a probe that was
    invalid in all attempts. Of the accepted presses ``toppled`` ones toppled the bottom and
    ``unsolved`` ones had no balance in the simulation at some instant: counted, not drawn again.
    """

    observation: NDArray[np.float32]
    offset_mm: FloatArray
    true_mm: FloatArray
    label: NDArray[np.bool_]
    truth: NDArray[np.bool_]
    slip_mm: FloatArray
    margins_mm: FloatArray
    mounting: NDArray[np.intp]
    rejected: int
    left_out: int
    toppled: int = 0
    unsolved: int = 0

    @property
    def margin_mm(self) -> FloatArray:
        """Margins (g, 2) at the first place of each group."""
        return self.margins_mm[:, 0]

    def rotated(self, by: int) -> ProbeGroups:
        """Return the groups with probe ``by`` as the first one, in cyclic order."""
        names = [f.name for f in fields(self) if f.name not in PER_GROUP]
        return replace(self, **{name: np.roll(getattr(self, name), -by, 1) for name in names})

    def predictions(self, model: BatchModel) -> FloatArray:
        """Return the contact probabilities (g, p, N) of a model."""
        g, p = self.observation.shape[:2]
        flat = self.observation.reshape(g * p, *self.observation.shape[2:])
        return model.predict(flat).reshape(g, p, -1)

    def as_json(self, bench: config.SimulationSettings, judged: int = 1) -> dict[str, Any]:
        """Return margins, slip and counts; a margin without support is None.

        ``judged``: number of probes of a group that are judged; with several the margins are those
        of all groups at the first, then at the second, with the ``mounting`` of each.
        """
        margins = self.margins_mm[:, :judged].swapaxes(0, 1).reshape(-1, 2)
        several = {"mounting": np.tile(self.mounting, judged).tolist()} if judged > 1 else {}
        return {
            "bench_sha256": config.bench_sha256(bench),
            **several,
            "margin_mm": [rounded_margins(pair) for pair in margins],
            "slipped": float((self.slip_mm > SLIPPED_MM).mean()),
            **{name: getattr(self, name) for name in COUNTS},
        }


def probe_groups(
    case: SceneSetup, seeds: list[int], probes: int, world: type[BatchedTrials] = BatchedTrials
) -> ProbeGroups:
    """Press ``probes`` times in each of the grippings of ``seeds``, each on its own mounting.

    Half of the groups begin at a stable place. An invalid press is drawn again; a group without all
    its probes (for example, a grip that always slips) is left out and counted. ``world``: class of
    the simulation.
    """

    def draw(group: int, probe: int, attempt: int) -> FloatArray:
        if probe:
            return uniform_offset(case, seeds[group], probe, attempt)
        return balanced_offset(case, seeds[group], attempt, stable=group % 2 == 0)

    return _press_groups(case, world([probing_scene(case, s) for s in seeds]), probes, draw)


def jig_groups(case: SceneSetup, seeds: Sequence[int], grips: int, probes: int) -> ProbeGroups:
    """Press as in the paper's evaluation: ``grips`` grippings from a jig on each mounting.

    ``seeds``: one for each mounting. All places are uniform over the whole range.
    """
    spread = case.settings.spread
    spread = spread.model_copy(update={"grasp_offset_mm": spread.jig_mm})
    case = replace(case, settings=case.settings.model_copy(update={"spread": spread}))
    places = [(seed, grip) for seed in seeds for grip in range(grips)]
    scenes = [probing_scene(case, seed) for seed, _ in places]
    bench = BatchedTrials(scenes, grips=[grip for _, grip in places])

    def draw(group: int, probe: int, attempt: int) -> FloatArray:
        seed, grip = places[group]
        return uniform_offset(case, seed, grip * probes + probe, attempt)

    return _press_groups(case, bench, probes, draw)


def _press_groups(
    case: SceneSetup, bench: BatchedTrials, probes: int, draw: Callable[[int, int, int], FloatArray]
) -> ProbeGroups:
    """Press groups at the places (2,) that ``draw`` returns for group, probe and attempt."""
    scenes, limits = bench.scenes, EpisodeLimits()
    points = face_points(case.piece.face)
    shape = (len(scenes), probes)
    offset, true = np.zeros((*shape, 2)), np.zeros((*shape, 2))
    seen = np.zeros((*shape, 20, 258), np.float32)
    slip = np.zeros(shape)
    rejected = toppled = unsolved = 0
    going = list(range(len(scenes)))
    for probe in range(probes):
        waiting = going
        for attempt in range(ATTEMPTS):
            wanted = np.stack([draw(g, probe, attempt) for g in waiting])
            press = bench.press(waiting, wanted)
            good = np.array([not why for why in refused_presses(press, limits)])
            rows = np.array(waiting)[good]
            offset[rows, probe], true[rows, probe] = wanted[good], press.truth.offset_mm[good]
            seen[rows, probe] = press.observation[good]
            slip[rows, probe] = press.truth.slip_mm[good]
            rejected += int((~good).sum())
            toppled += int(press.truth.toppled[good].sum())
            unsolved += int((~press.truth.solved[good]).sum())
            waiting = [g for g, ok in zip(waiting, good, strict=True) if not ok]
            if not waiting:
                break
        going = [g for g in going if g not in waiting]
        if not going:
            raise RuntimeError(f"no group got {probes} observations in {ATTEMPTS} attempts each")
    seen, offset, true, slip = seen[going], offset[going], true[going], slip[going]
    outline = case.bottoms[0].face
    verdicts = [
        [judge_release(scenes[g], pair_of(at), bench.grippings[g].yaw_rad)
         for at in places]
        for g, places in zip(going, true, strict=True)
    ]  # fmt: skip
    return ProbeGroups(
        seen,
        offset,
        true,
        outline.contains(points + offset[:, :, None]),
        outline.contains(points + true[:, :, None]),
        slip,
        np.array([[[v.margins_mm[-1], v.margin_mm] for v in group] for group in verdicts]),
        np.array([scenes[g].seed for g in going]),
        rejected,
        len(scenes) - len(going),
        toppled,
        unsolved,
    )


def join_groups(parts: Sequence[ProbeGroups]) -> ProbeGroups:
    """Return all groups in order."""
    names = [f.name for f in fields(ProbeGroups) if f.name not in COUNTS]
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in names
    }
    return ProbeGroups(**joined, **{name: sum(getattr(p, name) for p in parts) for name in COUNTS})


PROBE_COUNTS = (1, 2, 3, 5)
RELIABLE_AFTER = 3
DIGITS = 4


def score_patches(
    probability: FloatArray, groups: ProbeGroups, first: int = 1
) -> dict[str, list[float]]:
    """Return for each mounting the mean IoU and point accuracy of its random probes.

    ``probability`` (g, p, N). ``first``: first random probe of a group; that of a balanced sample
    is left out. ``..._true``: compared with the true patch instead of the label.
    """
    predicted = probability[:, first:] > CONTACT_LEVEL
    _, mounting = np.unique(groups.mounting, return_inverse=True)
    scores = {}
    for name, patch in (("", groups.label[:, first:]), ("_true", groups.truth[:, first:])):
        iou = overlap_shares(predicted, patch).mean(axis=1)
        right = (predicted == patch).mean(axis=(1, 2))
        for what, values in (("iou", iou), ("accuracy", right)):
            means = np.bincount(mounting, values) / np.bincount(mounting)
            scores[what + name] = [round(mean, DIGITS) for mean in means.tolist()]
    return scores


def score_fused_verdicts(
    probability: FloatArray,
    groups: ProbeGroups,
    model: BatchModel,
    case: SceneSetup,
    judged: int = 1,
) -> dict[str, Any]:
    """Fuse n probes of each group and judge the place of the first.

    Returns ``says`` per n, ``even``: the same at the threshold one half, the reliability of all
    covered cells after three probes, and the IoU of that map with the true support; with a
    calibration also ``calibrated``: per n, more likely stable than not by calibrated fusion.
    ``judged``: number of probes of a group that are first in turn, see ``ProbeGroups.as_json``.
    """
    ns = [n for n in PROBE_COUNTS if n <= probability.shape[1]]
    verdicts: dict[str, dict[str, list[bool]]] = {
        name: {str(n): [] for n in ns} for name in ("says", "even", "calibrated")
    }
    even, com = config.StabilitySettings(delta=CONTACT_LEVEL), case.piece.com_xy_mm
    promised, real = [], []
    iou: list[float] = []
    turned = [(groups.rotated(k), np.roll(probability, -k, 1)) for k in range(judged)]
    for some, predicted, g in ((a, b, g) for a, b in turned for g in range(len(b))):
        first = pair_of(some.offset_mm[g, 0])
        belief = Belief.unknown(config.BeliefSettings(), first, model.base_rate)
        other = Belief.unknown(config.BeliefSettings(), first, model.base_rate, model.calibration)
        for k, p in enumerate(predicted[g]):
            patch = ContactPatch(model.points_mm.copy(), p.copy())
            belief = belief.updated(patch, pair_of(some.offset_mm[g, k]))
            other = other.updated(patch, pair_of(some.offset_mm[g, k]))
            if k + 1 in ns:
                judged_by = {"says": (belief, config.StabilitySettings()), "even": (belief, even)}
                judged_by["calibrated"] = (other, even)
                for name, (source, rules) in judged_by.items():
                    stable = judge_stability(source, patch, com, first, rules).stable
                    verdicts[name][str(k + 1)].append(stable)
            if k + 1 == RELIABLE_AFTER:
                cells, support = _support(belief, some, g, case)
                promised.append(cells)
                real.append(support)
                overlap = float(overlap_shares(cells > CONTACT_LEVEL, support))
                iou.append(round(overlap, DIGITS))
    chart = reliability_curve(np.concatenate(promised), np.concatenate(real))
    if model.calibration is None:
        del verdicts["calibrated"]
    return {**verdicts, "map_iou": iou, "reliability": chart}


def _support(
    belief: Belief, groups: ProbeGroups, g: int, case: SceneSetup
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return probability and truth of the covered cells; the map is in commanded places."""
    covered = belief.map.covered
    centres = belief.map.cell_centres_mm()[covered]
    shift = groups.true_mm[g, 0] - groups.offset_mm[g, 0]
    return belief.map.probability[covered], case.bottoms[0].face.contains(centres + shift)
