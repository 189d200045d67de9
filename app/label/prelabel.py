"""The shipped model's own labels; made on the thread that reads ahead, never on the window's."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

from app.label.item import ModelLabel
from backend.catalogue.geometry import Pair
from backend.core.faults import InputError
from backend.core.flow import Episode
from backend.objects.catalogue import Catalogue
from backend.placement.estimator import Estimator
from backend.placement.offset_fit import OffsetGrid, mean_entropy

MOST_PAIRS = 16


class Prelabeller:
    """Loads the model of each piece once. ``path_of`` names the model of a piece, or None."""

    def __init__(self, catalogue: Catalogue, path_of: Callable[[str], Path | None]) -> None:
        self._catalogue, self._path_of = catalogue, path_of
        self._models: dict[str, Estimator | None] = {}
        self._grids: dict[str, OffsetGrid] = {}
        self._lock = threading.Lock()

    def __call__(self, episode: Episode, pair: Pair) -> ModelLabel | None:
        """Return the model's displacement; None without a model, or for a bad observation."""
        model = self.model(episode.piece)
        if model is None:
            return None
        try:
            patch = model.estimate(episode)
            fit = self._grid(pair).fit(patch)
        except (InputError, ValueError):
            # A dropped sample or another face: the page then shows no model, as it should.
            return None
        return ModelLabel(fit, mean_entropy(patch.probability), model.card.weights_sha256)

    def model(self, piece: str) -> Estimator | None:
        """Return the model of a piece, None where there is none that fits."""
        with self._lock:
            if piece not in self._models:
                self._models[piece] = self._load(piece)
            return self._models[piece]

    def _load(self, piece: str) -> Estimator | None:
        path = self._path_of(piece)
        if path is None or not path.is_file():
            return None
        try:
            return Estimator.load(path, self._catalogue.piece(piece))
        except InputError:
            return None

    def _grid(self, pair: Pair) -> OffsetGrid:
        if pair.sha256 not in self._grids:
            while len(self._grids) >= MOST_PAIRS:
                del self._grids[next(iter(self._grids))]
            self._grids[pair.sha256] = OffsetGrid.of(pair.points_mm, pair.bottom)
        return self._grids[pair.sha256]
