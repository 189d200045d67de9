"""Damage of every kind: a typed error or verified data, never a crash or a hang."""

import json
import struct
import tracemalloc
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader

from touchdown.backend.core.faults import InputError
from touchdown.backend.core.values import FINGERS, Episode, EpisodeQuality, Recording, TactileFrame
from touchdown.backend.episodes.episode_file import (
    SalvageResult,
    read_episode,
    read_label,
    salvage_file,
    write_episode,
)
from touchdown.backend.episodes.mcap import MAGIC, Opcode, encode_record, encode_text, read_whole
from touchdown.backend.episodes.packs import PackedEpisode, PackWriter, read_pack
from touchdown.backend.episodes.training_rows import patch_hex

SEED = 20231


def an_episode() -> Episode:
    rng = np.random.default_rng(3)
    image = rng.integers(0, 255, (24, 32, 3), np.uint8)
    frames = tuple(TactileFrame(f, k, 0.04 * k, image.copy()) for k in range(3) for f in FINGERS)
    recording = Recording(
        np.arange(50) * 1e-3, rng.normal(size=(50, 6)), (), frames,
        np.arange(9) * 1e-2, rng.normal(size=(9, 3)), np.zeros(6),
    )  # fmt: skip
    quality = EpisodeQuality(True, (), 0, 0.0, 0, 1.0, 0.0)
    observation = rng.normal(size=(20, 258)).astype(np.float32)
    return Episode("e1", "pot", observation, np.array([1.5, 2.0]), 0.1, quality, recording)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("whole") / "e1.mcap"
    write_episode(path, an_episode(), {"episode": "e1", "x_um": 7}, {"mode": "stepped"})
    return path.read_bytes()


def record_ends(data: bytes) -> Iterator[int]:
    at = len(MAGIC)
    while at < len(data) - len(MAGIC):
        at += 9 + struct.unpack_from("<Q", data, at + 1)[0]
        yield at


def save(folder: Path, data: bytes) -> SalvageResult:
    torn = folder / "torn.mcap"
    torn.write_bytes(data)
    return salvage_file(torn, folder / "saved.mcap")


def verify(folder: Path, saved: SalvageResult) -> None:
    """Open the saved file in both readers, with equal counts."""
    if saved.path is None:
        assert (saved.chunks, saved.messages) == (0, {})
        return
    found = {topic: len(m) for topic, m in read_whole(saved.path).messages.items()}
    assert found == saved.messages
    with saved.path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert sum(1 for _ in reader.iter_messages()) == sum(found.values())


def test_a_cut_at_every_record_keeps_the_chunks_before_it(tmp_path: Path, whole: bytes) -> None:
    ends = list(record_ends(whole))
    kept = []
    for end in ends:
        saved = save(tmp_path, whole[:end])
        verify(tmp_path, saved)
        kept.append(saved.chunks)
    assert kept == sorted(kept)
    assert (kept[0], kept[-1]) == (0, 2)


def test_the_low_rate_signals_survive_a_cut_through_the_images(
    tmp_path: Path, whole: bytes
) -> None:
    second = [m for m in range(len(whole)) if whole.startswith(b"\x06", m)]
    chunks = [at for at in second if at in {*record_ends(whole)}]
    saved = save(tmp_path, whole[: chunks[1] + 500])
    assert saved.path is not None
    assert "inside a record" in saved.reason
    got, sent = read_episode(saved.path), an_episode()
    assert np.array_equal(got.observation, sent.observation)
    assert got.recording is not None
    assert sent.recording is not None
    assert np.array_equal(got.recording.wrench, sent.recording.wrench)
    assert got.recording.frames == ()
    assert read_label(saved.path) == {"episode": "e1", "x_um": 7}
    report = json.loads((tmp_path / "saved.mcap.json").read_text())
    assert (report["chunks"], report["from"], report["bytes"]) == (1, "torn.mcap", chunks[1] + 500)


def mutants(data: bytes, count: int) -> Iterator[bytes]:
    rng = np.random.default_rng(SEED)
    for k in range(count):
        at, many = int(rng.integers(len(data))), int(rng.integers(1, 64))
        match k % 4:
            case 0:
                yield data[:at]
            case 1:
                yield data[:at] + bytes([data[at] ^ int(rng.integers(1, 256))]) + data[at + 1 :]
            case 2:
                yield data[:at] + bytes(many) + data[at + many :]
            case _:
                yield data[:at] + rng.bytes(8) + data[at + 8 :]


@pytest.mark.promise("D5")
def test_mutants_give_a_typed_error_or_the_true_data(tmp_path: Path, whole: bytes) -> None:
    truth = {topic: [bytes(m) for m in ms] for topic, ms in _messages(tmp_path, whole).items()}
    refused = 0
    for mutant in mutants(whole, 600):
        if mutant == whole:
            continue
        torn = tmp_path / "torn.mcap"
        torn.write_bytes(mutant)
        with pytest.raises(InputError) as error:
            read_episode(torn)
        assert error.value.where == str(torn)
        refused += 1
        saved = salvage_file(torn, tmp_path / "saved.mcap")
        verify(tmp_path, saved)
        if saved.path is not None:
            for topic, messages in read_whole(saved.path).messages.items():
                assert [bytes(m) for m in messages] == truth[topic]
    assert refused > 550


def _messages(folder: Path, whole: bytes) -> dict[str, list[memoryview]]:
    path = folder / "truth.mcap"
    path.write_bytes(whole)
    return read_whole(path).messages


def test_impossible_lengths_take_no_memory(tmp_path: Path, whole: bytes) -> None:
    frame = zstandard.ZstdCompressor(level=1).compress(bytes(200_000_000))
    bombs = [
        MAGIC + struct.pack("<BQ", Opcode.CHUNK, 2**62),
        MAGIC + struct.pack("<BQ", Opcode.METADATA, 8) + struct.pack("<II", 2**31, 2**31),
        MAGIC
        + encode_record(Opcode.CHUNK, _chunk_head(1000) + struct.pack("<Q", len(frame)) + frame),
        MAGIC
        + encode_record(Opcode.CHUNK, _chunk_head(2**60) + struct.pack("<Q", len(frame)) + frame),
        MAGIC + encode_record(Opcode.CHUNK, _chunk_head(1000) + struct.pack("<Q", 2**60) + frame),
    ]
    path = tmp_path / "bomb.mcap"
    tracemalloc.start()
    for bomb in bombs:
        path.write_bytes(bomb + whole[8:][-60:])
        saved = salvage_file(path, tmp_path / "saved.mcap")
        assert saved.path is None
        with pytest.raises(InputError):
            read_whole(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 5_000_000


def _chunk_head(size: int) -> bytes:
    return struct.pack("<QQQI", 0, 1, size, zlib.crc32(b"x")) + encode_text("zstd")


def test_a_huge_file_is_refused_without_reading_it(tmp_path: Path) -> None:
    path = tmp_path / "huge.mcap"
    with path.open("wb") as file:
        file.truncate(5_000_000_000)
    with pytest.raises(InputError, match="more than any"):
        read_whole(path)
    assert salvage_file(path, tmp_path / "saved.mcap").path is None


def test_a_torn_pack_keeps_its_whole_episodes(tmp_path: Path) -> None:
    path = tmp_path / "p.mcap"
    with PackWriter(path, {"seed": "7"}) as pack:
        for k in range(5):
            label: dict[str, object] = {"episode": f"e{k}", "patch": patch_hex(np.ones(8, bool))}
            pack.write(PackedEpisode(np.full((20, 258), k, np.float32), label))
    data = path.read_bytes()
    chunk_ends = [end for end in record_ends(data) if data[end] == Opcode.MESSAGE_INDEX]
    saved = save(tmp_path, data[: chunk_ends[4]])
    assert saved.path is not None
    assert saved.chunks == 3
    assert [row.label["episode"] for row in read_pack(saved.path)] == ["e0", "e1", "e2"]


def test_a_foreign_file_saves_nothing(tmp_path: Path) -> None:
    saved = save(tmp_path, b"PK\x03\x04" * 50)
    assert saved.path is None
    assert "not an MCAP" in saved.reason
    assert not (tmp_path / "saved.mcap").exists()
