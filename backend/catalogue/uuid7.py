"""UUID version 7 (RFC 9562): sorting by id is sorting by time. Python 3.11 has no generator."""

from __future__ import annotations

import secrets
import time
import uuid
from threading import Lock

RANDOM_BITS = 74
_lock = Lock()
_last = (0, 0)


def uuid7() -> str:
    """Return a new id, greater than every one this process made before."""
    global _last
    with _lock:
        ms, random = time.time_ns() // 1_000_000, secrets.randbits(RANDOM_BITS - 1)
        if ms <= _last[0]:
            # Within one millisecond (or when the clock was set back) count on from the last one.
            ms, random = _last[0], _last[1] + 1 + secrets.randbits(32)
        _last = (ms, random)
    return from_parts(ms, random)


def follow(text: str) -> None:
    """Make every later id of this process greater than ``text``, whatever the clock says.

    A clock that was set back must not put what comes later before what is there. Text that is no
    such id changes nothing.
    """
    global _last
    if is_uuid7(text):
        value = uuid.UUID(text).int
        random = (value >> 64 & 0xFFF) << 62 | value & ((1 << 62) - 1)
        ms = value >> 80
        # Near the end of a millisecond there is no room to count on.
        parts = (ms, random) if random < 1 << (RANDOM_BITS - 1) else (ms + 1, 0)
        with _lock:
            _last = max(_last, parts)


def from_parts(ms: int, random: int) -> str:
    """Return the id of Unix milliseconds (48 bit) and 74 random bits."""
    high, low = random >> 62, random & ((1 << 62) - 1)
    return str(uuid.UUID(int=ms << 80 | 0x7 << 76 | high << 64 | 0b10 << 62 | low))


def is_uuid7(text: str) -> bool:
    """Whether ``text`` is such an id, in its usual spelling."""
    try:
        value = uuid.UUID(text)
    except ValueError:
        return False
    return value.version == 7 and str(value) == text
