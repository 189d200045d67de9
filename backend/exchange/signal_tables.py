"""The recorded signals of an episode as tables at their own rates, for spreadsheets and R.

Times are seconds since the contact. Every number is written so that reading it gives the same bits.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from backend.catalogue.dataset import Dataset
from backend.catalogue.values import EpisodeEntry
from backend.core.flow import MARKERS, FloatArray, MarkerState, Recording
from backend.dataset.contents import read_first
from backend.dataset.episode_reading import episode_of
from backend.exchange.features import FT_NAMES

SIGNALS = "signals"
FT_FILE, MARKERS_FILE, POSES_FILE = "ft.csv", "markers.csv", "poses.csv"
FT_COLUMNS = ("t_s", *FT_NAMES)
MARKER_COLUMNS = ("t_s", "finger", "marker", "u_px", "v_px", "du_px", "dv_px", "state")
POSE_COLUMNS = ("t_s", "kind", "x_mm", "y_mm", "z_mm")
STATES = {state.value: state.name.lower() for state in MarkerState}
Row = Iterable[object]


def write_signals(dataset: Dataset, entry: EpisodeEntry, folder: Path) -> None:
    """Write the tables of one episode to ``folder/<uuid>``; none where no signals were recorded."""
    path = dataset.folder / entry.path
    episode = episode_of(read_first(path), path)
    recording, onset_s = episode.recording, episode.onset_s
    if recording is None:
        return
    place = folder / entry.uuid
    place.mkdir(parents=True)
    _table(place / FT_FILE, FT_COLUMNS, _timed(recording.wrench_t_s - onset_s, recording.wrench))
    _table(place / MARKERS_FILE, MARKER_COLUMNS, _markers(recording, onset_s))
    _table(place / POSES_FILE, POSE_COLUMNS, _poses(recording, onset_s))


def _table(path: Path, columns: Sequence[str], rows: Iterable[Row]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(columns)
        table.writerows(rows)


def _timed(t_s: FloatArray, values: FloatArray, *words: str) -> Iterator[Row]:
    for at_s, row in zip(t_s.tolist(), values.tolist(), strict=True):
        yield (at_s, *words, *row)


def _markers(recording: Recording, onset_s: float) -> Iterator[Row]:
    for field in recording.fields:
        at_s = field.t_s - onset_s
        places = zip(
            range(MARKERS), field.position_px.tolist(), field.displacement_px.tolist(),
            field.state.tolist(), strict=True,
        )  # fmt: skip
        for marker, position, displacement, state in places:
            yield (at_s, field.finger, marker, *position, *displacement, STATES[state])


def _poses(recording: Recording, onset_s: float) -> Iterator[Row]:
    yield from _timed(recording.pose_t_s - onset_s, recording.pose_mm, "measured")
    yield from _timed(recording.command_t_s - onset_s, recording.command_mm, "commanded")
