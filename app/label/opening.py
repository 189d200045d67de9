"""Open the dataset that the window works on: to write if possible, else to look at."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from app.label.prelabel import Prelabeller
from backend.assembly import model_in_use
from backend.catalogue.dataset import Dataset
from backend.catalogue.writer_lock import NotWritableError
from backend.core.faults import InputError
from backend.learning.registry import Registry
from backend.objects.catalogue import Catalogue, load_catalogue
from backend.runs.store import models_folder


@dataclass(frozen=True, slots=True)
class Opened:
    """``read_only``: why nothing can be saved ("" if it can)."""

    dataset: Dataset
    prelabel: Prelabeller
    catalogue: Catalogue
    read_only: str


def opener(folder: Path, person: str) -> Callable[[], Opened]:
    """Return what opens ``folder``; it may take a while and runs on a thread of its own."""

    def open_dataset() -> Opened:
        read_only = ""
        try:
            dataset = Dataset.open(folder, person=person)
        except NotWritableError as error:
            dataset, read_only = Dataset.open(folder, write=False), str(error.what)
        if not read_only and not dataset.writable:
            read_only = "The dataset was written by a newer version."
        catalogue = load_catalogue()
        return Opened(dataset, Prelabeller(catalogue, models_of), catalogue, read_only)

    return open_dataset


def models_of(piece: str) -> Sequence[Path]:
    """Return the models that pre-label ``piece``: those chosen for it, else the one in use."""
    try:
        return Registry(models_folder()).ensemble(piece) or model_of(piece)
    except InputError:
        return ()


def model_of(piece: str) -> Sequence[Path]:
    """Return the model in use for ``piece``, if there is one."""
    try:
        return (model_in_use(piece, Registry(models_folder())),)
    except InputError:
        return ()
