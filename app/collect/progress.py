"""How many accepted probes the campaign has: what is discarded counts no more, at once."""

from __future__ import annotations

from backend.catalogue.values import EpisodeEntry
from backend.core.facts import CampaignBegan, EpisodeDecided, ProbeCollected

TAKEN_BACK = frozenset(("discard", "redo", "skip"))


class Progress:
    """Follows the facts of a run, and what is decided beside it about probes of its campaign."""

    def __init__(self) -> None:
        self.campaign, self.total = "", 1
        self._done = 0
        self._accepted: set[str] = set()
        self._taken_back: set[str] = set()
        self._beside: set[str] = set()

    @property
    def done(self) -> int:
        """Accepted probes that are still there."""
        return self._done - len(self._beside)

    def begin(self, fact: CampaignBegan) -> None:
        """Take the count with which a run begins: what the dataset holds."""
        self.campaign, self.total, self._done = fact.campaign, fact.total, fact.done
        self._accepted, self._taken_back, self._beside = set(), set(), set()

    def collected(self, fact: ProbeCollected) -> None:
        """Take one more probe."""
        self._done, self.total = fact.done, fact.total
        if not fact.reasons:
            self._accepted.add(fact.uuid)

    def decided(self, fact: EpisodeDecided) -> None:
        """Take a decision that the run carried out; its next probe tells the same number."""
        if fact.decision in TAKEN_BACK and fact.uuid in self._accepted - self._taken_back:
            self._taken_back.add(fact.uuid)
            self._done -= 1

    def stored(self, entry: EpisodeEntry) -> None:
        """Take a probe as it is in the dataset now, of which the run knows nothing."""
        if entry.campaign != self.campaign or not entry.quality.accepted:
            return
        if entry.uuid in self._taken_back:
            return
        if entry.deleted:
            self._beside.add(entry.uuid)
        else:
            self._beside.discard(entry.uuid)
