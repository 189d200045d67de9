"""A campaign on disk: what was planned, so that it goes on after a restart.

One JSON file per campaign beside the episodes. What is done is not written here: it is what the
dataset holds, minus what was discarded. What was skipped the episodes tell as well, so that a disk
with no room for the file loses no decision.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

from backend.catalogue.campaigns import items_deleted
from backend.catalogue.dataset import Dataset
from backend.catalogue.uuid7 import uuid7
from backend.catalogue.values import EpisodeEntry
from backend.core.faults import InputError
from backend.core.files import write_atomically
from backend.runs.collect_plan import PATTERNS, Pattern
from backend.runs.words import DECIDED

FOLDER = "campaigns"
FORMAT = 1


@dataclass(frozen=True, slots=True)
class Campaign:
    """The plan of a campaign. ``skipped``: items that nobody wants any more.

    ``mountings``: how many were begun; each start of the campaign begins a new one.
    """

    uuid: str
    piece: str
    bottom: str
    pattern: Pattern
    seed: int
    count: int
    within_mm: float | None = None
    skipped: tuple[int, ...] = ()
    mountings: int = 0

    def todo(self, entries: Iterable[EpisodeEntry]) -> list[int]:
        """Return the items that neither ``entries`` nor the skipped ones hold, in order."""
        done = {e.plan_item for e in entries if e.quality.accepted and not e.deleted}
        return [k for k in range(self.count) if k not in done and k not in self.skipped]

    def with_mounting(self) -> Campaign:
        """Return the campaign with one more mounting begun."""
        return replace(self, mountings=self.mountings + 1)

    def without(self, item: int) -> Campaign:
        """Return the campaign that leaves ``item`` out."""
        return replace(self, skipped=tuple(sorted({*self.skipped, item})))

    def save(self, dataset: Path) -> None:
        """Write the campaign durably into its dataset."""
        content = {"format": FORMAT, **asdict(self)}
        write_atomically(_path(dataset, self.uuid), json.dumps(content, indent=1).encode())


def new_campaign(
    piece: str, bottom: str, pattern: Pattern, seed: int, count: int, within_mm: float | None
) -> Campaign:
    """Return a campaign that has not begun; raises ``InputError`` for senseless numbers."""
    if count < 1:
        raise InputError("A campaign has at least one probe.", "--count", "Give a number above 0.")
    if seed < 0:
        raise InputError(f"The seed {seed} is negative.", "--seed", "Give 0 or a positive number.")
    if within_mm is not None and not within_mm > 0:
        raise InputError("The range is not positive.", "--within", "Give a length in mm.")
    return Campaign(uuid7(), piece, bottom, pattern, seed, count, within_mm)


def read_campaign(dataset: Path, uuid: str) -> Campaign:
    """Read one campaign; raises ``InputError`` naming its file."""
    path = _path(dataset, uuid)
    try:
        content = json.loads(path.read_text("utf-8"))
        if content.pop("format") != FORMAT or content["pattern"] not in PATTERNS:
            raise ValueError("it is of another version")
        content["skipped"] = tuple(int(item) for item in content["skipped"])
        known = {field.name for field in fields(Campaign)}
        return Campaign(**{k: v for k, v in content.items() if k in known})
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"The campaign cannot be read: {error}.", str(path), "Begin a new campaign."
        ) from error


def campaign_now(dataset: Dataset, uuid: str) -> Campaign:
    """Return a campaign as it goes on: without what its file or its episodes say was skipped."""
    plan = read_campaign(dataset.folder, uuid)
    skipped = items_deleted(dataset.database, uuid, DECIDED["skip"])
    return replace(plan, skipped=tuple(sorted({*plan.skipped, *skipped})))


def newest_campaign(dataset: Path) -> str | None:
    """Return the id of the campaign that was begun last, None if there is none."""
    names = sorted(path.stem for path in (dataset / FOLDER).glob("*.json"))
    return names[-1] if names else None


def _path(dataset: Path, uuid: str) -> Path:
    return dataset / FOLDER / f"{uuid}.json"
