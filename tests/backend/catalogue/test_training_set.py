"""Labels used for training, their patches, and signals from the cache."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.backend.catalogue.conftest import context_for, small_episode
from tests.backend.catalogue.test_packs_in_datasets import write_pack
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.training_set import LabelChoice, is_dataset, load_training_set
from touchdown.backend.annotations.values import Label
from touchdown.backend.cli.command_line import main
from touchdown.backend.core.faults import InputError
from touchdown.backend.episodes.training_rows import TrainingRows, load_rows, patch_hex
from touchdown.backend.geometry.pieces import load_pieces


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Episodes 0 to 9 of one grip each, in every state that matters; closed."""
    folder = tmp_path / "data"
    with Dataset.open(folder) as dataset:
        context = context_for(dataset)
        book = dataset.labels
        for seed in range(10):
            label = Label(1000 * seed, 0, 0, 100)
            episode = small_episode(seed=seed, accepted=seed != 9)
            dataset.record(episode, label, source="commanded", context=context)
        ids = [entry.uuid for entry in dataset.episodes()]
        for uuid in ids[1:6]:
            book.set("ann", uuid, Label(500, 0, 0, 50))
            book.accept("ann", uuid)
        for uuid in ids[2:6]:
            book.approve("bea", uuid)
        book.set("ann", ids[3], Label(700, 0, 0, 50))
        book.delete("ann", ids[4], "slip")
        book.set("ann", ids[6], Label(600, 0, 0, 50))
        book.accept("ann", ids[6])
        book.reject("bea", ids[6], "slip")
        (folder / dataset.entry(ids[5]).path).unlink()
    Dataset.open(folder).close()
    return folder


def used(folder: Path, labels: LabelChoice) -> dict[int, float]:
    """Seed of each episode used, with its x in mm."""
    rows = load_training_set(folder, "pot", labels)
    truth = {small_episode(seed=s).observation[0, 0].astype(np.float16): s for s in range(10)}
    seeds = [truth[first] for first in rows.observation[:, 0, 0]]
    return dict(zip(seeds, rows.offset_mm[:, 0].tolist(), strict=True))


def test_the_latest_approved_label_counts(folder: Path) -> None:
    assert used(folder, "approved") == {2: 0.5, 3: 0.5}


def test_submitted_labels_where_wanted(folder: Path) -> None:
    assert used(folder, "submitted") == {1: 0.5, 2: 0.5, 3: 0.5}


def test_drafts_of_a_simulated_bench_where_wanted(folder: Path) -> None:
    assert used(folder, "drafts") == {0: 0.0, 1: 0.5, 2: 0.5, 3: 0.5, 7: 7.0, 8: 8.0}


def test_a_draft_by_a_person_is_never_used(folder: Path) -> None:
    with Dataset.open(folder) as dataset:
        uuid = next(e.uuid for e in dataset.episodes() if e.state == "draft")
        dataset.labels.set("ann", uuid, Label(1, 1, 0, 1))
    assert len(used(folder, "drafts")) == 5


def test_nothing_labelled_says_what_to_do(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    with Dataset.open(folder) as dataset:
        label = Label(1, 1, 0, 1)
        dataset.record(small_episode(), label, source="commanded", context=context_for(dataset))
    with pytest.raises(InputError, match="--labels submitted or drafts"):
        load_training_set(folder)
    assert is_dataset(folder)
    with pytest.raises(InputError, match="only of pot"):
        load_training_set(folder, "barrel", "drafts")


def test_a_pack_in_a_dataset_trains_as_it_does_alone(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    Dataset.open(folder).close()
    write_pack(folder / "packs" / "a.mcap", 20)
    Dataset.open(folder).close()
    alone, rows = load_rows(folder / "packs", "pot"), load_training_set(folder, "pot", "drafts")
    assert (rows.piece, rows.geometry) == (alone.piece, alone.geometry)
    order = [by_offset(alone)[key] for key in map(tuple, rows.offset_mm.tolist())]
    assert np.array_equal(rows.patch, alone.patch[order])
    assert [rows.grip_id[i] for i in range(20)] == [alone.grip_id[i] for i in order]
    got = rows.inputs(np.arange(20))
    assert got.dtype == np.float32
    assert np.abs(got - alone.observation[order]).max() < 0.002


def by_offset(rows: TrainingRows) -> dict[tuple[float, float], int]:
    return {(float(x), float(y)): i for i, (x, y) in enumerate(rows.offset_mm)}


def test_a_turned_label_has_a_turned_patch(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    with Dataset.open(folder) as dataset:
        context = context_for(dataset, bottom="square15")
        for seed, theta in enumerate((0, 45_000)):
            label = Label(6000, 0, theta, 100)
            dataset.record(small_episode(seed=seed), label, source="commanded", context=context)
        derived = [dataset.patch(entry.uuid).touching for entry in dataset.episodes()]
    rows = load_training_set(folder, "pot", "drafts")
    assert [patch_hex(p) for p in rows.patch] == [patch_hex(p) for p in derived]
    assert rows.geometry == load_pieces().piece("pot").sha256


def test_the_train_verb_takes_a_dataset(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "data"
    Dataset.open(folder).close()
    write_pack(folder / "packs" / "a.mcap", 24)
    Dataset.open(folder).close()
    out = tmp_path / "pot.safetensors"
    words = ["train", str(folder), "--epochs", "1", "--out", str(out), "--json"]
    assert main(words) == 2
    assert "--labels" in capfd.readouterr().err
    assert main([*words, "--labels", "drafts"]) == 2
    assert "--divide-series" in capfd.readouterr().err, "one series cannot be kept apart"
    assert main([*words, "--labels", "drafts", "--divide-series"]) == 0
    answer = json.loads(capfd.readouterr().out)
    assert (answer["episodes"], answer["piece"]) == (24, "pot")
    assert out.exists()
