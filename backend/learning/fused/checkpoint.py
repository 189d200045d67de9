"""Checkpoint files of the fusion network: ``<name>.safetensors`` with a JSON card.

Loading runs no code.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from touchdown.backend.config import SHIPPED_NETWORKS, read_json_model
from touchdown.backend.core import InputError, read_limited
from touchdown.backend.learning.checkpoint import card_path, parse_arrays
from touchdown.backend.learning.fused import features
from touchdown.backend.learning.inference import VECTOR_ORDER

MAX_BYTES = 10_000_000
FIX = "Use the one that came with Touchdown, or train again with 'touchdown experiment fused'."


class FusedCard(BaseModel):
    """Card of the fusion network: sizes, training data and evaluation."""

    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid")
    format: Literal["touchdown-fused/1"] = "touchdown-fused/1"
    arch: Literal["causal-attention-inset/1"] = features.ARCH
    hyper: features.FusedShape
    vector_order: str = VECTOR_ORDER
    ticks: tuple[int, ...] = features.TICKS
    answers: str = "how far a point lies within the support, mm: a mixture of normal distributions"
    family: str = ""  # pieces and bottoms of the training, as text
    outlines: Literal["convex", "any"] = "convex"  # kinds of outlines in the training
    left_out: tuple[str, ...] = ()  # pieces and bottoms that are not in the training
    bench_sha256: str
    data_sha256: str
    seed: int
    training: dict[str, Any] = {}
    metrics: dict[str, Any] = {}
    program_version: str
    weights_sha256: str = ""
    licence: str = "Apache-2.0"
    simulated: bool = True


@dataclass(frozen=True, slots=True)
class FusedCheckpoint:
    """Loaded network: arrays by name, as listed by ``expected_fused_arrays``, and card."""

    arrays: Mapping[str, NDArray[np.float32]]
    card: FusedCard


def load_fused(path: Path) -> FusedCheckpoint:
    """Load and check a network; raises ``InputError`` with the file for any problem.

    Checked: size, card, hash, name, shape and type of every array, finite values.
    """
    content = read_limited(path, MAX_BYTES, FIX)
    card = read_json_model(FusedCard, card_path(path), MAX_BYTES, FIX)
    if hashlib.sha256(content).hexdigest() != card.weights_sha256:
        raise _bad(path, "The weights are damaged or not those of their card (SHA-256 differs)")
    if card.vector_order != VECTOR_ORDER or card.ticks != features.TICKS:
        raise _bad(path, "It reads other channels or instants than this program")
    found = FusedCheckpoint(parse_arrays(content, path), card)
    expected = features.expected_fused_arrays(card.hyper)
    if {name: array.shape for name, array in found.arrays.items()} != expected:
        raise _bad(path, "Its arrays are not those that its card announces")
    if any(a.dtype != np.float32 or not np.isfinite(a).all() for a in found.arrays.values()):
        raise _bad(path, "It holds values that are not finite 32-bit numbers")
    if not (found.arrays["scale"] > 0).all():
        raise _bad(path, "'scale' holds values that are not positive")
    return found


def join_networks(networks: Sequence[FusedCheckpoint]) -> FusedCheckpoint:
    """Return the ensemble of networks of equal sizes, trained on the same data.

    Raises ``InputError`` if their sizes, data or scaling differ.
    """
    first, shared = networks[0], features.shared_arrays()
    for other in networks[1:]:
        same = all(np.array_equal(other.arrays[name], first.arrays[name]) for name in shared)
        cards = other.card.hyper == first.card.hyper, other.card.data_sha256
        if cards != (True, first.card.data_sha256) or not same or first.card.hyper.networks > 1:
            raise InputError("The networks have different sizes or data.", "ensemble", FIX)
    hyper = replace(first.card.hyper, networks=len(networks))
    arrays = {
        name: array if name in shared else np.stack([one.arrays[name] for one in networks])
        for name, array in first.arrays.items()
    }
    metrics = {
        name: round(float(np.mean([one.card.metrics[name] for one in networks])), 4)
        for name in first.card.metrics
    }
    training = {**first.card.training, "seeds": [one.card.seed for one in networks]}
    about = {"hyper": hyper, "metrics": metrics, "training": training}
    return FusedCheckpoint(arrays, first.card.model_copy(update=about))


def one_network(found: FusedCheckpoint, member: int) -> FusedCheckpoint:
    """Return the network ``member`` of an ensemble; a single network as it is."""
    if found.card.hyper.networks == 1:
        return found
    shared, hyper = features.shared_arrays(), replace(found.card.hyper, networks=1)
    arrays = {k: v if k in shared else v[member] for k, v in found.arrays.items()}
    return FusedCheckpoint(arrays, found.card.model_copy(update={"hyper": hyper}))


def shipped_path() -> Path:
    """Return the path of the network that comes with the program."""
    return Path(str(files("touchdown.resources"))) / "models" / "fused" / "fused.safetensors"


def network_path(weights: str) -> Path:
    """Return the file of ``FusedSettings.weights``: a name stands for a shipped one."""
    if weights in SHIPPED_NETWORKS:
        return shipped_path().with_stem(weights)
    return Path(weights) if weights else shipped_path()


@lru_cache(maxsize=2)
def _shipped(weights: str) -> FusedCheckpoint:
    return load_fused(network_path(weights))


def shipped_fused() -> FusedCheckpoint:
    """Return the network that comes with the program; raises ``InputError``."""
    return _shipped("")


def load_network(weights: str) -> FusedCheckpoint:
    """Return the network of ``network_path``; raises ``InputError``."""
    return _shipped(weights) if weights in ("", *SHIPPED_NETWORKS) else load_fused(Path(weights))


def _bad(path: Path, what: str) -> InputError:
    return InputError(f"{what}.", str(path), FIX)
