"""Foreign files: read in a child process, with one error for any failure."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.core.faults import InputError
from touchdown.backend.exchange.imports import EpisodeImport, ImportOptions, read_foreign

NAMED = ImportOptions("dora", "dora", "pot", "circle15")


def robomimic_file(path: Path, **changes: Any) -> Path:
    """A file by robomimic's own description, as another program would write it."""
    rng = np.random.default_rng(1)
    obs = {"markers": rng.normal(size=(20, 252)), "ft": rng.normal(size=(20, 6))} | changes
    with h5py.File(path, "w") as file:
        demo = file.create_group("data/demo_0")
        file["data"].attrs["env_args"] = json.dumps({"env_name": "x", "env_type": 2})
        demo.attrs["num_samples"] = 20
        demo["actions"] = np.zeros((20, 7))
        for name, values in obs.items():
            if values is not None:
                demo[f"obs/{name}"] = values
        file["mask/valid"] = np.array(["demo_0"], dtype="S")
    return path


def lerobot_21(folder: Path, fps: int = 10) -> Path:
    """A dataset of version 2.1: one parquet file per episode."""
    rng = np.random.default_rng(2)
    features = {
        "observation.markers": {"dtype": "float32", "shape": [252], "names": None},
        "observation.ft": {"dtype": "float32", "shape": [6], "names": None},
    }
    (folder / "meta").mkdir(parents=True)
    info = {"codebase_version": "v2.1", "fps": fps, "features": features, "video_path": None,
            "splits": {"train": "0:2"}}  # fmt: skip
    (folder / "meta/info.json").write_text(json.dumps(info))
    for k in range(2):
        columns: dict[str, Any] = {
            key: rng.normal(size=(20, *f["shape"])).astype(np.float32).tolist()  # type: ignore[misc]
            for key, f in features.items()
        }
        columns |= {"episode_index": [k] * 20, "frame_index": list(range(20))}
        path = folder / f"data/chunk-000/episode_{k:06d}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.table(columns), path)
    return folder


@pytest.fixture
def back(tmp_path: Path) -> Any:
    with Dataset.open(tmp_path / "back") as dataset:
        yield dataset


def test_a_robomimic_file_of_others_comes_in(back: Dataset, tmp_path: Path) -> None:
    path = robomimic_file(tmp_path / "demo.hdf5")
    survey = EpisodeImport(back, "robomimic", path, NAMED).survey()
    assert (survey.found, survey.fit, survey.problems) == (1, 1, ())
    assert any("names no rate" in loss for loss in survey.losses)
    (uuid,) = EpisodeImport(back, "robomimic", path, NAMED).write()
    with h5py.File(path, "r") as file:
        markers = file["data/demo_0/obs/markers"][()].astype(np.float32)
    assert back.read(uuid).observation[:, :252].tolist() == markers.tolist()
    assert back.labels.head(uuid).state == "unlabelled"
    assert "split:valid" in back.labels.marks(uuid)


def test_lerobot_21_comes_in(back: Dataset, tmp_path: Path) -> None:
    written = EpisodeImport(back, "lerobot", lerobot_21(tmp_path / "old"), NAMED).write()
    assert len(written) == 2
    # All on the side "train" is no split.
    assert [back.labels.marks(uuid) for uuid in written] == [{}, {}]


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"markers": None}, "it lacks observation.markers"),
        ({"ft": np.zeros((50, 6))}, "observation.ft has shape (50, 6)"),
        ({"markers": np.full((20, 252), np.nan)}, "not finite"),
    ],
)
def test_what_cannot_be_mapped_is_told_and_not_written(
    changes: dict[str, Any], why: str, back: Dataset, tmp_path: Path
) -> None:
    path = robomimic_file(tmp_path / "demo.hdf5", **changes)
    survey = EpisodeImport(back, "robomimic", path, NAMED).survey()
    assert survey.fit == 0
    assert why in survey.problems[0][0]
    assert EpisodeImport(back, "robomimic", path, NAMED).write() == []
    assert back.episodes() == []


def test_another_rate_is_not_taken_for_ours(back: Dataset, tmp_path: Path) -> None:
    survey = EpisodeImport(back, "lerobot", lerobot_21(tmp_path / "fast", fps=30), NAMED).survey()
    assert survey.problems == (("it has 30 ticks per second, not 10", 2),)


@pytest.mark.parametrize("content", [b"", b"\x89HDF\r\n\x1a\n" + b"\x00" * 500, b"x" * 5000])
def test_a_damaged_file_is_one_sentence(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "demo.hdf5"
    path.write_bytes(content)
    with pytest.raises(InputError, match="damaged or foreign"):
        list(read_foreign("robomimic", path))


def test_a_cut_file_is_one_sentence(tmp_path: Path) -> None:
    path = robomimic_file(tmp_path / "demo.hdf5")
    path.write_bytes(path.read_bytes()[:-3000])
    with pytest.raises(InputError):
        list(read_foreign("robomimic", path))


def test_a_damaged_parquet_file_is_one_sentence(tmp_path: Path) -> None:
    folder = lerobot_21(tmp_path / "old")
    path = next(folder.rglob("*.parquet"))
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(InputError, match="damaged or foreign"):
        list(read_foreign("lerobot", folder))


def test_a_reader_that_takes_too_long_is_given_up(tmp_path: Path) -> None:
    path = robomimic_file(tmp_path / "demo.hdf5")
    with pytest.raises(InputError, match="not read within"):
        list(read_foreign("robomimic", path, deadline_s=1e-3))


@pytest.mark.promise("P7", "P10")
def test_a_reader_that_dies_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="crashed"):
        list(read_foreign("no such reader", tmp_path))


def test_newer_versions_are_refused(tmp_path: Path) -> None:
    folder = lerobot_21(tmp_path / "new")
    info = json.loads((folder / "meta/info.json").read_text())
    (folder / "meta/info.json").write_text(json.dumps(info | {"codebase_version": "v9.0"}))
    with pytest.raises(InputError, match=r"v9\.0"):
        list(read_foreign("lerobot", folder))
