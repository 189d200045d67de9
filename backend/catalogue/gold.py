"""Gold among the ordinary work: approved labels of others that look as if nobody had decided yet.

One episode in ``GOLD_EVERY`` of what a person is to label is gold. It shows the label that it was
recorded with and takes every action as the rest does. Each action is kept in the log, apart from
the labels; what is decided is an opinion, and the approved label never changes.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from hashlib import blake2b

from backend.catalogue.dataset import Dataset
from backend.catalogue.values import EpisodeEntry, Revision, Step

GOLD_EVERY = 20
BLOCK = GOLD_EVERY - 1


@dataclass(frozen=True, slots=True)
class Shown:
    """How a gold episode is to be seen: the label it was recorded with, and where.

    ``beside`` is the episode of the queue that it follows, "" if it is the first.
    """

    recorded: Revision
    beside: str


Mixed = tuple[list[str], dict[str, Shown]]
"""A queue with gold in it, and how the gold is to be seen."""


def with_gold(
    dataset: Dataset, person: str, order: Sequence[str], entries: Mapping[str, EpisodeEntry],
    seed: int = 0,
) -> Mixed:  # fmt: skip
    """Return what ``person`` is to label, gold among it; what they left of it comes again."""
    waiting = dataset.queue("gold", person, seed=seed)
    steps = dataset.labels.left_apart(person)
    begun = {uuid: steps[uuid] for uuid in waiting if uuid in steps and uuid in entries}
    found = mixed(order, waiting, begun)
    places = preceding(found, set(order)) | {uuid: step.beside for uuid, step in begun.items()}
    return found, {
        uuid: Shown(dataset.labels.history(uuid)[0], beside) for uuid, beside in places.items()
    }


def mixed(
    order: Sequence[str], gold: Sequence[str], begun: Mapping[str, Step] | None = None
) -> list[str]:
    """Return ``order`` with one of ``gold`` at some place of every 19 of them, while there are any.

    The places follow from the ids: the same queue is mixed in the same way again. What of the gold
    was ``begun`` stands where it stood then, and behind the rest if it was skipped, however few are
    left; a skipped part of ``order`` begins where the ids, which rise, fall.
    """
    known, there = begun or {}, set(order)
    places = defaultdict[int, list[str]](list)
    falls = (k for k in range(1, len(order)) if order[k] < order[k - 1])
    skipped = next(falls, len(order))
    for uuid in sorted(set(known) - there):
        step = known[uuid]
        low, high = (skipped, len(order)) if step.skipped else (0, skipped)
        places[bisect_right(order, step.beside, low, high)].append(uuid)
    fresh = [uuid for uuid in gold if uuid not in there and uuid not in known]
    for uuid, block in zip(fresh, range(len(known), len(order) // BLOCK), strict=False):
        die = blake2b(uuid.encode(), digest_size=2).digest()[0] % GOLD_EVERY
        places[block * BLOCK + die].append(uuid)
    found = list[str]()
    for k in range(len(order) + 1):
        found += [*places[k], *order[k : k + 1]]
    return found


def preceding(order: Sequence[str], ordinary: set[str]) -> dict[str, str]:
    """Return the ordinary episode before each other one, "" if there is none."""
    found, before = dict[str, str](), ""
    for uuid in order:
        if uuid in ordinary:
            before = uuid
        else:
            found[uuid] = before
    return found
