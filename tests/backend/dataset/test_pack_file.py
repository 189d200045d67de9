"""Packs: exact round trip, readable by the reference library, all damage reported."""

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Statistics

from touchdown.backend.core.faults import InputError
from touchdown.backend.episodes.packs import (
    PackedEpisode,
    PackWriter,
    read_pack,
    read_pack_metadata,
    write_packs,
)
from touchdown.backend.episodes.training_rows import load_rows, patch_bits, patch_hex


def rows(count: int, **changes: object) -> Iterator[PackedEpisode]:
    rng = np.random.default_rng(11)
    for i in range(count):
        label: dict[str, object] = {
            "episode": f"e{i}", "x_um": 1500 + i, "y_um": -250, "sigma_um": 100,
            "source": "commanded", "piece": "pot", "bottom": "circle15",
            "patch": patch_hex(rng.random(177) < 0.3), "points": 177, "geometry": "ab" * 32,
            "grip_id": f"g{i // 2}", "mounting_id": "m0", "person": "simulated", "seed": i,
        }  # fmt: skip
        yield PackedEpisode(rng.normal(size=(20, 258)).astype(np.float32), label | changes)


def write(path: Path, count: int = 3, **changes: object) -> Path:
    with PackWriter(path, {"seed": "7"}) as pack:
        for row in rows(count, **changes):
            pack.write(row)
    return path


def same(a: Mapping[str, object], b: Mapping[str, object]) -> bool:
    return dict(a) == dict(b)


def test_episodes_come_back_bit_for_bit(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", 5)
    back = list(read_pack(path))
    assert len(back) == 5
    for got, sent in zip(back, rows(5), strict=True):
        assert np.array_equal(got.observation, sent.observation)
        assert same(got.label, sent.label)
    assert read_pack_metadata(path) == {"schema_version": "1", "seed": "7"}


def test_equal_rows_give_equal_files(tmp_path: Path) -> None:
    a, b = write(tmp_path / "a.mcap"), write(tmp_path / "b.mcap")
    assert a.read_bytes() == b.read_bytes()


def test_the_reference_reader_decodes_every_message(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", 4)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary is not None
        assert isinstance(summary.statistics, Statistics)
        assert summary.statistics.message_count == 84
        found = list(reader.iter_messages(topics=["/obs"]))
        assert len(found) == 80
        later = list(reader.iter_messages(topics=["/obs"], starting_at=3_000_000_000))
        assert len(later) == 60
    stamps = [message.log_time for _, _, message in found]
    assert stamps == sorted(stamps)
    schema, channel, message = found[0]
    assert schema is not None
    assert (schema.name, schema.encoding) == ("lab_msgs/msg/Observation", "ros2msg")
    assert channel.message_encoding == "cdr"
    assert channel.metadata == {"offered_qos_profiles": ""}
    first = next(iter(rows(1)))
    assert message.data[-258 * 4 :] == first.observation[0].tobytes()


def test_one_chunk_alone_holds_its_schemas(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", 3)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        index = summary.chunk_indexes[2]
        file.seek(index.chunk_start_offset)
        chunk = file.read(index.chunk_length)
    alone = tmp_path / "alone.mcap"
    head = path.read_bytes()[: 8 + 9 + 4 + 4 + 4 + 9]
    tail = bytes.fromhex(
        "0f0400000000000000 00000000 021400000000000000" + "00" * 20 + "894d434150300d0a"
    )
    alone.write_bytes(head + chunk + tail)
    (row,) = read_pack(alone)
    assert row.label["episode"] == "e2"
    with alone.open("rb") as file:
        assert len(list(make_reader(file).iter_messages(log_time_order=False))) == 21


def test_packs_roll_over_at_500(tmp_path: Path) -> None:
    assert write_packs(tmp_path, "w", rows(501), {}) == 501
    assert [p.name for p in sorted(tmp_path.iterdir())] == ["w-0000.mcap", "w-0001.mcap"]
    assert len(load_rows(tmp_path)) == 501


def test_nothing_appears_when_writing_fails(tmp_path: Path) -> None:
    def broken() -> Iterator[PackedEpisode]:
        yield from rows(1)
        yield PackedEpisode(np.full((20, 258), np.nan, np.float32), {})

    with pytest.raises(ValueError, match="not finite"):
        write_packs(tmp_path, "w", broken(), {})
    assert list(tmp_path.iterdir()) == []


def test_every_truncation_is_refused_by_name(tmp_path: Path) -> None:
    whole = write(tmp_path / "a.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    for size in [0, 5, 60, 200, len(whole) // 2, len(whole) - 9, len(whole) - 1]:
        cut.write_bytes(whole[:size])
        with pytest.raises(InputError) as error:
            list(read_pack(cut))
        assert error.value.where == str(cut)


def test_every_changed_byte_is_noticed_or_harmless(tmp_path: Path) -> None:
    whole = write(tmp_path / "a.mcap", 2).read_bytes()
    sent = list(rows(2))
    bad = tmp_path / "bad.mcap"
    refused = 0
    positions = range(0, len(whole), 211)
    for at in positions:
        bad.write_bytes(whole[:at] + bytes([whole[at] ^ 0x5A]) + whole[at + 1 :])
        try:
            got = list(read_pack(bad))
        except InputError:
            refused += 1
            continue
        assert all(
            np.array_equal(a.observation, b.observation) and same(a.label, b.label)
            for a, b in zip(got, sent, strict=True)
        )
    assert refused > 0.9 * len(positions)


def test_a_foreign_file_is_refused_by_name(tmp_path: Path) -> None:
    foreign = tmp_path / "foreign.mcap"
    foreign.write_bytes(b"PK\x03\x04" * 100)
    with pytest.raises(InputError, match="not an MCAP file") as error:
        load_rows(tmp_path)
    assert error.value.where == str(foreign)


def test_rows_of_the_named_piece_only(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", 4)
    write(tmp_path / "b.mcap", 2, piece="barrel", geometry="cd" * 32)
    assert len(load_rows(tmp_path, "pot")) == 4
    loaded = load_rows(tmp_path, "barrel")
    assert (loaded.piece, loaded.geometry, len(loaded)) == ("barrel", "cd" * 32, 2)
    assert loaded.offset_mm[1].tolist() == [1.501, -0.25]
    assert loaded.grip_id == ("g0", "g0")
    with pytest.raises(InputError, match="barrel, pot"):
        load_rows(tmp_path)
    with pytest.raises(InputError, match="mushroom"):
        load_rows(tmp_path, "mushroom")


def test_mixed_geometries_and_bad_labels_are_refused(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", 2)
    path = write(tmp_path / "b.mcap", 2, geometry="ef" * 32)
    with pytest.raises(InputError, match="geometries"):
        load_rows(tmp_path)
    for changes in ({"patch": "00"}, {"patch": "zz"}, {"points": "177"}, {"piece": 3}):
        write(path, 2, **changes)
        with pytest.raises(InputError) as error:
            load_rows(path)
        assert error.value.where == str(path)


def test_an_empty_folder_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="simulate"):
        load_rows(tmp_path)


@pytest.mark.parametrize("points", [1, 7, 8, 177, 349, 505])
def test_patch_text_round_trip(points: int) -> None:
    patch = np.random.default_rng(points).random(points) < 0.4
    assert np.array_equal(patch_bits(patch_hex(patch), points), patch)
