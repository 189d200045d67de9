"""Read an episode for looking at it: all numbers at once, pictures only when they are shown."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from backend.core.flow import FINGERS, Episode, Finger, FloatArray, ImageArray
from backend.dataset.channels import IMAGE
from backend.dataset.contents import explained, read_whole
from backend.dataset.episode_reading import episode_of, to_s
from backend.dataset.pictures import decode
from backend.dataset.unpacking import stamps_ns, unpack_image


@dataclass(frozen=True, slots=True)
class Pictures:
    """The compressed pictures of one finger, in order of time; ``t_s`` (n,) bench clock."""

    t_s: FloatArray
    packed: tuple[bytes, ...]

    def picture(self, index: int) -> ImageArray:
        """Decode picture ``index`` to (h, w, 3) BGR; raises ``ValueError`` if it is damaged."""
        return decode(self.packed[index])


@dataclass(frozen=True, slots=True)
class FilmedEpisode:
    """``episode`` without frames, and the pictures of each finger, still compressed."""

    episode: Episode
    pictures: Mapping[Finger, Pictures]

    @property
    def bytes(self) -> int:
        """Size of the pictures in memory."""
        return sum(len(data) for film in self.pictures.values() for data in film.packed)


def without_pictures(episode: Episode) -> FilmedEpisode:
    """Return an episode of which no pictures were recorded."""
    none = Pictures(np.zeros(0), ())
    return FilmedEpisode(episode, dict.fromkeys(FINGERS, none))


def read_film(path: Path) -> FilmedEpisode:
    """Read the episode ``path``; raises ``InputError`` naming a damaged or foreign file."""
    contents = read_whole(path)
    with explained(path):
        pictures = {}
        for finger in FINGERS:
            messages = contents.messages.pop(IMAGE[finger].name, [])
            packed = tuple(bytes(unpack_image(message)[1]) for message in messages)
            pictures[finger] = Pictures(to_s(stamps_ns(messages)), packed)
    return FilmedEpisode(episode_of(contents, path), pictures)
