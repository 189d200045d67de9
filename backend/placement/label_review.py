"""Doubt scores of labels, from models, similar signals and other episodes of the pair.

The scores order four of the review queues.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist, squareform

from touchdown.backend.annotations import (
    MODEL_PREFIX,
    Dataset,
    EpisodeEntry,
    EpisodeFilter,
    Label,
    Source,
    Suggestion,
    disagreement,
)
from touchdown.backend.core import TACTILE_CHANNELS, FloatArray, InputError
from touchdown.backend.placement.estimator import Ensemble, pair_grid

ALIKE_FEWEST = 30  # fewest episodes of a pair for a comparison of similar signals
ALIKE = 40  # number of most similar signals used for the fit
ALIKE_RIDGE = 3.0  # ridge penalty of the fit of the scaled signals
ROUNDS = 3
HUBER_K = 2.0  # residuals beyond this many deviations are down-weighted
FLOOR_MM = 0.5  # distances below this are never unusual
PART = 500


def neighbour_residual(signals: FloatArray, offsets_mm: FloatArray) -> FloatArray:
    """Return the distance (n,) of each label from the fit to the most similar signals.

    ``signals`` (n, d) with a common scale and ``offsets_mm`` (n, 2) as labelled, of one pair. The
    unit is the median residual of those neighbours plus ``FLOOR_MM``. NaN below ``ALIKE_FEWEST``.
    """
    count = len(signals)
    if count < ALIKE_FEWEST:
        return np.full(count, np.nan)
    near = cKDTree(signals).query(signals, k=min(ALIKE, count - 1) + 1)[1]
    near = np.asarray(near, dtype=np.intp)
    # Equal signals may hide the episode itself among its neighbours: then drop the farthest one.
    own = near == np.arange(count)[:, None]
    own[~own.any(axis=1), -1] = True
    near = near[~own].reshape(count, -1)
    parts = [slice(at, at + PART) for at in range(0, count, PART)]
    return np.concatenate([_residual(signals, offsets_mm, near, part) for part in parts])


def _residual(
    signals: FloatArray, offsets_mm: FloatArray, near: NDArray[np.intp], part: slice
) -> FloatArray:
    """Fit the labels of the neighbours linearly to their signals and return the residual."""
    others = offsets_mm[near[part]]
    apart = signals[near[part]] - signals[part, None]
    terms = np.concatenate([np.ones((*apart.shape[:2], 1)), apart], axis=2)
    ridge = ALIKE_RIDGE * np.eye(terms.shape[2])
    ridge[0, 0] = 0.0
    weight = np.ones(apart.shape[:2])
    for _ in range(ROUNDS):
        weighted = terms * weight[:, :, None]
        square = np.einsum("nki,nkj->nij", weighted, weighted) + ridge
        fit = np.linalg.solve(
            square, np.einsum("nki,nkj->nij", weighted, weight[:, :, None] * others)
        )
        left = np.linalg.norm(others - terms @ fit, axis=2)
        usual = np.median(left, axis=1)
        weight = 1.0 / np.maximum(1.0, left / (HUBER_K * usual[:, None] + 1e-6))
    own = np.linalg.norm(offsets_mm[part] - fit[:, 0], axis=1)
    return np.asarray(own / (usual + FLOOR_MM))


DOUBT_FEWEST = 200  # fewest episodes of a pair for a fit of the signals
PARTS = 10  # principal components of the estimated patch in the comparison, beside the wrench
SMOOTH_MM = 3.0
DOUBT_RIDGE = 0.5
FOLDS = 8
NEAR = 80  # number of nearby labels for the scatter
MAX_FIT_EPISODES = 1500  # most episodes for the fit; more only take time
CLIP = 0.01
SHRINK = 0.1
SHIFTS_MM = (1.0, 2.0, 3.0, 5.0)
TURNS = 12


def summarise_signals(probability: FloatArray, wrench: FloatArray) -> FloatArray:
    """Return the signals as few numbers (n, d) with a common scale.

    ``probability`` (n, N) of the estimated patches, ``wrench`` (n, 6) of the settled press; all of
    one pair.
    """
    p = np.clip(probability, CLIP, 1 - CLIP)
    odds = np.log(p / (1 - p))
    left, sizes, _ = np.linalg.svd(odds - odds.mean(axis=0), full_matrices=False)
    return np.hstack([_standard(left[:, :PARTS] * sizes[:PARTS]), _standard(wrench)])


def displacement_doubt(felt: FloatArray, offsets_mm: FloatArray) -> FloatArray:
    """Return the gain of log likelihood (n,), doubled, a few mm away from each label.

    ``felt`` (n, d) from ``summarise_signals``, ``offsets_mm`` (n, 2) as labelled; all of one pair.
    NaN below ``DOUBT_FEWEST`` episodes.
    """
    count = len(offsets_mm)
    if count < DOUBT_FEWEST:
        return np.full(count, np.nan)
    error = felt - _expected_without_own(offsets_mm, felt)
    expected = _smooth(offsets_mm, felt, np.random.default_rng(0))
    near = np.asarray(cKDTree(offsets_mm).query(offsets_mm, k=min(NEAR, count - 1) + 1)[1])[:, 1:]
    turn = 2 * np.pi * np.arange(TURNS) / TURNS
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    shifts = np.concatenate([np.zeros((1, 2)), *(by * ring for by in SHIFTS_MM)])
    found = np.empty(count)
    for k in range(count):
        middle, scale, inverse = _scatter(error[near[k]])
        moved = expected(offsets_mm[k] + shifts)
        apart = (error[k] - middle - (moved - moved[0])) / scale
        distance = np.einsum("ij,jk,ik->i", apart, inverse, apart)
        found[k] = distance[0] - distance.min()
    return found


def _standard(values: FloatArray) -> FloatArray:
    return np.asarray((values - values.mean(axis=0)) / np.maximum(values.std(axis=0), 1e-9))


class _KernelRidge:
    """Smooth function of the offset, fitted to the signals (kernel ridge regression)."""

    def __init__(self, at_mm: FloatArray, felt: FloatArray) -> None:
        self._at_mm, self._mean = at_mm, felt.mean(axis=0)
        ridge = DOUBT_RIDGE * np.eye(len(at_mm))
        self._weights = np.linalg.solve(_kernel(at_mm, at_mm) + ridge, felt - self._mean)

    def __call__(self, at_mm: FloatArray) -> FloatArray:
        return np.asarray(_kernel(at_mm, self._at_mm) @ self._weights + self._mean)


def _smooth(at_mm: FloatArray, felt: FloatArray, rng: np.random.Generator) -> _KernelRidge:
    if len(at_mm) > MAX_FIT_EPISODES:
        chosen = np.sort(rng.choice(len(at_mm), MAX_FIT_EPISODES, replace=False))
        at_mm, felt = at_mm[chosen], felt[chosen]
    return _KernelRidge(at_mm, felt)


def _kernel(one_mm: FloatArray, other_mm: FloatArray) -> FloatArray:
    apart = ((one_mm[:, None] - other_mm) ** 2).sum(axis=2)
    return np.asarray(np.exp(-apart / (2 * SMOOTH_MM**2)))


def _expected_without_own(at_mm: FloatArray, felt: FloatArray) -> FloatArray:
    """Return the leave-one-out prediction of the signals at each label."""
    rng = np.random.default_rng(1)
    fold = rng.permutation(len(at_mm)) % FOLDS
    expected = np.empty_like(felt)
    for number in range(FOLDS):
        others = fold != number
        expected[~others] = _smooth(at_mm[others], felt[others], rng)(at_mm[~others])
    return expected


def _scatter(error: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return centre and scale (d,) of errors (k, d), and the inverse covariance in that scale.

    Errors are clipped at three deviations, since some labels may be wrong.
    """
    middle = np.median(error, axis=0)
    scale = 1.4826 * np.median(np.abs(error - middle), axis=0) + 1e-6
    z = np.clip((error - middle) / scale, -3.0, 3.0)
    covariance = np.cov(z.T) + SHRINK * np.eye(error.shape[1])
    return middle, scale, np.asarray(np.linalg.inv(covariance), dtype=np.float64)


SETTLED_TICKS = 5  # ticks at the end of a press, where the load is constant (0.5 s)
COMPARED_TICKS = [4, 9, 14, 19]  # of a press, for the comparison of signals
MAX_COMPARED, MAX_PICKS = 1500, 300  # most episodes of a piece that are compared, and ordered


def training_order(
    signals: NDArray[np.floating],
    grips: Sequence[str],
    labelled: Collection[int],
    most: int = MAX_PICKS,
) -> list[int]:
    """Return the indices of at most ``most`` episodes to label next, one of each grip.

    ``signals`` (n, 4, 258) of a press, ``grips`` (n,) ids, and the indices of the ``labelled``
    episodes. A label corrects all episodes of its grip (``Dataset.carried``), so the grips are
    ordered: first those whose episodes bring the signals of the labelled episodes closest to the
    signals of all (kernel herding; Chen, Welling and Smola 2010, arXiv 1203.3472).
    """
    kinds = np.split(signals - signals.mean(axis=0), (TACTILE_CHANNELS, TACTILE_CHANNELS + 3), 2)
    scaled = [kind.reshape(len(kind), -1) / max(np.linalg.norm(kind), 1e-9) for kind in kinds]
    alike = _likeness(np.hstack(scaled))
    grip = np.unique(np.asarray(grips), return_inverse=True)[1]
    free = ~np.isin(np.arange(len(grip)), list(labelled))
    wanted, total = alike.mean(axis=1), alike[:, ~free].sum(axis=1)
    order = list[int]()
    while free.any() and len(order) < most:
        gain = np.where(free, wanted - total / (np.count_nonzero(~free) + 1), -np.inf)
        of_grip = np.bincount(grip, np.where(free, gain, 0.0))
        of_grip[np.bincount(grip, free) == 0] = -np.inf
        chosen = grip == of_grip.argmax()
        order.append(int(np.where(chosen, gain, -np.inf).argmax()))
        total += alike[:, chosen & free].sum(axis=1)
        free &= ~chosen
    return order


def _likeness(features: FloatArray) -> FloatArray:
    """Return a Gaussian (n, n) of the distances between the principal components."""
    left, sizes, _ = np.linalg.svd(features - features.mean(axis=0), full_matrices=False)
    apart = squareform(pdist(left[:, :PARTS] * sizes[:PARTS], "sqeuclidean"))
    return np.asarray(np.exp(-apart / max(2.0 * float(np.median(apart)), 1e-12)))


@dataclass(slots=True)
class _PairSignals:
    """Signals of the episodes of one pair: estimated patch (N,) and settled wrench (6,)."""

    uuids: list[str] = field(default_factory=list)
    probability: list[FloatArray] = field(default_factory=list)
    wrench: list[FloatArray] = field(default_factory=list)


# Signals (4, 258), grip, and whether the label was accepted
_Compared = tuple[NDArray[np.floating], str, bool]


@dataclass(slots=True)
class _ModelResults:
    """Results of the models of one piece: compared probes, and ``felt`` per pair."""

    suggestion: dict[str, Label] = field(default_factory=dict)
    apart: dict[str, float] = field(default_factory=dict)
    compared: dict[str, _Compared] = field(default_factory=dict)
    felt: dict[str, _PairSignals] = field(default_factory=lambda: defaultdict(_PairSignals))


def score_labels(
    dataset: Dataset,
    models_of: Callable[[str], Ensemble | None],
    progress: Callable[[int, int], bool],
) -> int:
    """Score every episode that has a model; return the number of scored episodes.

    ``progress`` is called with (done, total) after each episode; False stops and keeps the scores
    so far. Episodes that cannot be read or estimated get no score.
    """
    entries = dataset.episodes(EpisodeFilter(accepted=True))
    found: dict[str, _ModelResults] = defaultdict(_ModelResults)
    for number, entry in enumerate(entries, start=1):
        models = models_of(entry.piece)
        if models is not None and entry.file_state == "complete":
            _score(dataset, entry, models, found[models.weights])
        if not progress(number, len(entries)):
            break
    for weights, part in found.items():
        _store(dataset, weights, part)
    return sum(len(part.suggestion) for part in found.values())


def _score(dataset: Dataset, entry: EpisodeEntry, models: Ensemble, found: _ModelResults) -> None:
    try:
        episode = dataset.film(entry.uuid).episode
        says = models.judge(episode, pair_grid(dataset.geometry.pair(entry.geometry)))
    except (InputError, ValueError):
        return
    x_um, y_um = (round(1e3 * value) for value in says.fit.offset_mm)
    suggested = Label(x_um, y_um, 0, round(1e3 * says.fit.sigma_mm))
    head = dataset.labels.head(entry.uuid)
    found.suggestion[entry.uuid] = suggested
    source: Source = f"{MODEL_PREFIX}{models.weights}"
    apart = disagreement(head, Suggestion(suggested, source, 0))
    # Labels from these models agree with them and are not compared.
    if apart is not None and head.source != source:
        found.apart[entry.uuid] = apart
    felt = found.felt[entry.geometry]
    felt.uuids.append(entry.uuid)
    felt.probability.append(says.patch.probability)
    settled = episode.observation[-SETTLED_TICKS:, TACTILE_CHANNELS:].mean(axis=0)
    felt.wrench.append(np.asarray(settled, dtype=np.float64))
    if head.state != "rejected":
        found.compared[entry.uuid] = (
            episode.observation[COMPARED_TICKS],
            entry.grip,
            head.state in ("submitted", "approved"),
        )


def _store(dataset: Dataset, weights: str, found: _ModelResults) -> None:
    dataset.scores.suggest(found.suggestion, weights)
    if found.compared:
        dataset.scores.put("training", _training_scores(found.compared), weights)
    dataset.scores.put("disagreement", found.apart, weights)
    for felt in found.felt.values():
        offsets = np.stack([dataset.labels.head(uuid).label.offset_mm for uuid in felt.uuids])
        known = np.flatnonzero(np.isfinite(offsets).all(axis=1))
        if len(known) < 2:
            continue
        signals = summarise_signals(np.stack(felt.probability)[known], np.stack(felt.wrench)[known])
        uuids = [felt.uuids[k] for k in known.tolist()]
        for name, values in (
            ("doubt", displacement_doubt(signals, offsets[known])),
            ("duplicates", neighbour_residual(signals, offsets[known])),
        ):
            told = zip(uuids, values.tolist(), strict=True)
            scores = {uuid: value for uuid, value in told if np.isfinite(value)}
            dataset.scores.put(name, scores, weights)


def _training_scores(compared: Mapping[str, _Compared]) -> dict[str, float]:
    """Return 1 for the unlabelled episode to label first, less for the next ones."""
    uuids = np.random.default_rng(0).permutation(sorted(compared))[:MAX_COMPARED].tolist()
    signals, grips, accepted = zip(*(compared[uuid] for uuid in uuids), strict=True)
    order = training_order(np.array(signals), grips, np.flatnonzero(accepted).tolist())
    return {uuids[k]: 1.0 - place / len(order) for place, k in enumerate(order)}
