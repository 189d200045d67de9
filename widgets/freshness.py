"""How old is what is shown: judged by the reader's own clock from when the data last changed."""

from __future__ import annotations

from enum import Enum

STALE_AFTER_S = 0.2
GONE_AFTER_S = 2.0


class Age(Enum):
    """How far a picture may be trusted."""

    NEVER = "never"
    FRESH = "fresh"
    STALE = "stale"
    GONE = "gone"


class Freshness:
    """Watches a sequence number. A producer that hangs cannot claim to be alive."""

    def __init__(self) -> None:
        self._count: int | None = None
        self._changed_s = 0.0

    def note(self, count: int, now_s: float) -> bool:
        """Take the producer's present count; return whether it changed since the last call."""
        if count == 0 or count == self._count:
            return False
        self._count, self._changed_s = count, now_s
        return True

    def age_s(self, now_s: float) -> float:
        """Seconds since the count last changed (infinite if it never did)."""
        return now_s - self._changed_s if self._count is not None else float("inf")

    def judge(self, now_s: float) -> Age:
        """Fresh up to 0.2 s, stale up to 2 s, then gone."""
        if self._count is None:
            return Age.NEVER
        age_s = self.age_s(now_s)
        if age_s <= STALE_AFTER_S:
            return Age.FRESH
        return Age.STALE if age_s <= GONE_AFTER_S else Age.GONE
