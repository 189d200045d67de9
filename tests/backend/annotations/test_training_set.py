"""The training cache: the same numbers as the files to half precision, rebuilt when they change."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.backend.annotations.conftest import add, context_for, small_episode
from tests.backend.annotations.test_packs_in_datasets import write_pack
from touchdown.backend.annotations import Dataset, Label, training_set
from touchdown.backend.annotations.training_set import (
    CacheRow,
    LabelChoice,
    TrainingCache,
    is_dataset,
    load_training_set,
    open_cache,
    read_observation,
)
from touchdown.backend.cli.command_line import main
from touchdown.backend.core import Episode, EpisodeQuality, InputError
from touchdown.backend.episodes.episode_mcap import write_episode
from touchdown.backend.episodes.mcap_container import read_chunks
from touchdown.backend.episodes.packs import PackedEpisode, PackWriter
from touchdown.backend.episodes.training_rows import TrainingRows, load_rows, patch_hex
from touchdown.backend.geometry.pieces import load_pieces


def truth(number: int) -> np.ndarray:
    rng = np.random.default_rng(number)
    scale = np.where(np.arange(258) < 252, 3.0, 20.0)
    return (rng.normal(size=(20, 258)) * scale).astype(np.float32)


def row(number: int, path: str, chunk: tuple[int, int] | None) -> CacheRow:
    return CacheRow(f"e{number:04d}", f"{number:064x}", f"r{number}", path, chunk, number, -5, "p")


@pytest.fixture
def rows(tmp_path: Path) -> list[CacheRow]:
    """Eight episodes of a pack and two files of their own, in no order."""
    (tmp_path / "packs").mkdir()
    pack = tmp_path / "packs" / "a.mcap"
    with PackWriter(pack, {}) as writer:
        for number in range(8):
            writer.write(PackedEpisode(truth(number), {"episode": f"e{number}"}))
    quality = EpisodeQuality(True, (), 0, 0.0, 0, 0.0, 0.0)
    listed = [
        row(n, "packs/a.mcap", (chunk.offset, chunk.length))
        for n, chunk in enumerate(read_chunks(pack))
    ]
    for number in (8, 9):
        path = tmp_path / "raw" / "s" / f"e{number}.mcap"
        episode = Episode(f"e{number}", "pot", truth(number), np.zeros(2), 0.0, quality)
        write_episode(path, episode, None, {})
        listed.append(row(number, f"raw/s/e{number}.mcap", None))
    return listed[::-1]


def numbers(opened: TrainingCache) -> list[int]:
    return [int(r.revision[1:]) for r in opened.rows]


def test_a_cache_is_an_ordinary_array_of_half_precision_with_its_facts(tmp_path, rows):
    opened = open_cache(tmp_path, rows)
    index = np.array([3, 0, 9, 3])
    got = opened.batch(index).astype(np.float32)
    expected = np.stack([truth(numbers(opened)[i]) for i in index])
    assert got.shape == (4, 20, 258)
    assert np.abs(got - expected).max() <= 0.032
    close = np.abs(expected) < 8
    assert np.abs(got - expected)[close].max() <= 0.004
    opened.close()
    array = np.load(opened.path)
    assert (array.shape, array.dtype) == ((10, 20, 258), np.float16)
    facts = json.loads(opened.path.with_suffix(".json").read_text())
    assert facts["episode"] == sorted(r.episode for r in rows)
    assert facts["x_um"] == list(range(10))
    assert facts["spec"]["rate_hz"] == 10


def test_an_equal_set_is_not_built_again(tmp_path, rows, monkeypatch):
    first = open_cache(tmp_path, rows)
    first.close()

    def refuse(*_: object) -> None:
        raise AssertionError("the files were read again")

    monkeypatch.setattr(training_set, "read_observation", refuse)
    again = open_cache(tmp_path, rows[::-1])
    assert again.path == first.path
    again.close()
    for change in ({"sha256": "0" * 64}, {"revision": "r99"}):
        with pytest.raises(AssertionError):
            open_cache(tmp_path, [replace(rows[0], **change), *rows[1:]])


@pytest.mark.parametrize("damage", ["cut", "no json", "foreign"])
def test_half_a_cache_is_built_again(tmp_path, rows, damage):
    opened = open_cache(tmp_path, rows)
    opened.close()
    if damage == "cut":
        opened.path.write_bytes(opened.path.read_bytes()[:-999])
    elif damage == "no json":
        opened.path.with_suffix(".json").unlink()
    else:
        np.save(opened.path, np.zeros(3))
    again = open_cache(tmp_path, rows)
    assert np.allclose(again.batch(np.array([0])), truth(numbers(again)[0]), atol=0.032)
    again.close()


def test_nothing_half_built_stays(tmp_path, rows):
    data = bytearray((tmp_path / "packs/a.mcap").read_bytes())
    offset, length = rows[-1].chunk or (0, 0)
    data[offset + length - 30] ^= 0xFF
    (tmp_path / "packs/a.mcap").write_bytes(data)
    with pytest.raises(InputError) as error:
        open_cache(tmp_path, rows)
    assert error.value.where.endswith("packs/a.mcap")
    assert list((tmp_path / "cache").iterdir()) == []


def test_a_wrong_place_in_a_pack_is_refused(tmp_path, rows):
    for chunk in ((3, 500), (0, 5), (10**9, 100), (8, 2**40)):
        with pytest.raises(InputError):
            read_observation(tmp_path, replace(rows[-1], chunk=chunk))


def test_only_the_newest_caches_stay(tmp_path, rows):
    for count in range(6, 11):
        open_cache(tmp_path, rows[:count]).close()
    left = sorted(path.suffix for path in (tmp_path / "cache").iterdir())
    assert left == [".json"] * training_set.KEPT_CACHES + [".npy"] * training_set.KEPT_CACHES
    newest = open_cache(tmp_path, rows[:10])
    assert newest.path.exists()
    newest.close()


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


def test_the_latest_approved_label_counts_and_others_where_wanted(folder):
    assert used(folder, "approved") == {2: 0.5, 3: 0.5}
    assert used(folder, "submitted") == {1: 0.5, 2: 0.5, 3: 0.5}
    assert used(folder, "drafts") == {0: 0.0, 1: 0.5, 2: 0.5, 3: 0.5, 7: 7.0, 8: 8.0}
    # A draft by a person is never used.
    with Dataset.open(folder) as dataset:
        uuid = next(e.uuid for e in dataset.episodes() if e.state == "draft")
        dataset.labels.set("ann", uuid, Label(1, 1, 0, 1))
    assert len(used(folder, "drafts")) == 5


def test_nothing_labelled_says_what_to_do(tmp_path):
    folder = tmp_path / "data"
    with Dataset.open(folder) as dataset:
        add(dataset, Label(1, 1, 0, 1))
    with pytest.raises(InputError, match="train on labels that are submitted or drafts"):
        load_training_set(folder)
    assert is_dataset(folder)
    with pytest.raises(InputError, match="only of pot"):
        load_training_set(folder, "barrel", "drafts")


def with_pack(folder: Path, count: int) -> Path:
    Dataset.open(folder).close()
    write_pack(folder / "packs" / "a.mcap", count)
    Dataset.open(folder).close()
    return folder


def test_a_pack_in_a_dataset_trains_as_it_does_alone(tmp_path):
    folder = with_pack(tmp_path / "data", 20)
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


def test_a_turned_label_has_a_turned_patch(tmp_path):
    folder = tmp_path / "data"
    with Dataset.open(folder) as dataset:
        context = context_for(dataset, bottom="square15")
        for seed, theta in enumerate((0, 45_000)):
            add(dataset, Label(6000, 0, theta, 100), seed=seed, context=context)
        derived = [dataset.patch(entry.uuid).touching for entry in dataset.episodes()]
    rows = load_training_set(folder, "pot", "drafts")
    assert [patch_hex(p) for p in rows.patch] == [patch_hex(p) for p in derived]
    assert rows.geometry == load_pieces().piece("pot").sha256


def test_the_train_verb_takes_a_dataset(tmp_path, capfd):
    folder = with_pack(tmp_path / "data", 24)
    out = tmp_path / "pot.safetensors"
    words = ["train", str(folder), "--epochs", "1", "--out", str(out), "--json"]
    assert main(words) == 2
    assert "train on labels that are" in capfd.readouterr().err
    assert main([*words, "--labels", "drafts"]) == 2
    assert "--divide-series" in capfd.readouterr().err, "one series cannot be kept apart"
    assert main([*words, "--labels", "drafts", "--divide-series"]) == 0
    answer = json.loads(capfd.readouterr().out)
    assert (answer["episodes"], answer["piece"]) == (24, "pot")
    assert out.exists()
