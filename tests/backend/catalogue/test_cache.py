"""The training cache: the same numbers as the files to half precision, rebuilt when they change."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from touchdown.backend.annotations import training_set
from touchdown.backend.annotations.training_set import (
    CacheRow,
    TrainingCache,
    open_cache,
    read_observation,
)
from touchdown.backend.core.faults import InputError
from touchdown.backend.core.values import Episode, EpisodeQuality
from touchdown.backend.episodes.episode_file import write_episode
from touchdown.backend.episodes.mcap import read_chunks
from touchdown.backend.episodes.packs import PackedEpisode, PackWriter


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


def test_rows_come_back_to_half_precision(tmp_path: Path, rows: list[CacheRow]) -> None:
    opened = open_cache(tmp_path, rows)
    index = np.array([3, 0, 9, 3])
    got = opened.batch(index).astype(np.float32)
    expected = np.stack([truth(numbers(opened)[i]) for i in index])
    assert got.shape == (4, 20, 258)
    assert np.abs(got - expected).max() <= 0.032
    close = np.abs(expected) < 8
    assert np.abs(got - expected)[close].max() <= 0.004
    opened.close()
    exact = open_cache(tmp_path, rows, "float32")
    assert np.array_equal(exact.batch(index), expected)
    exact.close()


def test_a_cache_is_an_ordinary_array_with_its_facts(tmp_path: Path, rows: list[CacheRow]) -> None:
    opened = open_cache(tmp_path, rows)
    opened.close()
    array = np.load(opened.path)
    assert (array.shape, array.dtype) == ((10, 20, 258), np.float16)
    facts = json.loads(opened.path.with_suffix(".json").read_text())
    assert facts["episode"] == sorted(r.episode for r in rows)
    assert facts["x_um"] == list(range(10))
    assert facts["spec"]["rate_hz"] == 10


def test_an_equal_set_is_not_built_again(
    tmp_path: Path, rows: list[CacheRow], monkeypatch: pytest.MonkeyPatch
) -> None:
    first = open_cache(tmp_path, rows)
    first.close()

    def refuse(*_: object) -> None:
        raise AssertionError("the files were read again")

    monkeypatch.setattr(training_set, "read_observation", refuse)
    again = open_cache(tmp_path, rows[::-1])
    assert again.path == first.path
    again.close()
    with pytest.raises(AssertionError):
        open_cache(tmp_path, [replace(rows[0], revision="other"), *rows[1:]])


@pytest.mark.parametrize("change", [{"sha256": "0" * 64}, {"revision": "r99"}])
def test_another_file_or_revision_is_another_cache(
    tmp_path: Path, rows: list[CacheRow], change: dict[str, str]
) -> None:
    first = open_cache(tmp_path, rows)
    other = open_cache(tmp_path, [replace(rows[0], **change), *rows[1:]])
    assert other.path != first.path
    first.close()
    other.close()


@pytest.mark.parametrize("damage", ["cut", "no json", "foreign"])
def test_half_a_cache_is_built_again(tmp_path: Path, rows: list[CacheRow], damage: str) -> None:
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


def test_nothing_half_built_stays(tmp_path: Path, rows: list[CacheRow]) -> None:
    data = bytearray((tmp_path / "packs/a.mcap").read_bytes())
    offset, length = rows[-1].chunk or (0, 0)
    data[offset + length - 30] ^= 0xFF
    (tmp_path / "packs/a.mcap").write_bytes(data)
    with pytest.raises(InputError) as error:
        open_cache(tmp_path, rows)
    assert error.value.where.endswith("packs/a.mcap")
    assert list((tmp_path / "cache").iterdir()) == []


def test_a_wrong_place_in_a_pack_is_refused(tmp_path: Path, rows: list[CacheRow]) -> None:
    for chunk in ((3, 500), (0, 5), (10**9, 100), (8, 2**40)):
        with pytest.raises(InputError):
            read_observation(tmp_path, replace(rows[-1], chunk=chunk))


def test_only_the_newest_caches_stay(tmp_path: Path, rows: list[CacheRow]) -> None:
    for count in range(6, 11):
        open_cache(tmp_path, rows[:count]).close()
    left = sorted(path.suffix for path in (tmp_path / "cache").iterdir())
    assert left == [".json"] * training_set.KEPT_CACHES + [".npy"] * training_set.KEPT_CACHES
    newest = open_cache(tmp_path, rows[:10])
    assert newest.path.exists()
    newest.close()
