"""Looking at an episode: the same numbers and pictures as reading it whole, decoded one by one."""

import numpy as np

from backend.core.flow import FINGERS
from backend.dataset.episode_file import write_episode
from backend.dataset.episode_reading import read_episode
from backend.dataset.film_reading import read_film
from tests.backend.dataset.test_episode_file import episode


def test_the_same_as_the_whole_episode(tmp_path, monkeypatch):
    path = tmp_path / "e.mcap"
    write_episode(path, episode(), None, {})
    whole, decoded = read_episode(path), []
    monkeypatch.setattr("backend.dataset.episode_reading.decode", decoded.append)
    film = read_film(path)
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
    film = read_film(path)
    assert film.bytes == 0
    assert film.episode.recording is None
