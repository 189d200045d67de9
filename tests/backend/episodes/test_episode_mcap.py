"""Byte vectors of data-and-labelling 2.4, made there with an independent serialiser."""

import json
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Statistics
from scipy.spatial.transform import Rotation

from tests.backend.annotations.conftest import stored_label
from touchdown.backend.config import SimulationSettings
from touchdown.backend.config.bench_description import describe_simulation
from touchdown.backend.core.faults import InputError
from touchdown.backend.core.files import program_stamp
from touchdown.backend.core.values import (
    FINGERS,
    MARKERS,
    BeliefMap,
    Episode,
    EpisodeQuality,
    MarkerField,
    Recording,
    ScenePicture,
    TactileFrame,
)
from touchdown.backend.episodes import episode_mcap, messages
from touchdown.backend.episodes.episode_mcap import (
    FACTS_KEY,
    HOMOGRAPHY_KEY,
    PADS_KEY,
    read_compressed_episode,
    read_episode,
    to_s,
    write_episode,
)
from touchdown.backend.episodes.mcap_container import read_whole
from touchdown.backend.episodes.messages import CdrReader
from touchdown.backend.episodes.packs import PackedEpisode, PackWriter, read_pack, write_packs
from touchdown.backend.episodes.training_rows import join_rows, load_rows, patch_bits, patch_hex
from touchdown.backend.sensing import Homography
from touchdown.backend.simulation.scene_camera import camera_matrix

STAMP = np.array([1_700_000_000_123_456_789])
HEAD = "00 01 00 00 00 f1 53 65 15 cd 5b 07"


def doubles(*values: float) -> bytes:
    return struct.pack(f"<{len(values)}d", *values)


def test_wrench_has_the_published_bytes():
    wrench = np.array([[1, -2, 22.5, 0.01, -0.02, 0.003]])
    expected = bytes.fromhex(
        HEAD + "03 00 00 00 66 74 00 00"
        "000000000000f03f 00000000000000c0 0000000000803640"
        "7b14ae47e17a843f 7b14ae47e17a94bf fa7e6abc7493683f"
    )
    packed = messages.pack_wrench(STAMP, wrench)
    assert packed.tobytes() == expected
    assert len(expected) == 68
    assert np.array_equal(messages.unpack_wrench([packed[0].tobytes()]), wrench)
    assert messages.stamps_ns([packed[0].tobytes()]).tolist() == STAMP.tolist()


def test_pose_has_the_published_bytes():
    packed = messages.pack_pose(STAMP, np.array([[100.0, 200.0, 300.0]]))
    expected = bytes.fromhex(HEAD + "05 00 00 00 62 61 73 65 00 00 00 00 00 00 00 00")
    assert packed.tobytes() == expected + doubles(0.1, 0.2, 0.3, 0, 0, 0, 1)
    assert packed.size == 84
    assert np.allclose(messages.unpack_pose_mm([packed[0].tobytes()]), [[100, 200, 300]])


def test_image_has_the_published_bytes():
    packed = messages.pack_image(int(STAMP[0]), "tac_left", "jpeg", b"\xff\xd8\xff\xd9")
    assert packed == bytes.fromhex(
        HEAD + "09 00 00 00 74 61 63 5f 6c 65 66 74 00 00 00 00"
        "05 00 00 00 6a 70 65 67 00 00 00 00 04 00 00 00 ff d8 ff d9"
    )
    assert messages.unpack_image(packed) == ("jpeg", b"\xff\xd8\xff\xd9")


def test_text_has_the_published_bytes():
    packed = messages.pack_json({"x_mm": 1.5})
    assert packed == bytes.fromhex("00 01 00 00 0d 00 00 00 7b 22 78 5f 6d 6d 22 3a 31 2e 35 7d 00")
    assert messages.unpack_json(packed) == {"x_mm": 1.5}


def test_transforms_and_maps_have_the_bytes_of_rosbags():
    placed = [
        messages.Transform("base", "hand", (100.0, 200.0, 300.0)),
        messages.Transform("hand", "ft", (0.0, 0.0, 120.0), (0.0, 0.0, 0.6, 0.8)),
    ]
    assert messages.pack_transforms(int(STAMP[0]), placed).hex() == (
        "000100000200000000f1536515cd5b070500000062617365000000000500000068616e6400000000"
        "000000009a9999999999b93f9a9999999999c93f333333333333d33f000000000000000000000000"
        "000000000000000000000000000000000000f03f00f1536515cd5b070500000068616e6400000000"
        "03000000667400000000000000000000000000000000000000000000b81e85eb51b8be3f00000000"
        "000000000000000000000000333333333333e33f9a9999999999e93f"
    )
    belief = BeliefMap(np.log([[3.0, 1.0]]), np.array([[True, False]]), (1.0, 2.0), 2.0, 1)
    assert messages.pack_belief(int(STAMP[0]), belief).hex() == (
        "0001000000f1536515cd5b0705000000626173650000000000000000000000006f12033b02000000"
        "010000000000000000000000fca9f1d24d62503f0000000000000000000000000000000000000000"
        "000000000000000000000000000000000000f03f020000004bff"
    )


def test_observation_fields_lie_where_cdr_puts_them():
    values = np.arange(6, dtype=np.float32).reshape(2, 3)
    packed = messages.pack_observation(np.array([0, 100_000_000]), values)
    second = packed[1].tobytes()
    # header 8 + "obs\0" with its length 8 = 16, step, count, floats
    assert struct.unpack_from("<II3f", second, 4 + 16) == (1, 3, 3.0, 4.0, 5.0)
    assert np.array_equal(messages.unpack_observation([m.tobytes() for m in packed]), values)


def test_observation_out_of_order_is_refused():
    packed = messages.pack_observation(np.array([0, 1]), np.zeros((2, 3), np.float32))
    with pytest.raises(ValueError, match="order"):
        messages.unpack_observation([packed[1].tobytes(), packed[0].tobytes()])


def test_markers_come_back_bit_for_bit_and_are_stored_axis_first():
    rng = np.random.default_rng(3)
    rows = messages.MarkerRows(
        rng.normal(size=(4, MARKERS, 2)),
        rng.normal(size=(4, MARKERS, 2)),
        rng.integers(0, 3, (4, MARKERS)).astype(np.uint8),
        rng.random(4),
        rng.random(4),
    )
    packed = messages.pack_markers(np.arange(4) * 40_000_000, rows, "tac_left")
    back = messages.unpack_markers([m.tobytes() for m in packed])
    assert np.array_equal(back.position_px, rows.position_px)
    assert np.array_equal(back.displacement_px, rows.displacement_px)
    assert np.array_equal(back.state, rows.state)
    assert np.array_equal(back.quality, rows.quality)
    assert np.array_equal(back.residual_px, rows.residual_px)
    reader = CdrReader(packed[2].tobytes())
    assert reader.header() == (80_000_000, "tac_left")
    assert (reader.integer("H"), reader.integer("H")) == (7, 9)
    first = reader.sequence("<f8")
    assert np.array_equal(first[:MARKERS], rows.displacement_px[2, :, 0])


@pytest.mark.parametrize("cut", [0, 3, 7, 15, 30])
def test_a_message_cut_short_is_refused(cut):
    packed = messages.pack_image(0, "tac_left", "jpeg", b"12345678")
    with pytest.raises(ValueError, match=r"CDR|shorter"):
        messages.unpack_image(packed[:cut])


FRAMES = 6


def smooth_image(rng: np.random.Generator) -> np.ndarray:
    v, u = np.mgrid[0:240, 0:320]
    phase = rng.uniform(0, 6, 3)
    waves = [128 + 90 * np.sin(u / 30 + v / 40 + p) for p in phase]
    return np.stack(waves, -1).astype(np.uint8)


def recording() -> Recording:
    rng = np.random.default_rng(2)
    times = [(finger, k, (40_000 * k + 7_000 * (finger == "right")) * 1e-6)
             for k in range(FRAMES) for finger in FINGERS]  # fmt: skip
    fields = tuple(
        MarkerField(
            finger, k + 3, t_s, rng.normal(size=(MARKERS, 2)), rng.normal(size=(MARKERS, 2)),
            rng.integers(0, 3, MARKERS).astype(np.uint8), float(rng.random()), float(rng.random()),
        )
        for finger, k, t_s in times
    )  # fmt: skip
    frames = tuple(TactileFrame(f, k + 3, t, smooth_image(rng)) for f, k, t in times)
    wrench_us = np.arange(250) * 1000 + 13
    return Recording(
        wrench_us * 1e-6, rng.normal(size=(250, 6)), fields, frames,
        np.arange(30) * 10_000 * 1e-6, rng.normal(size=(30, 3)) * 100, rng.normal(size=6), (),
        np.arange(25) * 10_000 * 1e-6, rng.normal(size=(25, 3)) * 100,
    )  # fmt: skip


def episode(with_recording: bool = True) -> Episode:
    rng = np.random.default_rng(4)
    quality = EpisodeQuality(False, ("slip", "dropped"), 2, 0.125, 3, 19.5, 0.0625)
    return Episode(
        "0190-abc", "pot", rng.normal(size=(20, 258)).astype(np.float32), rng.normal(size=2),
        0.1234567, quality, recording() if with_recording else None, (("seed", "7"),),
    )  # fmt: skip


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "e.mcap"


def test_every_native_sample_comes_back_bit_for_bit(path):
    sent = episode()
    write_episode(path, sent, {"x_um": 12}, {"mode": "stepped"})
    got = read_episode(path)
    assert (got.episode_id, got.piece, got.onset_s) == (sent.episode_id, "pot", sent.onset_s)
    assert got.quality == sent.quality
    assert got.metadata == sent.metadata
    assert np.array_equal(got.offset_mm, sent.offset_mm)
    assert np.array_equal(got.observation, sent.observation)
    a, b = got.recording, sent.recording
    for name in ("wrench_t_s", "wrench", "pose_t_s", "tare", "command_t_s"):
        assert np.array_equal(getattr(a, name), getattr(b, name)), name
    assert np.allclose(a.pose_mm, b.pose_mm, rtol=1e-15)
    assert np.allclose(a.command_mm, b.command_mm, rtol=1e-15)
    for f, g in zip(a.fields, b.fields, strict=True):
        assert (f.finger, f.sequence, f.t_s) == (g.finger, g.sequence, g.t_s)
        assert (f.quality, f.residual_px) == (g.quality, g.residual_px)
        assert np.array_equal(f.position_px, g.position_px)
        assert np.array_equal(f.displacement_px, g.displacement_px)
        assert np.array_equal(f.state, g.state)
    assert stored_label(path) == {"x_um": 12}


def test_a_file_without_commanded_poses_is_read_as_before(path):
    sent = episode()
    silent = replace(sent.recording, command_t_s=np.zeros(0), command_mm=np.zeros((0, 3)))
    write_episode(path, replace(sent, recording=silent), None, {})
    got = read_episode(path).recording
    assert (got.command_t_s.shape, got.command_mm.shape) == ((0,), (0, 3))
    assert np.array_equal(got.pose_t_s, silent.pose_t_s)


def test_viewers_place_markers_wrench_and_scene(path):
    board = Homography(camera_matrix()[:, [0, 1, 3]] / camera_matrix()[2, 3], 0.0)
    picture = ScenePicture(0.1, np.zeros((480, 640, 3), np.uint8))
    pairs = ((PADS_KEY, "30"), (HOMOGRAPHY_KEY, board.text()))
    sent = replace(episode(), recording=replace(recording(), scene=(picture,)), metadata=pairs)
    settings = SimulationSettings.model_validate({"wrist": {"yaw_rad": 0.5}})
    facts = describe_simulation(settings).model_dump_json()
    write_episode(path, sent, None, {FACTS_KEY: facts})
    assert read_episode(path).metadata == sent.metadata
    found = read_whole(path).messages
    placed = dict(transforms(found["/tf_static"][0]))
    ((child, (parent, hand_m, turn)),) = transforms(found["/tf"][3])
    assert (child, parent, turn.magnitude()) == ("hand", "base", 0.0)
    assert np.allclose(hand_m, sent.recording.pose_mm[3] / 1e3)
    assert len(found["/tf"]) == len(sent.recording.pose_t_s)
    parent, at_m, turn = placed["ft"]
    assert (parent, at_m.tolist()) == ("hand", [0.0, 0.0, settings.wrist.height_mm / 1e3])
    assert turn.as_rotvec() == pytest.approx([0.0, 0.0, 0.5])
    for finger, side in (("left", 1.0), ("right", -1.0)):
        field = next(f for f in sent.recording.fields if f.finger == finger)
        data = bytes(found[f"/tac/{finger}/points"][0])[-1 - 16 * MARKERS : -1]
        cloud = np.frombuffer(data, "<f4").reshape(MARKERS, 4).astype(float)
        parent, at_m, turn = placed[f"tac_{finger}"]
        px = field.position_px - (160.0, 120.0)
        x, z = 0.058e-3 * side * px[:, 0], -0.058e-3 * px[:, 1]
        expected = np.column_stack([x, np.full(MARKERS, 0.015 * side), z])
        assert np.allclose(at_m + turn.apply(cloud[:, :3]), expected, atol=1e-8)
        assert np.allclose(cloud[:, 3], np.linalg.norm(field.displacement_px, axis=1), atol=1e-5)
        seen = cloud[:, :3] @ intrinsics(found[f"/tac/{finger}/camera_info"][0]).T
        assert np.allclose(seen[:, :2] / seen[:, 2:], field.position_px, atol=1e-3)
    parent, eye_m, turn = placed["scene"]
    assert parent == "base"
    corners_mm = np.array([[0.0, 0.0], [20.0, -5.0], [-7.0, 12.0]])
    ahead = turn.inv().apply(np.insert(corners_mm / 1e3, 2, 0.0, axis=1) - eye_m)
    seen = ahead @ intrinsics(found["/scene/camera_info"][0]).T
    assert np.allclose(seen[:, :2] / seen[:, 2:], board.to_px(corners_mm), atol=1e-6)


def transforms(message):
    """Yield child and (parent, position in m, rotation) of each transform."""
    reader = CdrReader(message)
    for _ in range(reader.integer("I")):
        (_, parent), child = reader.header(), reader.text()
        numbers = [reader.number("d") for _ in range(7)]
        yield child, (parent, np.array(numbers[:3]), Rotation.from_quat(numbers[3:]))


def intrinsics(message):
    """Return the matrix K of a ``CameraInfo``."""
    reader = CdrReader(message)
    reader.header()
    reader.integer("I"), reader.integer("I"), reader.text(), reader.sequence("<f8")
    return np.array([reader.number("d") for _ in range(9)]).reshape(3, 3)


def test_pictures_are_close_as_jpeg_and_exact_as_png(path):
    sent = episode()
    worst = {}
    for keep in ("jpeg95_444", "png"):
        write_episode(path, sent, None, {}, keep)
        got = read_episode(path).recording
        worst[keep] = max(
            np.abs(a.image.astype(int) - b.image).mean()
            for a, b in zip(got.frames, sent.recording.frames, strict=True)
        )
        pairs = zip(got.frames, sent.recording.frames, strict=True)
        assert all((a.finger, a.sequence, a.t_s) == (b.finger, b.sequence, b.t_s) for a, b in pairs)
    assert worst["png"] == 0
    assert worst["jpeg95_444"] < 1.0
    write_episode(path, sent, None, {}, "none")
    got = read_episode(path).recording
    assert got.frames == ()
    assert stored_label(path) is None


def test_stored_jpegs_keep_full_colour_resolution(path):
    write_episode(path, episode(), None, {})
    with path.open("rb") as file:
        _, _, message = next(make_reader(file).iter_messages(topics=["/tac/left/image"]))
    data = message.data[message.data.index(b"\xff\xd8") :]
    frame_header = data.index(b"\xff\xc0")
    sampling = [data[frame_header + 11 + 3 * k] for k in range(3)]
    assert sampling == [0x11, 0x11, 0x11]


def test_the_reference_reader_sees_streams_in_order_of_time(path):
    write_episode(path, episode(), {"x_um": 1}, {"mode": "stepped", "person": "ann"})
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        names = {c.topic: c.id for c in summary.channels.values()}
        counts = summary.statistics.channel_message_counts
        expected = {
            "/obs": 20, "/ft/tared": 250, "/robot/pose": 30, "/robot/command": 25,
            "/tac/left/markers": FRAMES, "/tac/right/markers": FRAMES,
            "/tac/left/image": FRAMES, "/tac/right/image": FRAMES,
            "/episode/event": 1, "/episode/label": 1,
        }  # fmt: skip
        assert {topic: counts[number] for topic, number in names.items()} == expected
        stamps = [m.log_time for _, _, m in reader.iter_messages()]
        assert len(stamps) == sum(expected.values())
        assert stamps == sorted(stamps)
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
    assert metadata["bench"] == {"mode": "stepped", "person": "ann"}
    assert metadata["episode"]["uuid"] == "0190-abc"
    assert metadata["software"] == {"schema_version": "1", "program": program_stamp()}
    assert json.loads(metadata["episode"]["quality"])["slip_mm"] == 0.0625


def test_a_truncated_or_foreign_episode_is_refused_by_name(path, tmp_path):
    write_episode(path, episode(), None, {})
    whole = path.read_bytes()
    for size in (0, 80, len(whole) // 3, len(whole) - 3):
        path.write_bytes(whole[:size])
        with pytest.raises(InputError) as error:
            read_episode(path)
        assert error.value.where == str(path)
    path.write_bytes(whole)
    with pytest.raises(InputError, match="lacks its observation or its label"):
        load_rows(tmp_path)
    with pytest.raises(InputError, match="No such file"):
        read_episode(tmp_path / "none.mcap")


def test_a_failed_write_leaves_the_old_file_and_no_other(path, monkeypatch):
    write_episode(path, episode(with_recording=False), None, {})
    before = path.read_bytes()

    def full(*_: object) -> bytes:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(episode_mcap, "encode_image", full)
    with pytest.raises(OSError, match="No space"):
        write_episode(path, episode(), None, {})
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_whole_microseconds_survive_and_others_to_the_nanosecond():
    us = np.array([0, 1, 3, 7, 100_003, 2_000_001, 86_400_000_007])
    assert np.array_equal(to_s(episode_mcap.to_ns(us * 1e-6)), us * 1e-6)
    odd = np.array([0.1234567891, 12.000000001])
    assert np.allclose(to_s(episode_mcap.to_ns(odd)), odd, rtol=0, atol=5e-10)


def test_the_same_as_the_whole_episode(path, monkeypatch):
    write_episode(path, episode(), None, {})
    whole, decoded = read_episode(path), []
    with monkeypatch.context() as patch:
        patch.setattr("touchdown.backend.episodes.episode_mcap.decode_image", decoded.append)
        film = read_compressed_episode(path)
    assert decoded == []
    assert np.array_equal(film.episode.observation, whole.observation)
    assert film.episode.recording.frames == ()
    assert np.array_equal(film.episode.recording.wrench, whole.recording.wrench)
    for finger in FINGERS:
        frames = [f for f in whole.recording.frames if f.finger == finger]
        assert film.pictures[finger].t_s.tolist() == [f.t_s for f in frames]
        for index, frame in enumerate(frames):
            assert np.array_equal(film.pictures[finger].picture(index), frame.image)


def test_an_episode_without_recording(path):
    sent = episode(with_recording=False)
    write_episode(path, sent, None, {})
    film = read_compressed_episode(path)
    assert film.bytes == 0
    for got in (read_episode(path), film.episode):
        assert got.recording is None
        assert np.array_equal(got.observation, sent.observation)


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


def test_episodes_come_back_bit_for_bit(tmp_path):
    path = write(tmp_path / "a.mcap", 5)
    back = list(read_pack(path))
    assert len(back) == 5
    for got, sent in zip(back, rows(5), strict=True):
        assert np.array_equal(got.observation, sent.observation)
        assert dict(got.label) == dict(sent.label)
    assert read_whole(path).metadata["pack"] == {"schema_version": "1", "seed": "7"}
    assert write(tmp_path / "b.mcap", 5).read_bytes() == path.read_bytes()


def test_the_reference_reader_decodes_every_message(tmp_path):
    path = write(tmp_path / "a.mcap", 4)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert isinstance(summary.statistics, Statistics)
        assert summary.statistics.message_count == 84
        found = list(reader.iter_messages(topics=["/obs"]))
        assert len(found) == 80
        later = list(reader.iter_messages(topics=["/obs"], starting_at=3_000_000_000))
        assert len(later) == 60
    stamps = [message.log_time for _, _, message in found]
    assert stamps == sorted(stamps)
    schema, channel, message = found[0]
    assert (schema.name, schema.encoding) == ("lab_msgs/msg/Observation", "ros2msg")
    assert channel.message_encoding == "cdr"
    assert channel.metadata == {"offered_qos_profiles": ""}
    first = next(iter(rows(1)))
    assert message.data[-258 * 4 :] == first.observation[0].tobytes()


def test_one_chunk_alone_holds_its_schemas(tmp_path):
    path = write(tmp_path / "a.mcap", 3)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
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


def test_packs_roll_over_at_500(tmp_path):
    assert write_packs(tmp_path, "w", rows(501), {}) == 501
    assert [p.name for p in sorted(tmp_path.iterdir())] == ["w-0000.mcap", "w-0001.mcap"]
    assert len(load_rows(tmp_path)) == 501


def test_nothing_appears_when_writing_fails(tmp_path):
    def broken() -> Iterator[PackedEpisode]:
        yield from rows(1)
        yield PackedEpisode(np.full((20, 258), np.nan, np.float32), {})

    with pytest.raises(ValueError, match="not finite"):
        write_packs(tmp_path, "w", broken(), {})
    assert list(tmp_path.iterdir()) == []


def test_a_foreign_file_is_refused_by_name_and_an_empty_folder_says_what_to_do(tmp_path):
    with pytest.raises(InputError, match="simulate"):
        load_rows(tmp_path)
    foreign = tmp_path / "foreign.mcap"
    foreign.write_bytes(b"PK\x03\x04" * 100)
    with pytest.raises(InputError, match="not an MCAP file") as error:
        load_rows(tmp_path)
    assert error.value.where == str(foreign)


def test_rows_of_the_named_piece_only(tmp_path):
    write(tmp_path / "a.mcap", 4)
    write(tmp_path / "b.mcap", 2, piece="barrel", geometry="cd" * 32)
    assert len(load_rows(tmp_path, "pot")) == 4
    loaded = load_rows(tmp_path, "barrel")
    assert (loaded.piece, loaded.geometry, len(loaded)) == ("barrel", "cd" * 32, 2)
    assert loaded.offset_mm[1].tolist() == [1.501, -0.25]
    assert loaded.grip_id == ("g0", "g0")
    pot = load_rows(tmp_path, "pot")
    taken, joined = pot.take(np.array([3, 0])), join_rows([pot, pot])
    assert (taken.grip_id, [row["episode"] for row in taken.labels]) == (("g1", "g0"), ["e3", "e0"])
    assert np.array_equal(taken.observation, pot.observation[[3, 0]])
    assert (joined.grip_id, joined.labels) == (2 * pot.grip_id, 2 * pot.labels)
    assert np.array_equal(joined.patch, np.concatenate([pot.patch, pot.patch]))
    with pytest.raises(InputError, match="barrel, pot"):
        load_rows(tmp_path)
    with pytest.raises(InputError, match="mushroom"):
        load_rows(tmp_path, "mushroom")


def test_mixed_geometries_and_bad_labels_are_refused(tmp_path):
    write(tmp_path / "a.mcap", 2)
    path = write(tmp_path / "b.mcap", 2, geometry="ef" * 32)
    with pytest.raises(InputError, match="geometries"):
        load_rows(tmp_path)
    for changes in ({"patch": "00"}, {"patch": "zz"}, {"points": "177"}, {"piece": 3}):
        write(path, 2, **changes)
        with pytest.raises(InputError) as error:
            load_rows(path)
        assert error.value.where == str(path)


@pytest.mark.parametrize("points", [1, 7, 8, 177, 349, 505])
def test_patch_text_round_trip(points):
    patch = np.random.default_rng(points).random(points) < 0.4
    assert np.array_equal(patch_bits(patch_hex(patch), points), patch)
