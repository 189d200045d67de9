"""Models on disk: ``<name>.safetensors`` with a JSON card beside it. Loading runs no code."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor

from backend.config.method import SAMPLES_PER_PROBE
from backend.core.faults import InputError
from backend.core.files import write_atomically
from backend.learning.features import VECTOR_ORDER, Modality, columns
from backend.learning.model import ARCHITECTURES, PatchNet, Shape, expected_tensors

MAX_WEIGHT_BYTES = 100_000_000
MAX_CARD_BYTES = 1_000_000
FIX = "Use the model that came with Touchdown, or train again with 'touchdown train'."
_PICKLES = (b"PK\x03\x04", b"\x80")
Size = Annotated[int, Field(ge=1, le=100_000)]


class Sizes(BaseModel):
    """Sizes of the network."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    inputs: Size
    hidden: Annotated[int, Field(ge=1, le=4096)]
    layers: Annotated[int, Field(ge=1, le=8)]
    points: Size


class Card(BaseModel):
    """The model card: what the weights are, and what they were made from."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    format: Literal["touchdown-model/1"] = "touchdown-model/1"
    arch: str
    hyper: Sizes
    modality: Modality
    vector_order: str = VECTOR_ORDER
    rate_hz: int = 10
    frames: int = SAMPLES_PER_PROBE
    resampling: str = "markers linear between frames, wrench mean of the 100 ms before the tick"
    normaliser: str = "tensors 'mean' and 'scale' of the weights"
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
    simulated: bool = True


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """A loaded model, ready to use (evaluation mode), and its card."""

    model: PatchNet
    card: Card


def card_path(path: Path) -> Path:
    """Return where the card of the weights ``path`` lies."""
    return path.with_suffix(".json")


def save_checkpoint(path: Path, model: PatchNet, card: Card) -> Card:
    """Write weights and card; returns the card with the weights' hash."""
    tensors = {name: tensor.contiguous() for name, tensor in model.state_dict().items()}
    content = save_tensors(tensors)
    sealed = card.model_copy(update={"weights_sha256": hashlib.sha256(content).hexdigest()})
    write_atomically(path, content)
    save_card(path, sealed)
    return sealed


def save_card(path: Path, card: Card) -> None:
    """Write the card of the weights ``path``, for example with further metrics."""
    text = json.dumps(card.model_dump(), indent=2, sort_keys=True, ensure_ascii=False)
    write_atomically(card_path(path), text.encode("utf-8") + b"\n")


def load_checkpoint(path: Path) -> Checkpoint:
    """Load and check a model; whatever is wrong raises one ``InputError`` naming the file.

    Checked: kind of file, card, hash, allow-listed architecture, name, shape and type of every
    tensor, finite values, length and order of the input.
    """
    content = _read(path, MAX_WEIGHT_BYTES)
    if content.startswith(_PICKLES) and content[8:9] != b"{":
        raise _bad(path, "This is a pickled PyTorch file; such files can run code and are refused")
    card = load_card(path)
    if hashlib.sha256(content).hexdigest() != card.weights_sha256:
        raise _bad(path, "The weights are damaged or not those of their card (SHA-256 differs)")
    shape = Shape(**card.hyper.model_dump())
    tensors = parse_tensors(content, path)
    _check_tensors(tensors, shape, path)
    with torch.device("meta"):
        model = PatchNet(shape)
    model.load_state_dict(tensors, strict=True, assign=True)
    model.requires_grad_(False)
    return Checkpoint(model.eval(), card)


def load_card(path: Path) -> Card:
    """Load and check the card of the weights ``path``."""
    where = card_path(path)
    content = _read(where, MAX_CARD_BYTES)
    try:
        card = Card.model_validate_json(content)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"]) or "(file)"
        raise _bad(where, f"Bad model card, '{key}': {first['msg']}") from error
    wanted = columns(card.modality)
    problems = {
        f"architecture '{card.arch}' is not known": card.arch not in ARCHITECTURES,
        f"it wants {card.frames} frames": card.frames != SAMPLES_PER_PROBE,
        f"it wants {card.rate_hz} Hz": card.rate_hz != 10,
        f"its channels are ordered {card.vector_order}": card.vector_order != VECTOR_ORDER,
        f"it has {card.hyper.inputs} inputs": card.hyper.inputs != wanted.stop - wanted.start,
    }
    for problem, applies in problems.items():
        if applies:
            raise _bad(where, f"The model does not fit this program: {problem}")
    return card


def parse_tensors(content: bytes, path: Path) -> dict[str, Tensor]:
    """Parse safetensors bytes; raises ``InputError`` naming ``path``."""
    try:
        return load_tensors(content)
    except (SafetensorError, ValueError, KeyError) as error:
        raise _bad(path, f"The file is not a complete safetensors file ({error})") from error


def _check_tensors(tensors: dict[str, Tensor], shape: Shape, path: Path) -> None:
    expected = expected_tensors(shape)
    if set(tensors) != set(expected):
        odd = ", ".join(sorted(set(tensors) ^ set(expected)))
        raise _bad(path, f"Missing or unexpected tensors: {odd}")
    for name, tensor in tensors.items():
        if tuple(tensor.shape) != expected[name]:
            found = tuple(tensor.shape)
            raise _bad(path, f"Tensor '{name}' has shape {found}, not {expected[name]}")
        if tensor.dtype != torch.float32:
            raise _bad(path, f"Tensor '{name}' is {tensor.dtype}, not float32")
        if not torch.isfinite(tensor).all():
            raise _bad(path, f"Tensor '{name}' holds values that are not finite")
    if not (tensors["scale"] > 0).all():
        raise _bad(path, "Tensor 'scale' holds values that are not positive")


def _read(path: Path, limit: int) -> bytes:
    try:
        if path.stat().st_size > limit:
            raise _bad(path, "The file is too large for a model")
        return path.read_bytes()
    except OSError as error:
        reason = error.strerror or "unreadable"
        raise InputError(f"Cannot read the file: {reason}.", str(path), FIX) from error


def _bad(path: Path, what: str) -> InputError:
    return InputError(f"{what}.", str(path), FIX)
