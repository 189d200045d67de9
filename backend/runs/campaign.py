"""Campaign of data collection: planned displacements, plan on disk, progress.

A campaign continues after a restart.
"""

from __future__ import annotations

import json
import random
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated

import numpy as np
import pydantic.dataclasses
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, ValidationError

from touchdown.backend import core, episodes
from touchdown.backend.annotations import Dataset, EpisodeEntry, EpisodeFilter, items_deleted, uuid7
from touchdown.backend.config import first_error
from touchdown.backend.geometry import (
    COARSE_SEGMENTS,
    MIN_OVERLAP_MM2,
    Outline,
    draw_offset,
    overlap_area_mm2,
)
from touchdown.backend.runs.messages import DECISION_WORDS
from touchdown.backend.runs.requests import Pattern

PATTERNS: tuple[Pattern, ...] = ("random", "grid", "adaptive")
TRIES = 2000
FINEST_MM, HALVINGS = 0.05, 12
_ITEM = 88


@dataclass(frozen=True, slots=True)
class ProbeTarget:
    """Pair of faces to probe, with the largest displacement along x and y (mm)."""

    face: Outline
    bottom: Outline
    within_mm: float | None = None

    def allows(
        self, offsets_mm: core.FloatArray
    ) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Return (n,): which of ``offsets_mm`` (n, 2) overlap enough and lie within the range."""
        area = overlap_area_mm2(self.face, offsets_mm, self.bottom, segments=COARSE_SEGMENTS)
        enough = area >= MIN_OVERLAP_MM2
        if self.within_mm is not None:
            enough &= (np.abs(offsets_mm) <= self.within_mm).all(axis=1)
        return np.asarray(enough)

    @property
    def reach_mm(self) -> float:
        """Largest displacement along x or y that can overlap."""
        reach = float(max(np.add(self.face.half_extents_mm, self.bottom.half_extents_mm)))
        return reach if self.within_mm is None else min(reach, self.within_mm)


def planned_displacement_mm(
    pattern: Pattern, target: ProbeTarget, seed: int, item: int, count: int, seen: episodes.Coverage
) -> tuple[float, float]:
    """Return the displacement of item 0, 1, ... of ``count``; raises ``InputError`` if none fits.

    ``seen`` is the coverage so far, used by the adaptive pattern only.
    """
    rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, _ITEM, item])))
    if pattern == "grid":
        return xy_mm(grid_displacements_mm(target, count)[item])
    if pattern == "adaptive":
        return _into_a_hole(rng, target, seen)
    for _ in range(TRIES):
        tried = draw_offset(rng, target.face, target.bottom, 8)
        fitting = tried[target.allows(tried)]
        if len(fitting):
            return xy_mm(fitting[0])
    raise _nothing_fits(target)


@lru_cache(maxsize=4)
def grid_displacements_mm(target: ProbeTarget, count: int) -> core.FloatArray:
    """Return (count, 2) points of the widest square lattice with enough points, in boustrophedon
    order.
    """
    coarse_mm = target.reach_mm / 40
    pitch_mm = coarse_mm * float(np.sqrt(len(_lattice(target, coarse_mm)) / count))
    if not pitch_mm >= FINEST_MM:
        raise _nothing_fits(target)
    fine, wide = 0.5 * pitch_mm, 2.0 * pitch_mm
    for _ in range(HALVINGS):
        middle = 0.5 * (fine + wide)
        if len(_lattice(target, middle)) >= count:
            fine = middle
        else:
            wide = middle
    places = _lattice(target, fine)
    chosen = np.asarray(places[np.linspace(0, len(places) - 1, count).round().astype(int)])
    core.read_only(chosen)
    return chosen


def _lattice(target: ProbeTarget, pitch_mm: float) -> core.FloatArray:
    """Return the allowed lattice points (n, 2) row by row, in alternating direction."""
    count = int(target.reach_mm / pitch_mm)
    steps = pitch_mm * np.arange(-count, count + 1)
    rows = [
        np.stack([steps[:: 1 if k % 2 == 0 else -1], np.full(len(steps), y)], axis=1)
        for k, y in enumerate(steps)
    ]
    places = np.concatenate(rows)
    return np.asarray(places[target.allows(places)])


def _into_a_hole(
    rng: np.random.Generator, target: ProbeTarget, seen: episodes.Coverage
) -> tuple[float, float]:
    """Draw a point in one of the reachable bins with the fewest probes."""
    rows, columns = np.nonzero(seen.possible)
    order = np.lexsort((rng.random(len(rows)), seen.counts[rows, columns]))
    for k in order:
        centre = np.array(seen.centre_mm(int(rows[k]), int(columns[k])))
        tried = centre + seen.bin_mm * (rng.random((16, 2)) - 0.5)
        fitting = tried[target.allows(tried)]
        if len(fitting):
            return xy_mm(fitting[0])
    raise _nothing_fits(target)


def xy_mm(place: core.FloatArray) -> tuple[float, float]:
    """Return the first two components as floats."""
    return float(place[0]), float(place[1])


def _nothing_fits(target: ProbeTarget) -> core.InputError:
    within = "" if target.within_mm is None else f" within {target.within_mm:g} mm"
    return core.InputError(
        f"Not enough displacements{within} overlap by {MIN_OVERLAP_MM2:g} mm².",
        "piece, bottom, range and count",
        "Choose larger faces, a wider range or fewer probes.",
    )


FOLDER = "campaigns"
FORMAT = 1


@pydantic.dataclasses.dataclass(
    frozen=True, slots=True, config=ConfigDict(strict=True, allow_inf_nan=False)
)
class Campaign:
    """Plan of a campaign.

    ``skipped`` are items left out. ``mountings`` counts the mountings begun; each start of the
    campaign begins another one. ``recording``: values of its recording plan; empty without one.
    """

    uuid: str
    piece: str
    bottom: str
    pattern: Pattern
    seed: Annotated[int, Field(ge=0, lt=2**63)]
    count: Annotated[int, Field(ge=1, le=10_000_000)]
    within_mm: Annotated[float, Field(gt=0, le=1000)] | None = None
    skipped: tuple[Annotated[int, Field(ge=0, lt=2**31)], ...] = ()
    mountings: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    recording: dict[str, str | int | float | None] = field(default_factory=dict)

    def todo(self, entries: Iterable[EpisodeEntry]) -> list[int]:
        """Return the items that are neither in ``entries`` nor skipped, in order."""
        done = {e.plan_item for e in entries if e.quality.accepted and not e.deleted}
        return [k for k in range(self.count) if k not in done and k not in self.skipped]

    def without(self, item: int) -> Campaign:
        """Return the campaign without ``item``."""
        return replace(self, skipped=tuple(sorted({*self.skipped, item})))

    def save(self, dataset: Path) -> None:
        """Write the campaign durably into its dataset."""
        content = {"format": FORMAT, **asdict(self)}
        core.write_atomically(_path(dataset, self.uuid), json.dumps(content, indent=1).encode())


def fresh_seed() -> int:
    """Return a random seed for a campaign, so that two campaigns do not press the same places."""
    return DICE.randrange(1_000_000)


DICE = random.SystemRandom()


def new_campaign(
    piece: str, bottom: str, pattern: Pattern, seed: int, count: int, within_mm: float | None
) -> Campaign:
    """Return a new campaign, of the numbers of a ``CollectRequest``."""
    return Campaign(
        uuid=uuid7(), piece=piece, bottom=bottom, pattern=pattern,
        seed=seed, count=count, within_mm=within_mm,
    )  # fmt: skip


def read_campaign(dataset: Path, uuid: str) -> Campaign:
    """Read one campaign; raises ``InputError`` naming its file."""
    path = _path(dataset, uuid)
    try:
        content = core.parse_json(path.read_bytes())
        version, skipped = content.pop("format"), content["skipped"]
        if version is True or version != FORMAT or content["pattern"] not in PATTERNS:
            raise ValueError("it is of another version")
        if not isinstance(skipped, list):
            raise ValueError("'skipped' is not a list")
        content["skipped"] = tuple(skipped)
        known = {field.name for field in fields(Campaign)}
        return Campaign(**{k: v for k, v in content.items() if k in known})
    except (OSError, ValueError, KeyError, TypeError) as error:
        why = first_error(error) if isinstance(error, ValidationError) else error
        raise core.InputError(
            f"The campaign cannot be read: {why}.", str(path), "Begin a new campaign."
        ) from error


def current_campaign(dataset: Dataset, uuid: str) -> Campaign:
    """Return a campaign without the items that its file or its episodes mark as skipped."""
    plan = read_campaign(dataset.folder, uuid)
    skipped = items_deleted(dataset.database, uuid, DECISION_WORDS["skip"])
    return replace(plan, skipped=tuple(sorted({*plan.skipped, *skipped})))


def newest_campaign(dataset: Path) -> str | None:
    """Return the id of the newest campaign, None if there is none."""
    names = sorted(path.stem for path in (dataset / FOLDER).glob("*.json"))
    return names[-1] if names else None


def _path(dataset: Path, uuid: str) -> Path:
    return dataset / FOLDER / f"{uuid}.json"


def labelled_coverage(
    dataset: Dataset, entries: Sequence[EpisodeEntry], face: Outline, bottom: Outline
) -> episodes.Coverage:
    """Return the coverage of the valid ``entries`` of one pair."""
    kept = [entry.uuid for entry in entries if counts_for_coverage(entry)]
    return episodes.count_coverage(dataset.labels.offsets_mm(kept), face, bottom)


def counts_for_coverage(entry: EpisodeEntry) -> bool:
    """Return True for an accepted observation that was neither discarded nor rejected."""
    return entry.quality.accepted and not entry.deleted and entry.state != "rejected"


def pair_coverage(dataset: Dataset, campaign: Campaign, target: ProbeTarget) -> episodes.Coverage:
    """Return the coverage that a campaign starts from.

    It counts the campaign's own probes and the submitted or approved ones of the same pair.
    """
    entries = dataset.episodes(EpisodeFilter(piece=campaign.piece, bottom=campaign.bottom))
    counted = ("submitted", "approved")
    kept = [e for e in entries if e.campaign == campaign.uuid or e.state in counted]
    return labelled_coverage(dataset, kept, target.face, target.bottom)


SignalExcerpt = tuple[float, float, float, float, float]


def last_signal_excerpt(observation: NDArray[np.float32]) -> SignalExcerpt:
    """Return marker shift u, v and Tx, Ty, Fz of the last tick, for display.

    ``observation`` (20, 258) as in ``Episode``.
    """
    last = np.asarray(observation[-1], dtype=np.float64)
    # Per axis the value of largest magnitude with its sign; NaN if a value is missing
    shifts = last[: core.TACTILE_CHANNELS].reshape(2, 2, core.MARKERS).swapaxes(0, 1).reshape(2, -1)
    u_px, v_px = (float(shift[np.argmax(np.abs(shift))]) for shift in shifts)
    fz, tx, ty = (float(last[core.TACTILE_CHANNELS + channel]) for channel in (2, 3, 4))
    return u_px, v_px, tx, ty, fz


@dataclass(frozen=True, slots=True)
class ProbeSummary:
    """Probe as used by the quality checks, its commanded displacement (mm) and last signals."""

    examined: episodes.ExaminedEpisode
    commanded_mm: tuple[float, float]
    signals: SignalExcerpt


def read_probe_summary(dataset: Dataset, entry: EpisodeEntry) -> ProbeSummary:
    """Read one probe without its images; raises ``InputError`` naming a damaged file."""
    label_mm = dataset.labels.head(entry.uuid).label.offset_mm
    if entry.mode == "mass":
        episode = dataset.read(entry.uuid)
        observation, commanded_mm = episode.observation, episode.offset_mm.tolist()
    else:
        path = dataset.folder / entry.path
        contents = episodes.read_first(path)
        with episodes.input_errors(path):
            observation = episodes.unpack_observation(
                contents.messages[episodes.OBSERVATION_TOPIC.name]
            )
            commanded_mm = core.parse_json(contents.metadata["episode"]["offset_mm"])
    x_mm, y_mm = commanded_mm
    examined = episodes.ExaminedEpisode.of(entry.uuid, observation, label_mm, entry.quality)
    return ProbeSummary(examined, (x_mm, y_mm), last_signal_excerpt(observation))


def read_examined_episodes(
    dataset: Dataset, entries: Sequence[EpisodeEntry]
) -> list[episodes.ExaminedEpisode]:
    """Read the input of the quality checks; raises ``InputError`` naming a damaged file."""
    return [read_probe_summary(dataset, entry).examined for entry in entries]
