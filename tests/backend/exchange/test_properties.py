"""Property tests: finite numbers are restored exactly; incomplete files are refused."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tests.backend.catalogue.conftest import context_for
from tests.backend.exchange.conftest import Hand, recorded_episode
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.values import Label
from touchdown.backend.core.faults import InputError
from touchdown.backend.core.values import Recording
from touchdown.backend.exchange import coco, csv_tables, jsonl
from touchdown.backend.exchange.exports import export_dataset, export_format
from touchdown.backend.exchange.imports import EpisodeImport, ImportOptions
from touchdown.backend.exchange.query import ExportQuery

ALL = ExportQuery(states=("draft",), held_out=0.0)
WISH = ImportOptions("dora")
FINITE = st.floats(width=32, allow_nan=False, allow_infinity=False)
POSITION_MM = st.floats(-1e6, 1e6)
MICROMETRES = st.integers(-1_000_000, 1_000_000)


@st.composite
def probes(draw: st.DrawFn) -> tuple[Any, Any, Any, Label]:
    """Observation, measured and commanded poses, and a label."""
    label = Label(
        draw(MICROMETRES), draw(MICROMETRES), draw(st.integers(-180_000, 180_000)),
        draw(st.none() | st.integers(0, 10_000)),
    )  # fmt: skip
    poses = arrays(np.float64, (260, 3), elements=POSITION_MM)
    return draw(arrays(np.float32, (20, 258), elements=FINITE)), draw(poses), draw(poses), label


def out_of(dataset: Dataset, kind: str, out: Path) -> Path:
    return export_dataset(dataset, export_format(kind), ALL, out, "none").folder


def numbers(folder: Path, kind: str) -> Any:
    """The low-dimensional data as it lies in the files."""
    if kind == "lerobot":
        return (folder / "data/chunk-000/file-000.parquet").read_bytes()
    found: dict[str, bytes] = {}
    with h5py.File(folder / "demos.hdf5") as file:
        file["data"].visititems(
            lambda name, item: found.update({name: item[()].tobytes()})
            if isinstance(item, h5py.Dataset) else None
        )  # fmt: skip
    return found


@pytest.mark.parametrize("kind", ["lerobot", "robomimic"])
@settings(
    max_examples=2, deadline=None, derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow,
                           HealthCheck.data_too_large, HealthCheck.large_base_example],
)  # fmt: skip
@given(drawn=st.lists(probes(), min_size=2, max_size=3))
def test_any_finite_probe_comes_back_bit_by_bit(kind: str, tmp_path: Path, drawn: Any) -> None:
    place = tmp_path / "one"
    shutil.rmtree(place, ignore_errors=True)
    with Dataset.open(place / "here") as here, Dataset.open(place / "there") as there:
        for observation, pose_mm, command_mm, label in drawn:
            episode = recorded_episode(1, frames=False)
            assert isinstance(episode.recording, Recording)
            recording = replace(episode.recording, pose_mm=pose_mm, command_mm=command_mm)
            episode = replace(episode, observation=observation, recording=recording)
            here.record(episode, label, source="measured", context=context_for(here))
        first = out_of(here, kind, place / "first")
        EpisodeImport(there, kind, first, WISH).write()
        assert numbers(out_of(there, kind, place / "again"), kind) == numbers(first, kind)
        mine = [here.read(e.uuid).observation.tobytes() for e in here.episodes()]
        theirs = [there.read(e.uuid).observation.tobytes() for e in there.episodes()]
        assert theirs == mine
        labels = [[d.labels.head(e.uuid).label for e in d.episodes()] for d in (here, there)]
        assert labels[0] == labels[1]


@given(value=st.none() | st.integers(-(10**9), 10**9))
def test_any_thousandth_is_read_as_it_was_written(value: int | None) -> None:
    written = csv_tables._thousandth(value)
    assert csv_tables._whole(written, "x_mm", Path("t.csv"), 2) == value


@pytest.mark.parametrize("kind", ["lerobot", "robomimic"])
def test_half_an_export_is_refused_with_and_without_its_manifest(
    kind: str, hand: Hand, dataset: Dataset
) -> None:
    out = hand(kind).folder
    name = "data/chunk-000/file-000.parquet" if kind == "lerobot" else "demos.hdf5"
    whole = (out / name).read_bytes()
    for share in (0.0, 0.5, 0.99):
        (out / name).write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(InputError, match="cut short"):
            EpisodeImport(dataset, kind, out, WISH)
    (out / "manifest.json").unlink()
    wish = ImportOptions("dora", None, "pot", "circle15")
    with pytest.raises(InputError) as error:
        EpisodeImport(dataset, kind, out, wish).survey()
    assert str(out) in error.value.where


@pytest.mark.parametrize("kind", ["csv", "coco", "jsonl"])
def test_labels_of_a_file_that_was_cut_are_refused(kind: str, hand: Hand, dataset: Dataset) -> None:
    out = hand(kind).folder
    name = {"csv": csv_tables.FILE, "coco": "annotations.json", "jsonl": jsonl.FILE}[kind]
    whole = (out / name).read_bytes()
    read: dict[str, Callable[[], object]] = {
        "csv": lambda: list(csv_tables.read_csv(out / name, dataset)),
        "coco": lambda: list(coco.read_coco(out / name, dataset)),
        "jsonl": lambda: jsonl.read_jsonl(out / name),
    }
    for cut in (10, len(whole) // 2, len(whole) - 40):
        (out / name).write_bytes(whole[:cut])
        with pytest.raises(InputError) as error:
            read[kind]()
        assert error.value.where.startswith(str(out / name))
