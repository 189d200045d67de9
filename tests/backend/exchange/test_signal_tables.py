"""Tables of signals: the recorded numbers bit by bit, in units that stand in the header."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.backend.catalogue.conftest import context_for
from tests.backend.exchange.conftest import recorded_episode
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.values import Label
from touchdown.backend.core.faults import InputError
from touchdown.backend.core.values import FINGERS, MARKERS, MarkerField
from touchdown.backend.exchange.exports import export_dataset, export_format
from touchdown.backend.exchange.query import ExportQuery

ALL = ExportQuery(states=("draft",))


def columns(path: Path) -> dict[str, list[str]]:
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {name: [row[name] for row in rows] for name in rows[0]}


def floats(table: dict[str, list[str]], *names: str) -> np.ndarray[Any, Any]:
    return np.array([[float(text) for text in table[name]] for name in names]).T


def test_every_sample_is_in_its_table(tmp_path: Path) -> None:
    episode = recorded_episode(3, frames=False)
    assert episode.recording is not None
    rng = np.random.default_rng(8)
    fields = tuple(
        MarkerField(f, k, 1.0 + 0.04 * k, rng.normal(size=(MARKERS, 2)),
                    rng.normal(size=(MARKERS, 2)), rng.integers(0, 3, MARKERS).astype(np.uint8), 1)
        for k in range(3) for f in FINGERS
    )  # fmt: skip
    episode = replace(episode, recording=replace(episode.recording, fields=fields))
    with Dataset.open(tmp_path / "data") as dataset:
        entry = dataset.record(
            episode, Label(1, 2, 0, 3), source="measured", context=context_for(dataset)
        )
        done = export_dataset(dataset, export_format("csv", tables=True), ALL, tmp_path / "out")
        stored = dataset.read(entry.uuid)
    recording, onset_s = stored.recording, stored.onset_s
    assert recording is not None
    place = done.folder / "signals" / entry.uuid
    ft = columns(place / "ft.csv")
    names = ("fx_n", "fy_n", "fz_n", "tx_nm", "ty_nm", "tz_nm")
    assert floats(ft, *names).tobytes() == recording.wrench.tobytes()
    since_s = floats(ft, "t_s")[:, 0] + onset_s
    np.testing.assert_allclose(since_s, recording.wrench_t_s, rtol=0, atol=1e-12)
    markers = columns(place / "markers.csv")
    assert len(markers["t_s"]) == len(fields) * MARKERS
    for number, field in enumerate(recording.fields):
        rows = slice(number * MARKERS, (number + 1) * MARKERS)
        part = {name: values[rows] for name, values in markers.items()}
        assert set(part["finger"]) == {field.finger}
        assert part["marker"] == [str(k) for k in range(MARKERS)]
        assert floats(part, "u_px", "v_px").tobytes() == field.position_px.tobytes()
        assert floats(part, "du_px", "dv_px").tobytes() == field.displacement_px.tobytes()
        words = ("seen", "inferred", "lost")
        assert part["state"] == [words[state] for state in field.state]
    poses = columns(place / "poses.csv")
    for kind, t_s, told_mm in (
        ("measured", recording.pose_t_s, recording.pose_mm),
        ("commanded", recording.command_t_s, recording.command_mm),
    ):
        mine = [k for k, word in enumerate(poses["kind"]) if word == kind]
        part = {name: [values[k] for k in mine] for name, values in poses.items()}
        assert floats(part, "x_mm", "y_mm", "z_mm").tobytes() == told_mm.tobytes()
        np.testing.assert_allclose(floats(part, "t_s")[:, 0] + onset_s, t_s, rtol=0, atol=1e-12)


def test_other_formats_hold_no_tables() -> None:
    with pytest.raises(InputError, match="holds no tables"):
        export_format("zarr", tables=True)


def test_without_recorded_signals_there_are_labels_only(tmp_path: Path) -> None:
    silent = replace(recorded_episode(3, frames=False), recording=None)
    with Dataset.open(tmp_path / "data") as dataset:
        dataset.record(silent, Label(1, 2, 0, 3), source="measured", context=context_for(dataset))
        done = export_dataset(dataset, export_format("csv", tables=True), ALL, tmp_path / "out")
    assert (done.folder / "episodes.csv").is_file()
    assert not (done.folder / "signals").exists()
