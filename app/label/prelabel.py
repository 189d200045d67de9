"""The models' own labels; made on the thread that reads ahead, never on the window's."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from pathlib import Path

from app.label.item import ModelLabel
from backend.catalogue.geometry import Pair
from backend.core.faults import InputError
from backend.core.flow import Episode
from backend.objects.catalogue import Catalogue
from backend.placement.ensemble import Ensemble
from backend.placement.estimator import Estimator
from backend.placement.offset_fit import OffsetGrid

MOST_PAIRS = 16


class Prelabeller:
    """Loads the models of each piece once. ``paths_of`` names those of a piece, or none."""

    def __init__(self, catalogue: Catalogue, paths_of: Callable[[str], Sequence[Path]]) -> None:
        self._catalogue, self._paths_of = catalogue, paths_of
        self._models: dict[str, Ensemble | None] = {}
        self._grids: dict[str, OffsetGrid] = {}
        self._lock = threading.Lock()

    def __call__(self, episode: Episode, pair: Pair) -> ModelLabel | None:
        """Return the models' displacement; None without a model, or for a bad observation."""
        ensemble = self.model(episode.piece)
        if ensemble is None:
            return None
        try:
            says = ensemble.judge(episode, self._grid(pair))
        except (InputError, ValueError):
            # A dropped sample or another face: the page then shows no model, as it should.
            return None
        return ModelLabel(says.fit, says.entropy, ensemble.weights, says.spread_mm)

    def model(self, piece: str) -> Ensemble | None:
        """Return the models of a piece, None where there is none that fits."""
        with self._lock:
            if piece not in self._models:
                self._models[piece] = self._load(piece)
            return self._models[piece]

    def forget(self) -> None:
        """Load all models anew: others were chosen."""
        with self._lock:
            self._models.clear()

    def _load(self, piece: str) -> Ensemble | None:
        members = []
        for path in self._paths_of(piece):
            try:
                members.append(Estimator.load(path, self._catalogue.piece(piece)))
            except InputError:
                # One that does not fit this piece any more says nothing about it.
                continue
        return Ensemble(members) if members else None

    def _grid(self, pair: Pair) -> OffsetGrid:
        if pair.sha256 not in self._grids:
            while len(self._grids) >= MOST_PAIRS:
                del self._grids[next(iter(self._grids))]
            self._grids[pair.sha256] = OffsetGrid.of(pair.points_mm, pair.bottom)
        return self._grids[pair.sha256]
