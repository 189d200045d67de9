"""Compressed episodes: same numbers and images as a complete read, decoded one by one."""

import numpy as np

from tests.backend.dataset.test_episode_file import episode
from touchdown.backend.core.values import FINGERS
from touchdown.backend.episodes.episode_file import (
    read_compressed_episode,
    read_episode,
    write_episode,
)


def test_the_same_as_the_whole_episode(tmp_path, monkeypatch):
    path = tmp_path / "e.mcap"
    write_episode(path, episode(), None, {})
    whole, decoded = read_episode(path), []
    with monkeypatch.context() as patch:
        patch.setattr("touchdown.backend.episodes.episode_file.decode_image", decoded.append)
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


def test_an_episode_without_pictures(tmp_path):
    path = tmp_path / "e.mcap"
    write_episode(path, episode(with_recording=False), None, {})
    film = read_compressed_episode(path)
    assert film.bytes == 0
    assert film.episode.recording is None
