"""Opening of datasets with drafts by a model."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from touchdown.app.shell.label_items import ModelLabel
from touchdown.backend.annotations import Dataset, NotWritableError, Pair
from touchdown.backend.bench import model_in_use
from touchdown.backend.core import Episode, InputError
from touchdown.backend.geometry import PieceLibrary, load_pieces
from touchdown.backend.learning import ModelRegistry
from touchdown.backend.placement import Ensemble, Estimator, pair_grid
from touchdown.backend.runs import models_folder
from touchdown.widgets.base import tr


class ModelPrelabeller:
    """Loads the models of each piece once. ``paths_of`` returns the model files of a piece."""

    def __init__(self, catalogue: PieceLibrary, paths_of: Callable[[str], Sequence[Path]]) -> None:
        self._catalogue, self._paths_of = catalogue, paths_of
        self._models: dict[str, Ensemble | None] = {}
        self._lock = threading.Lock()

    def __call__(self, episode: Episode, pair: Pair) -> ModelLabel | None:
        """Return the models' displacement, None without a model or for a bad observation."""
        ensemble = self.model(episode.piece)
        if ensemble is None:
            return None
        try:
            says = ensemble.judge(episode, pair_grid(pair))
        except (InputError, ValueError):
            # No model for a dropped sample or another face.
            return None
        return ModelLabel(says.fit, ensemble.weights, says.spread_mm)

    def model(self, piece: str) -> Ensemble | None:
        """Return the models of a piece, None if there are none."""
        with self._lock:
            if piece not in self._models:
                self._models[piece] = self._load(piece)
            return self._models[piece]

    def forget(self) -> None:
        """Load all models again."""
        with self._lock:
            self._models.clear()

    def _load(self, piece: str) -> Ensemble | None:
        members = []
        for path in self._paths_of(piece):
            # Skip a model that does not fit this piece any more.
            with suppress(InputError):
                members.append(Estimator.load(path, self._catalogue.piece(piece)))
        return Ensemble(members) if members else None


@dataclass(frozen=True, slots=True)
class OpenedDataset:
    """An open dataset. ``read_only``: why nothing can be saved, "" if it can."""

    dataset: Dataset
    prelabel: ModelPrelabeller
    catalogue: PieceLibrary
    read_only: str


def open_dataset(folder: Path, person: str) -> OpenedDataset:
    """Open the dataset in ``folder``. May take seconds."""
    read_only = ""
    try:
        dataset = Dataset.open(folder, person=person)
    except NotWritableError as error:
        dataset, read_only = Dataset.open(folder, write=False), str(error.what)
    if not read_only and not dataset.writable:
        read_only = tr("The dataset was written by a newer version.")
    pieces = load_pieces()
    return OpenedDataset(dataset, ModelPrelabeller(pieces, prelabel_models), pieces, read_only)


def prelabel_models(piece: str) -> Sequence[Path]:
    """Return the models that pre-label ``piece``: the chosen ones, else the one in use."""
    try:
        return ModelRegistry(models_folder()).ensemble(piece) or model_path_in_use(piece)
    except InputError:
        return ()


def model_path_in_use(piece: str) -> Sequence[Path]:
    """Return the model in use for ``piece``, None if there is none."""
    try:
        return (model_in_use(piece, ModelRegistry(models_folder())),)
    except InputError:
        return ()
