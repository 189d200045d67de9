"""Checkpoint files: ``<name>.safetensors`` with a JSON card. Loading runs no code."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict
from safetensors import SafetensorError
from safetensors.numpy import load as load_arrays
from safetensors.numpy import save as save_arrays

from touchdown.backend.config import SAMPLES_PER_PROBE, BenchDescription, read_json_model
from touchdown.backend.core import InputError, read_limited, write_atomically
from touchdown.backend.learning import inference
from touchdown.backend.learning.calibration import PatchCalibration

MAX_WEIGHT_BYTES = 100_000_000
MAX_CARD_BYTES = 1_000_000
FIX = "Check the path, use the model that came with Touchdown, or train again."
STORED = (np.float32, np.float16)  # types of weights on disk; in memory they are float32
FULL_PRECISION = ("mean", "scale")  # in units of the signals, with a large range: always 32 bits
_PICKLES = (b"PK\x03\x04", b"\x80")
Card = TypeVar("Card", bound=BaseModel)


class ModelCard(BaseModel):
    """Card of a checkpoint: the network, its data, its training and its scores.

    Attributes
    ----------
    arch, hyper
        Architecture of the network and its sizes.
    modality : {"FT", "Tac", "FT+Tac"}
        Signals that the network reads.
    piece : str
        Piece whose face the network describes.
    base_rate : float
        Share of face points in contact over the training data.
    weights_sha256 : str
        Hash of the weights.
    calibration : PatchCalibration or None
        Calibration of the probabilities, for the strategy ``paper-calibrated``; None in cards that
        were written before there was one.

    Examples
    --------
    >>> from touchdown.backend.learning import load_checkpoint
    >>> from touchdown.backend.placement import shipped_model
    >>> load_checkpoint(shipped_model("pot")).card.piece
    'pot'
    """

    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid")
    format: Literal["touchdown-model/1"] = "touchdown-model/1"
    arch: str
    hyper: inference.NetworkShape
    modality: inference.Modality
    vector_order: str = inference.VECTOR_ORDER
    rate_hz: int = 10
    frames: int = SAMPLES_PER_PROBE
    resampling: str = "markers linear between frames, wrench mean of the 100 ms before the tick"
    normaliser: str = "tensors 'mean' and 'scale' of the weights"
    # one probability per face point, or a single one for a stable release
    answers: Literal["patch", "stability"] = "patch"
    piece: str
    geometry: str
    delta: float = 0.9
    base_rate: float
    temperature: float = 1.0
    metrics: dict[str, Any] = {}
    data: dict[str, Any] = {}
    training: dict[str, Any] = {}
    seed: int
    program_version: str
    weights_sha256: str
    licence: str = "Apache-2.0"
    # All training data came from a simulated bench, or those of the checkpoint it is tuned from.
    simulated: bool = True
    # benches of the training data, as far as known
    benches: tuple[BenchDescription, ...] = ()
    grid_mm: float = 1.0  # pitch of the face points
    # identifies the training set: episodes, files, label revisions and sides
    manifest_sha256: str = ""
    calibration: PatchCalibration | None = None


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """Loaded model: weights by name, as listed by ``expected_arrays``, and card."""

    arrays: Mapping[str, NDArray[np.float32]]
    card: ModelCard


def card_path(path: Path) -> Path:
    """Return the path of the card of the weights ``path``."""
    return path.with_suffix(".json")


def save_checkpoint(path: Path, arrays: Mapping[str, NDArray[Any]], card: Card) -> Card:
    """Write weights and card; return the card with the hash of the weights."""
    content = save_arrays({name: np.ascontiguousarray(array) for name, array in arrays.items()})
    sealed = card.model_copy(update={"weights_sha256": hashlib.sha256(content).hexdigest()})
    write_atomically(path, content)
    save_card(path, sealed)
    return sealed


def save_half_precision(path: Path, model: Checkpoint) -> ModelCard:
    """Write a model with 16-bit weights; ``mean`` and ``scale`` keep 32 bits."""
    arrays = {
        name: array if name in FULL_PRECISION else array.astype(np.float16)
        for name, array in model.arrays.items()
    }
    return save_checkpoint(path, arrays, model.card)


def save_card(path: Path, card: BaseModel) -> None:
    """Write the card of the weights ``path``, for example with further metrics."""
    text = json.dumps(card.model_dump(), indent=2, sort_keys=True, ensure_ascii=False)
    write_atomically(card_path(path), text.encode("utf-8") + b"\n")


def load_checkpoint(path: Path) -> Checkpoint:
    """Load and check a model. No code in the file is executed.

    Parameters
    ----------
    path : Path
        Weights (``.safetensors``), with the card (``.json``) beside them.

    Returns
    -------
    Checkpoint
        Weights as float32 arrays by name, and card.

    Raises
    ------
    InputError
        For any problem of file type, card, hash, architecture (allow-list), name, shape, type or
        values of a tensor, or length and order of the input. The error names the file.

    """
    content = read_limited(path, MAX_WEIGHT_BYTES, FIX)
    if content.startswith(_PICKLES) and content[8:9] != b"{":
        raise _bad(path, "This is a pickled PyTorch file; such files can run code and are refused")
    card = load_card(path)
    if hashlib.sha256(content).hexdigest() != card.weights_sha256:
        raise _bad(path, "The weights are damaged or not those of their card (SHA-256 differs)")
    arrays = parse_arrays(content, path)
    _check_arrays(arrays, card.hyper, path)
    return Checkpoint({name: a.astype(np.float32, copy=False) for name, a in arrays.items()}, card)


def load_card(path: Path) -> ModelCard:
    """Load and check the card of the weights ``path``."""
    where = card_path(path)
    card = read_json_model(ModelCard, where, MAX_CARD_BYTES, FIX)
    wanted = inference.modality_columns(card.modality)
    problems = {
        f"architecture '{card.arch}' is not known": card.arch not in inference.ARCHITECTURES,
        f"it needs {card.frames} frames": card.frames != SAMPLES_PER_PROBE,
        f"it needs {card.rate_hz} Hz": card.rate_hz != 10,
        f"its channels are ordered {card.vector_order}": card.vector_order
        != inference.VECTOR_ORDER,
        f"it has {card.hyper.inputs} inputs": card.hyper.inputs != wanted.stop - wanted.start,
    }
    for problem, applies in problems.items():
        if applies:
            raise _bad(where, f"The model does not fit this program: {problem}")
    return card


def pretraining_text(card: ModelCard) -> str:
    """Return the checkpoint and the mixed-in episodes of a fine-tuned model, "" for others."""
    origin, mixed = card.data.get("pretrained"), card.data.get("mixed")
    before = card.metrics.get("validation", {}).get("pretrained", {}).get("iou")
    figures = "" if before is None else f", IoU {100 * before:.0f} % on the same held-out probes"
    texts = (
        f"Fine-tuned from the model {origin['weights_sha256'][:12]}{figures}." if origin else "",
        f"{mixed['episodes']:,} of the training probes were mixed in." if mixed else "",
    )
    return " ".join(filter(None, texts))


def check_face(
    card: ModelCard, piece: str, geometry: str, where: str, points: int | None = None
) -> None:
    """Raise ``InputError`` unless a model is of a face: piece, hash, and number of points."""
    if card.piece != piece:
        what = f"The model is of '{card.piece}', not of '{piece}'."
    elif points not in (None, card.hyper.points):
        what = f"The model knows {card.hyper.points} face points, '{piece}' has {points}."
    elif card.geometry != geometry:
        what = f"The model was trained for another version of '{piece}' (content hash differs)."
    else:
        return
    fix = f"Choose the model of '{piece}', or train one."
    raise InputError(what, where, fix)


def parse_arrays(content: bytes, path: Path) -> dict[str, NDArray[Any]]:
    """Parse safetensors bytes; raises ``InputError`` with ``path``."""
    try:
        return load_arrays(content)
    except (SafetensorError, ValueError, KeyError) as error:
        raise _bad(path, f"The file is not a complete safetensors file ({error})") from error


def _check_arrays(
    arrays: dict[str, NDArray[Any]], shape: inference.NetworkShape, path: Path
) -> None:
    expected = inference.expected_arrays(shape)
    if set(arrays) != set(expected):
        odd = ", ".join(sorted(set(arrays) ^ set(expected)))
        raise _bad(path, f"Missing or unexpected tensors: {odd}")
    for name, array in arrays.items():
        if array.shape != expected[name]:
            raise _bad(path, f"Tensor '{name}' has shape {array.shape}, not {expected[name]}")
        if array.dtype not in STORED:
            raise _bad(path, f"Tensor '{name}' is {array.dtype}, not float32 or float16")
        if not np.isfinite(array).all():
            raise _bad(path, f"Tensor '{name}' holds values that are not finite")
    if not (arrays["scale"] > 0).all():
        raise _bad(path, "Tensor 'scale' holds values that are not positive")


def _bad(path: Path, what: str) -> InputError:
    return InputError(f"{what}.", str(path), FIX)
