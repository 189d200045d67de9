"""One episode of a foreign file as its reader found it: arrays by our names, not mapped yet."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

FACTS = "facts.json"


@dataclass(frozen=True, slots=True)
class ForeignEpisode:
    """``values``: (T, ...) per feature. ``side``: of a split, or "". ``uuid``: ours, if it says."""

    index: int
    fps: float | None
    values: Mapping[str, NDArray[Any]]
    side: str = ""
    uuid: str = ""


Read = Callable[[Path], Iterator[ForeignEpisode]]


def save(episode: ForeignEpisode, path: Path) -> None:
    """Write an episode for the other process: arrays without objects, facts as JSON text."""
    facts = {name: getattr(episode, name) for name in ("index", "fps", "side", "uuid")}
    text = np.frombuffer(json.dumps(facts).encode("utf-8"), np.uint8)
    np.savez(path, **{FACTS: text, **episode.values})  # type: ignore[arg-type]


def load(path: Path) -> ForeignEpisode:
    """Read what ``save`` wrote; nothing in it is ever executed."""
    with np.load(path, allow_pickle=False) as stored:
        facts = json.loads(stored[FACTS].tobytes())
        values = {name: stored[name] for name in stored.files if name != FACTS}
    return ForeignEpisode(values=values, **facts)
