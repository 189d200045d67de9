"""Agreement figures compared with published examples and independent computations."""

from __future__ import annotations

import json
import math
import struct
import tracemalloc
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from tests.backend.annotations.conftest import Record, add, context_for, small_episode, stored_label
from tests.backend.annotations.test_values import contents
from touchdown.backend.annotations import agreement
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.episode_index import CampaignEntry, list_campaigns
from touchdown.backend.annotations.geometry_records import GeometryStore, face_record, pair_records
from touchdown.backend.annotations.labels import MoveGeometry, RotateFrame, SetState, ShiftOrigin
from touchdown.backend.annotations.values import GEOMETRY_CHANGED, Label, content_hash
from touchdown.backend.core.faults import InputError, RefusedError
from touchdown.backend.core.values import FINGERS, Episode, EpisodeQuality, Recording, TactileFrame
from touchdown.backend.episodes import read_episode, read_whole, salvage_file, write_episode
from touchdown.backend.episodes.episode_mcap import SalvageResult
from touchdown.backend.episodes.mcap_container import MAGIC, Opcode, encode_record, encode_text
from touchdown.backend.geometry import Piece, circle, face_points, load_pieces, true_patch

SHROUT_FLEISS = [
    [9, 2, 5, 8],
    [6, 1, 3, 2],
    [8, 4, 6, 8],
    [7, 1, 2, 6],
    [10, 5, 6, 9],
    [6, 2, 4, 7],
]
ONE = ["yes"] * 25 + ["no"] * 25
TWO = ["yes"] * 20 + ["no"] * 5 + ["yes"] * 10 + ["no"] * 15


def test_bias_limits_and_intraclass_correlation():
    found = agreement.agreement_limits([0.1, -0.2, 0.3, 0.0, 0.3], np.zeros(5))
    figures = (found.mean, found.deviation, found.lower, found.upper)
    assert figures == pytest.approx((0.1, 0.21213, -0.3158, 0.5158), abs=5e-5)
    assert math.isnan(agreement.agreement_limits([1.0], [0.0]).lower)
    assert math.isnan(agreement.agreement_limits([], []).mean)
    # Shrout and Fleiss (1979), table 2: ICC(2,1).
    assert agreement.intraclass_correlation(SHROUT_FLEISS) == pytest.approx(0.290, abs=5e-4)
    assert agreement.intraclass_correlation([[1, 1], [2, 2], [5, 5]]) == pytest.approx(1.0)
    assert math.isnan(agreement.intraclass_correlation([[1, 2]]))


def test_kappa_and_alpha_of_one_table():
    assert agreement.cohen_kappa(ONE, TWO) == pytest.approx(0.4)
    pairs = list(zip(ONE, TWO, strict=True))
    assert agreement.krippendorff_alpha(pairs) == pytest.approx(0.4)
    assert math.isnan(agreement.cohen_kappa(["a"], ["a"]))
    assert math.isnan(agreement.krippendorff_alpha([["a"], ["b"]]))


def test_alpha_of_krippendorffs_own_example_with_gaps():
    # Krippendorff, "Computing Krippendorff's alpha-reliability" (2011), example C: 0.743.
    observers = [
        [1, 2, 3, 3, 2, 1, 4, 1, 2, None, None, None],
        [1, 2, 3, 3, 2, 2, 4, 1, 2, 5, None, 3],
        [None, 3, 3, 3, 2, 3, 4, 2, 2, 5, 1, None],
        [1, 2, 3, 3, 2, 4, 4, 1, 2, 5, 1, None],
    ]
    items = [[a for a in unit if a is not None] for unit in zip(*observers, strict=True)]
    assert agreement.krippendorff_alpha([unit for unit in items if len(unit) > 1]) == pytest.approx(
        0.743, abs=5e-4
    )


def test_distance_and_overlap():
    assert agreement.rms_mm([[0, 0], [3, 4]], np.zeros((2, 2))) == pytest.approx(math.sqrt(12.5))
    a, b = np.array([1, 1, 0, 0], bool), np.array([0, 1, 1, 0], bool)
    assert agreement.patch_iou(a, b) == pytest.approx(1 / 3)
    assert agreement.patch_iou(a & False, b & False) == 1.0


@given(st.lists(st.tuples(st.sampled_from("abc"), st.sampled_from("abc")), min_size=2, max_size=30))
def test_figures_do_not_depend_on_who_is_first_nor_on_the_order(pairs):
    one, two = (list(side) for side in zip(*pairs, strict=True))
    for figure in (
        lambda a, b: agreement.cohen_kappa(a, b),
        lambda a, b: agreement.krippendorff_alpha(list(zip(a, b, strict=True))),
    ):
        value, swapped, turned = figure(one, two), figure(two, one), figure(one[::-1], two[::-1])
        assert swapped == pytest.approx(value, nan_ok=True)
        assert turned == pytest.approx(value, nan_ok=True)
        assert math.isnan(value) or value <= 1.0 + 1e-12


@pytest.fixture
def uuids(record: Record) -> list[str]:
    return [record(1000 * k, -500).uuid for k in range(5)]


def test_a_shift_changes_what_was_previewed_and_one_undo_restores_all(dataset, uuids):
    labels = dataset.labels
    labels.accept("ann", uuids[0])
    labels.approve("bob", uuids[0])
    labels.reject("ann", uuids[1], "tilt")
    labels.delete("ann", uuids[2], "test")
    before = contents(dataset)
    wanted = labels.preview("cleo", uuids, ShiftOrigin(250, -40))
    assert [row.episode for row in wanted.rows] == [uuids[0], uuids[3], uuids[4]]
    assert dict(wanted.refused) == {
        uuids[1]: "It is rejected.",
        uuids[2]: "The episode is deleted: restore it first.",
    }
    assert contents(dataset) == before
    assert labels.bulk("cleo", wanted) == len(wanted.rows) == 3
    for row in wanted.rows:
        head = labels.head(row.episode)
        assert (head.label, head.state, head.source) == (row.after.label, "draft", "commanded")
        assert head.label.y_um == -540
    counting = labels.counting(uuids[0])
    assert counting.label.x_um == 0
    labels.undo("cleo")
    assert contents(dataset) == before


def test_a_correction_is_carried_to_the_drafts_of_the_arm_in_the_same_grip(dataset):
    labels = dataset.labels

    def probes(grip: str, count: int) -> list[str]:
        context = replace(context_for(dataset), grip_id=grip)
        return [
            add(dataset, Label(1000 * k, -500, 0, 150), context=context).uuid for k in range(count)
        ]

    first, other, own, rejected, last = probes("m/grip-1", 5)
    probes("m/grip-2", 1)
    same = replace(context_for(dataset), grip_id="m/grip-1")
    for context, accepted in ((replace(same, series="series-2"), True), (same, False)):
        add(dataset, Label(5000, 0, 0, 150), context=context, accepted=accepted)
    modelled = add(dataset, Label(5000, 0, 0, 150), f"model:{'ab' * 32}", same).uuid
    unknown = probes("m/unknown", 2)
    labels.set("ann", own, Label(77, 0, 0, 50))
    labels.reject("bob", rejected, "tilt")
    labels.accept("ann", first, Label(300, -900, 0, 240))
    before = contents(dataset)
    assert not dataset.carried("ann", replace(labels.head(first), label=Label())).rows
    wanted = dataset.carried("ann", labels.head(first))
    assert [row.episode for row in wanted.rows] == [other, last]
    assert [why for _, why in wanted.refused] == 2 * ["A person or a model labelled it."]
    assert labels.bulk("ann", wanted) == 2
    head = labels.head(other)
    # 0.24 mm of the person and 0.07 mm of the arm
    assert (head.label, head.state, head.source) == (
        Label(1300, -900, 0, 250),
        "submitted",
        "human",
    )
    assert labels.head(last).label == Label(4300, -900, 0, 250)
    assert not dataset.carried("ann", labels.head(first)).rows
    labels.undo("ann")
    assert contents(dataset) == before
    labels.accept("ann", modelled)
    assert not dataset.carried("ann", labels.head(modelled)).rows
    labels.accept("ann", unknown[0], Label(5, 5, 0, 200))
    assert not dataset.carried("ann", labels.head(unknown[0])).rows


def test_a_label_changed_since_the_preview_refuses_all(dataset, uuids):
    labels = dataset.labels
    wanted = labels.preview("cleo", uuids, ShiftOrigin(1, 1))
    labels.set("ann", uuids[3], Label(5, 5, 0, 50))
    before = contents(dataset)
    with pytest.raises(RefusedError, match=r"1 of 5 labels changed[^,]*, the first by ann"):
        labels.bulk("cleo", wanted)
    assert contents(dataset) == before
    again = labels.preview("cleo", uuids, ShiftOrigin(1, 1))
    assert labels.preview("cleo", uuids, ShiftOrigin(1, 1)) == again != wanted
    assert labels.bulk("cleo", again) == 5


def test_a_quarter_turn_of_the_frame(dataset, record):
    entry = record(3000, -1000)
    labels = dataset.labels
    labels.bulk("ann", labels.preview("ann", [entry.uuid], RotateFrame(90_000)))
    assert labels.head(entry.uuid).label == Label(1000, 3000, 90_000, 150)
    labels.bulk("ann", labels.preview("ann", [entry.uuid], RotateFrame(-90_000)))
    assert labels.head(entry.uuid).label == Label(3000, -1000, 0, 150)


def test_labels_move_to_a_corrected_geometry_and_have_to_be_reviewed_again(dataset, uuids):
    labels = dataset.labels
    old, new = context_for(dataset).geometry, context_for(dataset, "pot", "circle25").geometry
    labels.accept("ann", uuids[0])
    labels.approve("bob", uuids[0])
    labels.reject("bob", uuids[1], "tilt")
    small = int(dataset.patch(uuids[0]).touching.sum())
    wanted = labels.preview("ann", uuids, MoveGeometry(old, new))
    assert labels.bulk("ann", wanted) == 5
    assert int(dataset.patch(uuids[0]).touching.sum()) > small
    assert labels.head(uuids[0]).state == "draft"
    # Approved with the wrong dimension: it does not train until it is approved again.
    assert labels.counting(uuids[0]) is None
    assert labels.head(uuids[1]).state == "rejected"
    assert all(GEOMETRY_CHANGED in labels.marks(uuid) for uuid in uuids)
    assert labels.preview("ann", uuids, MoveGeometry(old, new)).rows == ()
    labels.undo("ann")
    assert int(dataset.patch(uuids[0]).touching.sum()) == small
    assert labels.counting(uuids[0]) is not None
    assert not any(GEOMETRY_CHANGED in labels.marks(uuid) for uuid in uuids)


def test_states_in_bulk_obey_the_same_rules(dataset, uuids):
    labels = dataset.labels
    labels.bulk("ann", labels.preview("ann", uuids, SetState("accept")))
    own = labels.preview("ann", uuids, SetState("approve"))
    assert own.rows == ()
    assert {reason for _, reason in own.refused} == {
        "ann wrote it: another person has to review it."
    }
    others = labels.preview("bob", uuids, SetState("approve"))
    with pytest.raises(RefusedError, match="ann wrote it"):
        labels.bulk("ann", others)
    assert labels.bulk("bob", others) == 5
    assert dataset.counts() == {"approved": 5}
    (done,) = labels.log(text="bulk", limit=1)
    assert len(done.body["reviews"]) == 5
    assert done.actor == "bob"
    with pytest.raises(InputError, match="reason"):
        labels.preview("bob", uuids, SetState("reject"))
    with pytest.raises(InputError, match="cannot be 'set'"):
        labels.preview("bob", uuids, SetState("set"))


def probe(dataset: Dataset, campaign: str, item: int | None, accepted: bool = True) -> str:
    context = replace(context_for(dataset), campaign=campaign, plan_item=item)
    episode = small_episode(accepted=accepted)
    return dataset.record(episode, Label(1, 1, 0, 1), source="measured", context=context).uuid


def only(dataset: Dataset) -> CampaignEntry:
    (entry,) = list_campaigns(dataset.database)
    return entry


def test_done_counts_items_once_and_neither_rejected_nor_deleted_ones(dataset):
    assert list_campaigns(dataset.database) == []
    first = probe(dataset, "c", 0)
    probe(dataset, "c", 0)
    probe(dataset, "c", 1, accepted=False)
    probe(dataset, "c", 2)
    probe(dataset, "", None)
    entry = only(dataset)
    assert (entry.uuid, entry.piece, entry.bottom) == ("c", "pot", "circle15")
    assert (entry.episodes, entry.done) == (4, 2)
    dataset.labels.delete("ann", first, "slip")
    assert only(dataset).done == 2
    for done in dataset.episodes()[2:3]:
        dataset.labels.delete("ann", done.uuid, "slip")
    assert only(dataset).done == 1
    dataset.labels.undo("ann")
    assert only(dataset).done == 2


def test_campaigns_stand_in_the_order_in_which_they_began(dataset):
    for name in ("late", "early", "late"):
        probe(dataset, name, 0)
    assert [entry.uuid for entry in list_campaigns(dataset.database)] == ["late", "early"]


PIECES = load_pieces()


def disc(name: str = "circle15") -> Piece:
    return PIECES.piece(name)


def test_the_published_record_of_a_circle():
    expected = "1e539dbc6c5b2a1e36adca9ca8496f7049f62f099342ac2d4a8439cee539303b"
    assert content_hash(face_record(circle(15.0))) == expected


def test_the_published_counts_of_points_in_contact(tmp_path):
    store = GeometryStore(tmp_path)
    pair = store.store_pair(disc(), disc())
    for x_um, y_um, touching in ((0, 0, 177), (5000, 0, 102), (8000, 0, 63), (15001, 0, 0)):
        patch = store.patch(pair, Label(x_um, y_um, 0, 0))
        assert len(patch.points_mm) == 177
        assert int(patch.touching.sum()) == touching
    assert not store.patch(pair, Label()).touching.any()


@pytest.mark.parametrize("piece", PIECES.tops)
@pytest.mark.parametrize("bottom", PIECES.bottoms)
def test_a_patch_from_records_equals_one_from_the_pieces(tmp_path, piece, bottom):
    store = GeometryStore(tmp_path)
    top, below = PIECES.top(piece), PIECES.bottom(bottom)
    pair = store.store_pair(top, below)
    points = face_points(top.face)
    rng = np.random.default_rng(5)
    for x, y, theta in rng.integers(-12000, 12000, (20, 3)).tolist():
        found = store.patch(pair, Label(x, y, theta, 0))
        offset = np.array([x, y]) / 1e3
        expected = true_patch(points, offset, below.face, np.radians(theta / 1e3))
        assert np.array_equal(found.points_mm, points)
        # Corners are kept to 1 µm: only a point that near to an edge may differ.
        assert int(np.sum(found.touching != expected)) <= 1
    assert found.centre_mm == pytest.approx(top.com_xy_mm, abs=5e-4)


def test_records_of_old_outlines_are_unchanged_and_regions_have_their_own() -> None:
    assert face_record(circle(20.0)) == {
        "kind": "face", "v": 1, "com_um": [0, 0], "shape": "circle", "d_um": 20000,
    }  # fmt: skip
    assert face_record(PIECES.bottom("square15").face)["shape"] == "polygon"
    record = face_record(PIECES.bottom("feet3").face)
    assert record["shape"] == "region"
    assert [len(part["exterior"]) for part in record["parts_um"]] == [4, 4, 4]


def test_a_corrected_dimension_is_another_pair_and_changes_nothing_old(tmp_path):
    store = GeometryStore(tmp_path)
    old = store.store_pair(disc(), disc())
    before = store.patch(old, Label(5000, 0, 0, 0)).touching.copy()
    new = store.store_pair(disc(), replace(disc(), face=circle(14.0)))
    assert new != old
    assert int(store.patch(new, Label(5000, 0, 0, 0)).touching.sum()) < before.sum()
    assert np.array_equal(GeometryStore(tmp_path).patch(old, Label(5000, 0, 0, 0)).touching, before)
    assert store.store_pair(disc(), disc()) == old
    assert len(list(tmp_path.glob("*.json"))) == 5


def test_a_changed_missing_or_foreign_record_is_named(tmp_path):
    store = GeometryStore(tmp_path)
    records = pair_records(disc(), disc("square15"))
    pair = store.store_pair(disc(), disc("square15"))
    face = next(iter(records))
    with pytest.raises(InputError, match="no pair"):
        store.pair(face)
    path = tmp_path / f"{face}.json"
    content = path.read_bytes()
    path.write_bytes(content.replace(b"15000", b"15001"))
    with pytest.raises(InputError, match="not what its name says"):
        store.pair(pair)
    path.write_bytes(b"{")
    with pytest.raises(InputError, match="damaged"):
        store.pair(pair)
    path.unlink()
    with pytest.raises(InputError, match="missing"):
        store.pair(pair)
    path.write_bytes(content)
    assert store.pair(pair).face == circle(15.0)


def test_the_patch_of_an_episode_follows_its_label(dataset, record):
    entry = record(0, 0)
    whole = dataset.patch(entry.uuid)
    dataset.labels.set("ann", entry.uuid, Label(14000, 0, 0, 100))
    moved = dataset.patch(entry.uuid)
    assert 0 < moved.touching.sum() < whole.touching.sum()
    dataset.labels.undo("ann")
    assert dataset.patch(entry.uuid) is whole


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


def test_a_cut_at_every_record_keeps_the_chunks_before_it(tmp_path, whole):
    ends = list(record_ends(whole))
    kept = []
    for end in ends:
        saved = save(tmp_path, whole[:end])
        verify(tmp_path, saved)
        kept.append(saved.chunks)
    assert kept == sorted(kept)
    assert (kept[0], kept[-1]) == (0, 2)


def test_the_low_rate_signals_survive_a_cut_through_the_images(tmp_path, whole):
    second = [m for m in range(len(whole)) if whole.startswith(b"\x06", m)]
    chunks = [at for at in second if at in {*record_ends(whole)}]
    saved = save(tmp_path, whole[: chunks[1] + 500])
    assert "inside a record" in saved.reason
    got, sent = read_episode(saved.path), an_episode()
    assert np.array_equal(got.observation, sent.observation)
    assert np.array_equal(got.recording.wrench, sent.recording.wrench)
    assert got.recording.frames == ()
    assert stored_label(saved.path) == {"episode": "e1", "x_um": 7}
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
def test_mutants_give_a_typed_error_or_the_true_data(tmp_path, whole):
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


def test_impossible_lengths_take_no_memory(tmp_path, whole):
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


def test_a_huge_file_is_refused_without_reading_it(tmp_path):
    path = tmp_path / "huge.mcap"
    with path.open("wb") as file:
        file.truncate(5_000_000_000)
    with pytest.raises(InputError, match="more than any"):
        read_whole(path)
    assert salvage_file(path, tmp_path / "saved.mcap").path is None


def test_a_foreign_file_saves_nothing(tmp_path):
    saved = save(tmp_path, b"PK\x03\x04" * 50)
    assert saved.path is None
    assert "not an MCAP" in saved.reason
    assert not (tmp_path / "saved.mcap").exists()
