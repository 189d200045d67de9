"""Packs in a dataset: every chunk is an episode, found, moved and repaired by its content."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.reconciliation import check_dataset, reconcile
from touchdown.backend.annotations.values import Label
from touchdown.backend.core.faults import InputError
from touchdown.backend.episodes.episode_file import read_compressed_episode, read_episode
from touchdown.backend.episodes.packs import PackedEpisode, PackWriter
from touchdown.backend.episodes.training_rows import patch_hex
from touchdown.backend.geometry.outlines import face_points, true_patch
from touchdown.backend.geometry.pieces import load_pieces


def write_pack(path: Path, count: int = 4, seed: int = 0, geometry: str | None = None) -> Path:
    pieces = load_pieces()
    pot, bottom = pieces.top("pot"), pieces.bottom("circle15")
    points = face_points(pot.face)
    rng = np.random.default_rng(seed)
    with PackWriter(path, {"simulated": "true"}) as pack:
        for number in range(count):
            x_um, y_um = (int(v) for v in rng.integers(-8000, 8000, 2))
            label: dict[str, object] = {
                "episode": f"pot-circle15-{seed}-{number}", "x_um": x_um, "y_um": y_um,
                "sigma_um": 300, "source": "commanded", "piece": "pot", "bottom": "circle15",
                "patch": patch_hex(true_patch(points, (x_um / 1e3, y_um / 1e3), bottom.face)),
                "points": len(points), "geometry": geometry or pot.sha256,
                "grip_id": f"g{number // 2}", "mounting_id": "m0", "person": "simulation",
                "seed": seed,
            }  # fmt: skip
            pack.write(PackedEpisode(rng.normal(size=(20, 258)).astype(np.float32), label))
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "data"
    Dataset.open(folder).close()
    write_pack(folder / "packs" / "a.mcap")
    return folder


def states(folder: Path) -> list[str]:
    with Dataset.open(folder) as dataset:
        return [entry.file_state for entry in dataset.episodes()]


def calm(folder: Path) -> bool:
    with Dataset.open(folder) as dataset:
        return dataset.notices == () and not list(check_dataset(dataset.parts, whole=True))


def test_a_pack_becomes_episodes_with_commanded_drafts(folder: Path) -> None:
    with Dataset.open(folder) as dataset:
        assert "4 episodes of packs/a.mcap entered" in dataset.notices[0]
        entries = dataset.episodes()
        assert sorted(e.grip_id for e in entries) == ["g0", "g0", "g1", "g1"]
        assert {(e.piece, e.bottom, e.mode, e.state, e.keep_frames) for e in entries} == {
            ("pot", "circle15", "mass", "draft", "none")
        }
        ops = dataset.labels.log()
        assert [(op.verb, len(list(op.body["revs"]))) for op in ops] == [("adopt", 4)]  # type: ignore[call-overload]
        heads = [dataset.labels.head(e.uuid) for e in entries]
        assert {head.source for head in heads} == {"commanded"}
        rng = np.random.default_rng(0)
        sent = set()
        for _ in range(4):
            sent.add(tuple(int(v) for v in rng.integers(-8000, 8000, 2)))
            rng.normal(size=(20, 258))
        assert {(head.label.x_um, head.label.y_um) for head in heads} == sent
    assert calm(folder)


def test_the_derived_patch_is_that_of_the_pack(folder: Path) -> None:
    with Dataset.open(folder) as dataset:
        truth = {row.label["patch"] for row in read(folder / "packs" / "a.mcap")}
        derived = {patch_hex(dataset.patch(entry.uuid).touching) for entry in dataset.episodes()}
        assert derived == truth


def read(path: Path) -> list[PackedEpisode]:
    from touchdown.backend.episodes.packs import read_pack

    return list(read_pack(path))


def test_a_packed_episode_is_read_like_any_other(folder: Path) -> None:
    sent = {row.observation.tobytes(): row.label for row in read(folder / "packs" / "a.mcap")}
    with Dataset.open(folder) as dataset:
        for entry in dataset.episodes():
            episode = dataset.read(entry.uuid)
            label = sent.pop(episode.observation.tobytes())
            assert (episode.episode_id, episode.piece) == (entry.uuid, "pot")
            film = dataset.film(entry.uuid)
            assert np.array_equal(film.episode.observation, episode.observation)
            assert film.bytes == 0
            assert dataset.labels.head(entry.uuid).label.x_um == label["x_um"]
            assert np.array_equal(
                episode.offset_mm, dataset.labels.head(entry.uuid).label.offset_mm
            )
    assert sent == {}


def test_the_same_pack_elsewhere_is_the_same_episodes(folder: Path, tmp_path: Path) -> None:
    with Dataset.open(folder) as dataset:
        before = [entry.uuid for entry in dataset.episodes()]
    other = tmp_path / "other"
    Dataset.open(other).close()
    write_pack(other / "packs" / "renamed.mcap")
    with Dataset.open(other) as dataset:
        assert [entry.uuid for entry in dataset.episodes()] == before


def test_a_renamed_pack_keeps_its_labels(folder: Path) -> None:
    with Dataset.open(folder) as dataset:
        uuid = dataset.episodes()[0].uuid
        dataset.labels.set("ann", uuid, Label(1, 2, 0, 3))
    (folder / "packs" / "a.mcap").rename(folder / "packs" / "b.mcap")
    with Dataset.open(folder) as dataset:
        assert {e.path for e in dataset.episodes()} == {"packs/b.mcap"}
        assert {e.file_state for e in dataset.episodes()} == {"complete"}
        assert dataset.labels.head(uuid).label == Label(1, 2, 0, 3)
    assert calm(folder)


def test_a_second_copy_goes_to_quarantine(folder: Path) -> None:
    states(folder)
    shutil.copy(folder / "packs" / "a.mcap", folder / "packs" / "copy.mcap")
    assert states(folder) == ["complete"] * 4
    assert (folder / "quarantine" / "copy.mcap").exists()
    assert calm(folder)


def test_a_missing_pack_is_told_and_comes_back(folder: Path, tmp_path: Path) -> None:
    states(folder)
    shutil.move(folder / "packs" / "a.mcap", tmp_path / "away.mcap")
    assert states(folder) == ["missing"] * 4
    assert calm(folder)
    shutil.move(tmp_path / "away.mcap", folder / "packs" / "a.mcap")
    assert states(folder) == ["complete"] * 4
    assert calm(folder)


Tear = Callable[[bytes], bytes]


@pytest.mark.parametrize("known", [True, False])
def test_a_torn_pack_keeps_its_whole_episodes(folder: Path, known: bool) -> None:
    if known:
        states(folder)
    pack = folder / "packs" / "a.mcap"
    whole = pack.read_bytes()
    pack.write_bytes(whole[: len(whole) // 2])
    with Dataset.open(folder) as dataset:
        assert any("whole episodes were saved" in notice for notice in dataset.notices)
        found = sorted(entry.file_state for entry in dataset.episodes())
        assert found == (["complete"] * 2 + ["damaged"] * 2 * known)
        kept = next(e for e in dataset.episodes() if e.file_state == "complete")
        assert kept.path == "packs/a.mcap"
    assert (folder / "quarantine" / "a.mcap").read_bytes() == whole[: len(whole) // 2]
    assert calm(folder)


def test_a_changed_byte_costs_one_pack_check_and_keeps_the_rest(folder: Path) -> None:
    states(folder)
    pack = folder / "packs" / "a.mcap"
    data = bytearray(pack.read_bytes())
    data[len(data) // 2] ^= 1
    pack.write_bytes(data)
    with Dataset.open(folder) as dataset:
        assert dataset.notices == ()
        assert [f.kind for f in reconcile(dataset.parts, whole=True)] == ["torn"]
        kinds = [entry.file_state for entry in dataset.episodes()]
        assert sorted(set(kinds)) == ["complete", "damaged"]
    assert calm(folder)


def test_a_pack_of_another_geometry_is_told_once(folder: Path) -> None:
    write_pack(folder / "packs" / "b.mcap", seed=3, geometry="ab" * 32)
    with Dataset.open(folder) as dataset:
        assert any("was changed since" in notice for notice in dataset.notices)
        assert len(dataset.episodes()) == 4
    with Dataset.open(folder) as dataset:
        assert dataset.notices == ()


def test_other_files_among_the_packs_are_left(folder: Path) -> None:
    from tests.backend.catalogue.conftest import small_episode
    from touchdown.backend.episodes.episode_file import write_episode

    write_episode(folder / "packs" / "single.mcap", small_episode(), None, {})
    with Dataset.open(folder) as dataset:
        assert any("single.mcap is no pack" in notice for notice in dataset.notices)
    assert (folder / "packs" / "single.mcap").exists()
    assert states(folder) == ["complete"] * 4


def test_a_pack_read_as_one_episode_says_that_no_pictures_were_kept(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_pack(path, 3)
    for read in (read_compressed_episode, read_episode):
        with pytest.raises(InputError, match="no pictures were kept"):
            read(path)


def test_a_packed_episode_has_an_empty_film(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    Dataset.open(folder).close()
    write_pack(folder / "packs" / "a.mcap", 3)
    with Dataset.open(folder) as dataset:
        film = dataset.film(dataset.episodes()[0].uuid)
    assert film.bytes == 0
    assert all(len(pictures.packed) == 0 for pictures in film.pictures.values())
