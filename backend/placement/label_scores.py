"""What a model thinks of all labels of a dataset: the scores that order three of the queues.

A job, not for a window's thread. It writes suggestions and scores under the hash of the weights;
no label changes.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from backend.catalogue.dataset import Dataset
from backend.catalogue.scores import Suggestion, disagreement
from backend.catalogue.values import EpisodeEntry, EpisodeFilter, Label, Source
from backend.core.faults import InputError
from backend.core.flow import FloatArray
from backend.placement.estimator import Estimator
from backend.placement.offset_fit import OffsetGrid, mean_entropy

SETTLED_TICKS = 5
"""The last 0.5 s of a press are compared: the load is constant there."""
FAR_MM = 5.0
"""Alike signals whose labels differ by more than this are worth a look."""


@dataclass(slots=True)
class _Found:
    """What one model found; ``feature``: mean of the settled signal, per episode and bottom."""

    suggestion: dict[str, Label] = field(default_factory=dict)
    entropy: dict[str, float] = field(default_factory=dict)
    apart: dict[str, float] = field(default_factory=dict)
    feature: dict[str, dict[str, FloatArray]] = field(default_factory=lambda: defaultdict(dict))


def score_labels(
    dataset: Dataset,
    model_of: Callable[[str], Estimator | None],
    progress: Callable[[int, int], bool],
) -> int:
    """Score every episode that has a model; returns how many were scored.

    ``progress`` gets (done, all) after each and returns False to stop: what was found until then
    is kept. Episodes that cannot be read or judged get no score.
    """
    entries = dataset.episodes(EpisodeFilter(accepted=True))
    found: dict[str, _Found] = defaultdict(_Found)
    grids: dict[str, OffsetGrid] = {}
    for number, entry in enumerate(entries, start=1):
        model = model_of(entry.piece)
        if model is not None and entry.file_state == "complete":
            _score(dataset, entry, model, grids, found[model.card.weights_sha256])
        if not progress(number, len(entries)):
            break
    for weights, part in found.items():
        _store(dataset, weights, part)
    return sum(len(part.suggestion) for part in found.values())


def _score(
    dataset: Dataset,
    entry: EpisodeEntry,
    model: Estimator,
    grids: dict[str, OffsetGrid],
    found: _Found,
) -> None:
    try:
        episode = dataset.film(entry.uuid).episode
        patch = model.estimate(episode)
        if entry.geometry not in grids:
            pair = dataset.geometry.pair(entry.geometry)
            grids[entry.geometry] = OffsetGrid.of(pair.points_mm, pair.bottom)
        fit = grids[entry.geometry].fit(patch)
    except (InputError, ValueError):
        return
    x_um, y_um = (round(1e3 * value) for value in fit.offset_mm)
    suggested = Label(x_um, y_um, 0, round(1e3 * fit.sigma_mm))
    head = dataset.labels.head(entry.uuid)
    found.suggestion[entry.uuid] = suggested
    found.entropy[entry.uuid] = mean_entropy(patch.probability)
    source: Source = f"model:{model.card.weights_sha256}"
    apart = disagreement(head, Suggestion(suggested, source, 0))
    # A label that came from this model agrees with it and says nothing.
    if apart is not None and head.source != source:
        found.apart[entry.uuid] = apart
    settled = episode.observation[-SETTLED_TICKS:].mean(axis=0)
    found.feature[entry.geometry][entry.uuid] = np.asarray(settled, dtype=np.float64)


def _store(dataset: Dataset, weights: str, found: _Found) -> None:
    dataset.scores.suggest(found.suggestion, weights)
    dataset.scores.put("uncertainty", found.entropy, weights)
    dataset.scores.put("disagreement", found.apart, weights)
    for features in found.feature.values():
        offsets = {uuid: dataset.labels.head(uuid).label.offset_mm for uuid in features}
        dataset.scores.put("duplicates", alike(features, offsets), weights)


def alike(
    features: Mapping[str, FloatArray], offsets_mm: Mapping[str, FloatArray]
) -> dict[str, float]:
    """Return per episode the distance to the most alike signal with a label over 5 mm away.

    ``features`` (d,) are standardised over the episodes first. Episodes without a label, or
    without any that far, are left out.
    """
    uuids = [uuid for uuid in features if np.isfinite(offsets_mm[uuid]).all()]
    if len(uuids) < 2:
        return {}
    x = np.stack([features[uuid] for uuid in uuids])
    x = (x - x.mean(axis=0)) / np.maximum(x.std(axis=0), 1e-9)
    at = np.stack([offsets_mm[uuid] for uuid in uuids])
    nearest = {}
    for i, uuid in enumerate(uuids):
        far = np.hypot(*(at - at[i]).T) > FAR_MM
        if far.any():
            nearest[uuid] = float(np.sqrt(((x[far] - x[i]) ** 2).sum(axis=1).min()))
    return nearest
