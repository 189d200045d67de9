"""A dataset with a pair of real pieces, and small episodes to fill it with."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.labels import read_review_status
from touchdown.backend.annotations.values import (
    NO_LABEL,
    EpisodeContext,
    EpisodeEntry,
    Label,
    uuid7,
)
from touchdown.backend.core.values import Episode, EpisodeQuality
from touchdown.backend.episodes import LABEL_TOPIC, read_whole, unpack_json
from touchdown.backend.geometry.pieces import load_pieces

Record = Callable[..., EpisodeEntry]


def small_episode(name: str | None = None, seed: int = 1, accepted: bool = True) -> Episode:
    rng = np.random.default_rng(seed)
    reasons = () if accepted else ("slip",)
    quality = EpisodeQuality(accepted, reasons, 0, 0.0, 0, 5.0, 0.0)
    observation = rng.normal(size=(20, 258)).astype(np.float32)
    return Episode(name or uuid7(), "pot", observation, rng.normal(size=2), 0.5, quality)


def context_for(dataset: Dataset, piece: str = "pot", bottom: str = "circle15") -> EpisodeContext:
    pieces = load_pieces()
    geometry = dataset.geometry.store_pair(pieces.top(piece), pieces.bottom(bottom))
    return EpisodeContext(
        series="series-1",
        bottom=bottom,
        geometry=geometry,
        person="cleo",
        grip_id="grip-1",
        mounting_id="mounting-1",
        campaign="campaign-1",
        plan_item=3,
        seed=7,
    )


def add(
    dataset: Dataset,
    label: Label = NO_LABEL,
    source: str = "commanded",
    context: EpisodeContext | None = None,
    **episode: Any,
) -> EpisodeEntry:
    """Record a small episode with ``label``."""
    return dataset.record(
        small_episode(**episode), label, source=source, context=context or context_for(dataset)
    )


def authors(dataset: Dataset, uuid: str) -> tuple[str, ...]:
    """Return the authors of a label."""
    with dataset.database.reading() as connection:
        return read_review_status(connection, uuid).authors


def flip_byte(path: Path, at: float = 0.5) -> bytes:
    """Change one byte of a file, at a part ``at`` of its length; return the new content."""
    data = bytearray(path.read_bytes())
    data[int(at * len(data))] ^= 1
    path.write_bytes(data)
    return bytes(data)


@pytest.fixture
def dataset(tmp_path: Path) -> Iterator[Dataset]:
    with Dataset.open(tmp_path / "data", person="cleo") as opened:
        yield opened


@pytest.fixture
def record(dataset: Dataset) -> Record:
    context = context_for(dataset)

    def make(x_um: int | None = 1000, y_um: int | None = -500, **changes: bool) -> EpisodeEntry:
        label = Label(x_um, y_um, 0, 150) if x_um is not None else Label()
        return add(dataset, label, context=context, **changes)

    return make


@pytest.fixture
def place() -> Iterator[Path]:
    """A folder in memory where there is one: a killed process loses no more there than on disk."""
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        yield Path(folder).resolve()


def stored_label(path: Path) -> dict[str, object] | None:
    """Return the label in an episode file."""
    messages = read_whole(path).messages.get(LABEL_TOPIC.name, [])
    return unpack_json(messages[-1]) if messages else None
