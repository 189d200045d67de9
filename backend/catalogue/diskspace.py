"""Is there room for what is about to be recorded?"""

from __future__ import annotations

import errno
import shutil
from dataclasses import dataclass
from pathlib import Path

from backend.core.faults import InputError

NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Error numbers of a disk that is full, for everybody or for this user."""
LEAST_BYTES = 1_000_000_000
LEAST_EPISODES = 100
GO_ON_BYTES = 500_000_000
"""A run that has begun pauses below this: catalogue and journals still need room."""
EPISODE_BYTES = 3_700_000
"""Size of an episode with JPEG pictures of real gels; simulated ones are smaller."""


@dataclass(frozen=True, slots=True)
class Room:
    """Free bytes, how many episodes fit, and whether all that are planned do."""

    free_bytes: int
    episodes: int
    enough: bool


def room_for(folder: Path, episodes: int, bytes_each: int = EPISODE_BYTES) -> Room:
    """Return the room for ``episodes`` where ``folder`` is or will be.

    Raises ``InputError`` if less than 1 GB is free, or less than 100 episodes take: a disk that is
    nearly full is seldom filled by one program alone. Whoever plans more may warn by ``enough``.
    """
    place, free = _free(folder)
    needed = max(LEAST_BYTES, LEAST_EPISODES * bytes_each)
    if free < needed:
        raise InputError(
            f"Only {free / 1e9:.2f} GB are free; recording needs {needed / 1e9:.2f} GB to start.",
            str(place),
            "Free some space, or record on another disk.",
        )
    fit = free // max(1, bytes_each)
    return Room(free, fit, fit >= episodes)


def free_to_go_on(folder: Path) -> int | None:
    """Return the free bytes where too few are left to record another episode, else None."""
    _, free = _free(folder)
    return free if free < GO_ON_BYTES else None


def _free(folder: Path) -> tuple[Path, int]:
    """Return the nearest folder that exists, and the free bytes of its disk."""
    place = folder.absolute()
    while not place.exists():
        place = place.parent
    return place, shutil.disk_usage(place).free
