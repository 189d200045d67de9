"""Pack files: up to 500 simulated episodes in one MCAP file, one self-contained chunk each."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.config import SAMPLES_PER_PROBE
from touchdown.backend.core import CHANNELS
from touchdown.backend.episodes import mcap_container
from touchdown.backend.episodes.mcap_container import START_KEY
from touchdown.backend.episodes.messages import (
    LABEL_TOPIC,
    OBSERVATION_TOPIC,
    pack_json,
    pack_observation,
    unpack_json,
    unpack_observation,
)

MAX_EPISODES = 500
SCHEMA_VERSION = "1"
_TICKS_NS = 100_000_000 * np.arange(1, SAMPLES_PER_PROBE + 1, dtype=np.int64)
_STEPS = np.arange(SAMPLES_PER_PROBE, dtype=np.int64)
_SPACING_NS = 3_000_000_000


@dataclass(frozen=True, slots=True)
class PackedEpisode:
    """One compact episode: ``observation`` (20, 258) float32 and its label (JSON values).

    Label keys: episode, x_um, y_um, sigma_um, source, piece, bottom, patch (hex of the packed bits
    over the face points), points, geometry (hash), grip_id, mounting_id, person, seed.
    """

    observation: NDArray[np.float32]
    label: Mapping[str, object]


class PackWriter:
    """Writer of one pack; closing without error makes it complete and durable.

    Headers hold the bench clock, which starts at zero, with 3 s per episode. Log times are on the
    wall clock: the bench clock plus ``START_KEY`` of ``metadata``, which becomes the record
    ``pack``. The 501st episode raises ``ValueError``.
    """

    def __init__(self, path: Path, metadata: Mapping[str, str]) -> None:
        self._writer = mcap_container.McapWriter(path, (OBSERVATION_TOPIC, LABEL_TOPIC))
        self._writer.start_ns = int(metadata.get(START_KEY, 0))
        self._writer.add_metadata("pack", {"schema_version": SCHEMA_VERSION, **metadata})
        self.episodes = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._writer.__exit__(kind)

    def write(self, row: PackedEpisode) -> None:
        """Append one episode; raises ``ValueError`` for a shape other than (20, 258) or a NaN."""
        if self.episodes >= MAX_EPISODES:
            raise ValueError(f"a pack holds at most {MAX_EPISODES} episodes")
        if row.observation.shape != (SAMPLES_PER_PROBE, CHANNELS):
            raise ValueError(f"observation has shape {row.observation.shape}")
        if not np.isfinite(row.observation).all():
            raise ValueError("an observation holds a value that is not finite")
        base = self.episodes * _SPACING_NS
        stamps = base + _TICKS_NS
        observation = pack_observation(stamps, row.observation)
        obs = self._writer.block(OBSERVATION_TOPIC, stamps, _STEPS, observation)
        label = self._writer.block(LABEL_TOPIC, [base], [self.episodes], [pack_json(row.label)])
        self._writer.add_chunk([obs, label], compress=True)
        self.episodes += 1


def write_packs(
    folder: Path, stem: str, rows: Iterator[PackedEpisode], metadata: Mapping[str, str]
) -> int:
    """Write ``rows`` into ``<stem>-0000.mcap``, ``<stem>-0001.mcap`` ...; return their number.

    With ``START_KEY`` in ``metadata``, each pack starts where the one before ends.
    """
    total, facts = 0, dict(metadata)
    row = next(rows, None)
    while row is not None:
        number = total // MAX_EPISODES
        if START_KEY in metadata:
            facts[START_KEY] = str(int(metadata[START_KEY]) + total * _SPACING_NS)
        with PackWriter(folder / f"{stem}-{number:04d}.mcap", facts) as pack:
            while row is not None and pack.episodes < MAX_EPISODES:
                pack.write(row)
                total += 1
                row = next(rows, None)
    return total


def read_pack(path: Path) -> Iterator[PackedEpisode]:
    """Yield the episodes of a pack in order; raises ``InputError`` for a damaged file."""
    for chunk in mcap_container.read_chunks(path):
        if chunk.contents.messages:
            with mcap_container.input_errors(path):
                row = _row(chunk.contents)
            yield row


def _row(group: mcap_container.ChunkContents) -> PackedEpisode:
    if OBSERVATION_TOPIC.name not in group.messages or LABEL_TOPIC.name not in group.messages:
        raise ValueError("an episode lacks its observation or its label")
    observation = unpack_observation(group.messages[OBSERVATION_TOPIC.name])
    if observation.shape != (SAMPLES_PER_PROBE, CHANNELS):
        raise ValueError(f"an observation has shape {observation.shape}, not (20, 258)")
    if not np.isfinite(observation).all():
        raise ValueError("an observation holds a value that is not finite")
    return PackedEpisode(observation, unpack_json(group.messages[LABEL_TOPIC.name][0]))
