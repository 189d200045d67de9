"""The dataset as Review reads it: opened for looking only, on the thread that reads."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

from app.label.opening import model_of
from app.label.prelabel import Prelabeller
from app.review.stored import Series, StoredEpisode, read_stored, series_of
from backend.catalogue.dataset import DESCRIPTION, Dataset
from backend.catalogue.values import EpisodeEntry
from backend.objects.catalogue import Catalogue, load_catalogue


class Library:
    """Opens the dataset ``folder`` once there is one. All calls but ``catalogue`` on one thread."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._dataset: Dataset | None = None
        self._models: Prelabeller | None = None

    @cached_property
    def catalogue(self) -> Catalogue:
        """The pieces."""
        return load_catalogue()

    def series(self) -> list[Series]:
        """Return the series of the dataset, newest first; none where there is no dataset."""
        if self._dataset is None and not (self.folder / DESCRIPTION).is_file():
            return []
        return series_of(self._opened())

    def episode(self, entry: EpisodeEntry) -> StoredEpisode:
        """Read one episode; raises ``InputError`` naming a damaged file."""
        if self._models is None:
            self._models = Prelabeller(self.catalogue, model_of)
        return read_stored(self._opened(), self._models, self.catalogue, entry)

    def close(self) -> None:
        """Let go of the dataset."""
        if self._dataset is not None:
            self._dataset.close()
            self._dataset = None

    def _opened(self) -> Dataset:
        if self._dataset is None:
            self._dataset = Dataset.open(self.folder, create=False, write=False)
        return self._dataset
