"""What models think of all labels of a dataset: the scores that order four of the queues.

A job, not for a window's thread. It writes suggestions and scores under the hashes of the weights;
no label changes.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from backend.catalogue.dataset import Dataset
from backend.catalogue.scores import MODEL, Suggestion, disagreement
from backend.catalogue.values import EpisodeEntry, EpisodeFilter, Label, Source
from backend.core.faults import InputError
from backend.core.flow import TACTILE_CHANNELS, FloatArray
from backend.placement.alike import strangeness
from backend.placement.ensemble import Ensemble
from backend.placement.label_doubt import doubts, signals_of
from backend.placement.offset_fit import OffsetGrid

SETTLED_TICKS = 5
"""The last 0.5 s of a press are compared: the load is constant there."""


@dataclass(slots=True)
class _Felt:
    """What was felt in the episodes of one pair: estimated patch (N,) and settled wrench (6,)."""

    uuids: list[str] = field(default_factory=list)
    probability: list[FloatArray] = field(default_factory=list)
    wrench: list[FloatArray] = field(default_factory=list)


@dataclass(slots=True)
class _Found:
    """What the models of one piece found; ``felt`` per pair."""

    suggestion: dict[str, Label] = field(default_factory=dict)
    entropy: dict[str, float] = field(default_factory=dict)
    apart: dict[str, float] = field(default_factory=dict)
    felt: dict[str, _Felt] = field(default_factory=lambda: defaultdict(_Felt))


def score_labels(
    dataset: Dataset,
    models_of: Callable[[str], Ensemble | None],
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
        models = models_of(entry.piece)
        if models is not None and entry.file_state == "complete":
            _score(dataset, entry, models, grids, found[models.weights])
        if not progress(number, len(entries)):
            break
    for weights, part in found.items():
        _store(dataset, weights, part)
    return sum(len(part.suggestion) for part in found.values())


def _score(
    dataset: Dataset,
    entry: EpisodeEntry,
    models: Ensemble,
    grids: dict[str, OffsetGrid],
    found: _Found,
) -> None:
    try:
        episode = dataset.film(entry.uuid).episode
        if entry.geometry not in grids:
            pair = dataset.geometry.pair(entry.geometry)
            grids[entry.geometry] = OffsetGrid.of(pair.points_mm, pair.bottom)
        says = models.judge(episode, grids[entry.geometry])
    except (InputError, ValueError):
        return
    x_um, y_um = (round(1e3 * value) for value in says.fit.offset_mm)
    suggested = Label(x_um, y_um, 0, round(1e3 * says.fit.sigma_mm))
    head = dataset.labels.head(entry.uuid)
    found.suggestion[entry.uuid] = suggested
    found.entropy[entry.uuid] = says.entropy
    source: Source = f"{MODEL}{models.weights}"
    apart = disagreement(head, Suggestion(suggested, source, 0))
    # A label that came from these models agrees with them and says nothing.
    if apart is not None and head.source != source:
        found.apart[entry.uuid] = apart
    felt = found.felt[entry.geometry]
    felt.uuids.append(entry.uuid)
    felt.probability.append(says.patch.probability)
    settled = episode.observation[-SETTLED_TICKS:, TACTILE_CHANNELS:].mean(axis=0)
    felt.wrench.append(np.asarray(settled, dtype=np.float64))


def _store(dataset: Dataset, weights: str, found: _Found) -> None:
    dataset.scores.suggest(found.suggestion, weights)
    dataset.scores.put("uncertainty", found.entropy, weights)
    dataset.scores.put("disagreement", found.apart, weights)
    for felt in found.felt.values():
        offsets = np.stack([dataset.labels.head(uuid).label.offset_mm for uuid in felt.uuids])
        known = np.flatnonzero(np.isfinite(offsets).all(axis=1))
        if len(known) < 2:
            continue
        signals = signals_of(np.stack(felt.probability)[known], np.stack(felt.wrench)[known])
        uuids = [felt.uuids[k] for k in known.tolist()]
        for name, values in (
            ("doubt", doubts(signals, offsets[known])),
            ("duplicates", strangeness(signals, offsets[known])),
        ):
            told = zip(uuids, values.tolist(), strict=True)
            scores = {uuid: value for uuid, value in told if np.isfinite(value)}
            dataset.scores.put(name, scores, weights)
