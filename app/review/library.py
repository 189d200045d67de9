"""The dataset as Review reads it: opened for looking only, on the thread that reads."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path

from app.label.opening import model_of
from app.label.prelabel import Prelabeller
from app.review.exports import table_of
from app.review.stored import Series, StoredEpisode, read_stored, series_of
from app.review.timed import TimedTrial
from backend.catalogue.dataset import DESCRIPTION, Dataset
from backend.core.faults import InputError
from backend.objects.catalogue import Catalogue, load_catalogue
from backend.objects.shapes import Outline


class Library:
    """Opens the dataset ``folder`` once there is one. All calls but ``catalogue`` on one thread."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._dataset: Dataset | None = None
        self._models: Prelabeller | None = None
        self._series: list[Series] = []

    @cached_property
    def catalogue(self) -> Catalogue:
        """The pieces."""
        return load_catalogue()

    def series(self) -> list[Series]:
        """Return the series of the dataset, newest first; none where there is no dataset.

        The very same list while nothing changed: nobody has to compare thousands of episodes.
        """
        if self._dataset is None and not (self.folder / DESCRIPTION).is_file():
            return self._series
        found = series_of(self._opened())
        if found != self._series:
            self._series = found
        return self._series

    def episode(self, uuid: str) -> StoredEpisode:
        """Read one episode; raises ``InputError`` naming a damaged file."""
        if self._models is None:
            self._models = Prelabeller(self.catalogue, model_of)
        dataset = self._opened()
        return read_stored(dataset, self._models, self.catalogue, dataset.entry(uuid))

    def table(self, uuids: Sequence[str]) -> str:
        """Return the table of these episodes, one line each; one that cannot be read has none."""
        return table_of(self._numbered(uuids))

    def _numbered(self, uuids: Sequence[str]) -> Iterator[tuple[TimedTrial, Outline | None]]:
        for number, uuid in enumerate(uuids, start=1):
            try:
                shown = self.episode(uuid)
            except InputError:
                continue
            yield shown.trial.numbered(number), self.face(shown.entry.bottom)

    def face(self, name: str) -> Outline | None:
        """Return the outline of a face, None for an unknown piece."""
        try:
            return self.catalogue.piece(name).face
        except InputError:
            return None

    def close(self) -> None:
        """Let go of the dataset."""
        if self._dataset is not None:
            self._dataset.close()
            self._dataset = None

    def _opened(self) -> Dataset:
        if self._dataset is None:
            self._dataset = Dataset.open(self.folder, create=False, write=False)
        return self._dataset
