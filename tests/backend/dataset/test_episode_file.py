"""Episode files: signals are lossless, images nearly so, and files are complete or absent."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from touchdown.backend.core.faults import InputError
from touchdown.backend.core.files import program_stamp
from touchdown.backend.core.values import (
    FINGERS,
    MARKERS,
    Episode,
    EpisodeQuality,
    MarkerField,
    Recording,
    TactileFrame,
)
from touchdown.backend.episodes import episode_file
from touchdown.backend.episodes.episode_file import read_episode, read_label, to_s, write_episode
from touchdown.backend.episodes.training_rows import load_rows

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


def test_every_native_sample_comes_back_bit_for_bit(path: Path) -> None:
    sent = episode()
    write_episode(path, sent, {"x_um": 12}, {"mode": "stepped"})
    got = read_episode(path)
    assert (got.episode_id, got.piece, got.onset_s) == (sent.episode_id, "pot", sent.onset_s)
    assert got.quality == sent.quality
    assert got.metadata == sent.metadata
    assert np.array_equal(got.offset_mm, sent.offset_mm)
    assert np.array_equal(got.observation, sent.observation)
    a, b = got.recording, sent.recording
    assert a is not None
    assert b is not None
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
    assert read_label(path) == {"x_um": 12}


def test_a_file_without_commanded_poses_is_read_as_before(path: Path) -> None:
    sent = episode()
    assert sent.recording is not None
    silent = replace(sent.recording, command_t_s=np.zeros(0), command_mm=np.zeros((0, 3)))
    write_episode(path, replace(sent, recording=silent), None, {})
    got = read_episode(path).recording
    assert got is not None
    assert (got.command_t_s.shape, got.command_mm.shape) == ((0,), (0, 3))
    assert np.array_equal(got.pose_t_s, silent.pose_t_s)


def test_pictures_are_close_as_jpeg_and_exact_as_png(path: Path) -> None:
    sent = episode()
    assert sent.recording is not None
    worst = {}
    for keep in ("jpeg95_444", "png"):
        write_episode(path, sent, None, {}, keep)  # type: ignore[arg-type]
        got = read_episode(path).recording
        assert got is not None
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
    assert got is not None
    assert got.frames == ()
    assert read_label(path) is None


def test_stored_jpegs_keep_full_colour_resolution(path: Path) -> None:
    write_episode(path, episode(), None, {})
    with path.open("rb") as file:
        _, _, message = next(make_reader(file).iter_messages(topics=["/tac/left/image"]))
    data = message.data[message.data.index(b"\xff\xd8") :]
    frame_header = data.index(b"\xff\xc0")
    sampling = [data[frame_header + 11 + 3 * k] for k in range(3)]
    assert sampling == [0x11, 0x11, 0x11]


def test_an_episode_without_recording(path: Path) -> None:
    sent = episode(with_recording=False)
    write_episode(path, sent, None, {})
    got = read_episode(path)
    assert got.recording is None
    assert np.array_equal(got.observation, sent.observation)


def test_the_reference_reader_sees_streams_in_order_of_time(path: Path) -> None:
    write_episode(path, episode(), {"x_um": 1}, {"mode": "stepped", "person": "ann"})
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
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


def test_a_truncated_or_foreign_episode_is_refused_by_name(path: Path, tmp_path: Path) -> None:
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


def test_a_failed_write_leaves_the_old_file_and_no_other(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_episode(path, episode(with_recording=False), None, {})
    before = path.read_bytes()

    def full(*_: object) -> bytes:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(episode_file, "encode_image", full)
    with pytest.raises(OSError, match="No space"):
        write_episode(path, episode(), None, {})
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_whole_microseconds_survive_and_others_to_the_nanosecond() -> None:
    us = np.array([0, 1, 3, 7, 100_003, 2_000_001, 86_400_000_007])
    assert np.array_equal(to_s(episode_file.to_ns(us * 1e-6)), us * 1e-6)
    odd = np.array([0.1234567891, 12.000000001])
    assert np.allclose(to_s(episode_file.to_ns(odd)), odd, rtol=0, atol=5e-10)
