"""Trained models of the experiments: stored in a job store, loaded, and applied to batches.

Imports torch.
"""

from __future__ import annotations

import shutil
from importlib.resources import files
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from touchdown.backend import learning
from touchdown.backend.core import FloatArray, InputError
from touchdown.backend.experiments.tables import MODELS, Recipe
from touchdown.backend.experiments.trials import BatchModel
from touchdown.backend.geometry import Piece, face_points
from touchdown.backend.jobs import JobSpec, JobStore

WEIGHTS = "model.safetensors"


def adopt_models(store: JobStore, *folders: Path) -> dict[tuple[str, str], str]:
    """Copy every model of the folders to the store; return its id by piece and table name.

    A later folder takes precedence. Raises ``InputError`` for an empty folder, or for two models of
    one folder for the same cells.
    """
    names = {(inputs, head): name for name, inputs, head in MODELS}
    found: dict[tuple[str, str], str] = {}
    for folder in folders:
        own: dict[tuple[str, str], str] = {}
        for path in sorted(folder.glob("*.safetensors")):
            card = learning.load_card(path)
            if (card.modality, card.answers) not in names:
                continue
            key = (card.piece, names[card.modality, card.answers])
            if key in own:
                what = f"There are two models for {' '.join(key)}."
                raise InputError(what, str(path), "Remove one of them.")
            own[key] = _adopt(store, path, card)
        if not own:
            raise InputError("There are no models here.", str(folder), "Name a folder of models.")
        found |= own
    return found


def keep_models(store: JobStore, recipe: Recipe, folder: Path) -> list[Path]:
    """Write each trained model of the experiment to ``folder``, with 16-bit weights.

    The files are named by piece and table name (``pot-ft+tac.safetensors``), as ``--models`` reads
    them.
    """
    written = []
    for piece in recipe.pieces:
        for name, _, _ in MODELS:
            source = recipe.training(piece, name).id
            if store.has(source):
                path = folder / f"{piece}-{name.lower()}.safetensors"
                learning.save_half_precision(path, load_model(source, store))
                written.append(path)
    return written


def load_model(source: str, store: JobStore) -> learning.Checkpoint:
    """Return the model of job ``source``: its training result, or a file adopted under this id."""
    if not store.has(source):
        raise InputError("There is no such model.", source, "Run the campaign from its beginning.")
    return learning.load_checkpoint(store.folder(source) / WEIGHTS)


def _adopt(store: JobStore, path: Path, card: learning.ModelCard) -> str:
    weights_sha256 = card.weights_sha256
    fitted = {} if card.calibration is None else {"calibration": card.calibration.model_dump()}
    spec = JobSpec("model", {"weights_sha256": weights_sha256, **fitted})
    if not store.has(spec.id):
        with store.writing(spec) as part:
            shutil.copyfile(path, part / WEIGHTS)
            shutil.copyfile(learning.card_path(path), learning.card_path(part / WEIGHTS))
            store.finish(spec, part, {"weights_sha256": weights_sha256})
    return spec.id


def shipped_model_folders(preset: str) -> list[Path]:
    """Return the folders of shipped models; the one trained on the bench ``preset`` comes last."""
    folder = Path(str(files("touchdown.resources"))) / "models"
    own = folder / preset
    return [folder, own] if own.is_dir() else [folder]


def batch_model(checkpoint: learning.Checkpoint, piece: Piece) -> BatchModel:
    """Return ``checkpoint`` for batches; raises ``InputError`` if it belongs to another piece."""
    card = checkpoint.card
    learning.check_face(card, piece.name, piece.sha256, card.weights_sha256[:12])
    net, part = learning.load_network(checkpoint), learning.modality_columns(card.modality)

    def probability(observation: NDArray[np.float32]) -> FloatArray:
        return learning.predict(net, observation, part).astype(np.float64)

    return BatchModel(probability, face_points(piece.face), card.base_rate, card.calibration)
