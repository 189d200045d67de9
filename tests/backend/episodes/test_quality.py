"""Coverage: bins are counted where they are, and only reachable ones can be holes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from touchdown.backend.core import TACTILE_CHANNELS, EpisodeQuality, InputError
from touchdown.backend.episodes.quality import (
    ExaminedEpisode,
    check_quality,
    count_coverage,
    find_asymmetry,
    lags_s,
)
from touchdown.backend.episodes.training_rows import divided_indices, split_series
from touchdown.backend.geometry import circle, face_points, load_pieces, overlap_area_mm2
from touchdown.backend.simulation.batch import BatchPlan, simulate_episodes

FACE, BOTTOM = circle(15.0), circle(25.0)


def test_every_displacement_counts_in_its_own_bin():
    rng = np.random.default_rng(4)
    offsets = rng.uniform(-19, 19, (300, 2))
    seen = count_coverage(offsets, FACE, BOTTOM)
    assert seen.counts.sum() == 300
    for row, column in np.argwhere(seen.counts > 0):
        centre = np.array(seen.centre_mm(row, column))
        inside = (np.abs(offsets - centre) <= 1.0).all(axis=1)
        assert inside.sum() == seen.counts[row, column]


def test_reachable_bins_are_those_with_overlap():
    seen = count_coverage(np.empty((0, 2)), FACE, BOTTOM)
    for row, column in np.ndindex(seen.possible.shape):
        area = overlap_area_mm2(FACE, seen.centre_mm(row, column), BOTTOM)
        assert seen.possible[row, column] == (area >= 6.0)
    assert seen.holes == seen.possible.sum()
    assert seen.covered == 0.0


@pytest.mark.promise("W13")
def test_one_more_displacement_fills_one_hole():
    seen = count_coverage(np.empty((0, 2)), FACE, BOTTOM)
    more = seen.with_offset((3.9, -6.2))
    assert more.holes == seen.holes - 1
    assert np.argwhere(more.counts).tolist() == [
        [more.counts.shape[0] // 2 - 3, more.counts.shape[1] // 2 + 2]
    ]
    assert more.with_offset((90.0, 0.0)).counts.sum() == 1
    assert more.with_offset((np.nan, 0.0)).counts.sum() == 1


GOOD = EpisodeQuality(True, (), 0, 0.0, 0, 20.0, 0.0)


@dataclass(frozen=True)
class Recorded:
    """An episode before it is examined."""

    uuid: str
    observation: np.ndarray
    offset_mm: np.ndarray
    quality: EpisodeQuality

    @property
    def examined(self) -> ExaminedEpisode:
        return ExaminedEpisode.of(self.uuid, self.observation, self.offset_mm, self.quality)


FZ = TACTILE_CHANNELS + 2


def simulated(count: int) -> list[Recorded]:
    """Return probes of the pot from the simulated bench."""
    catalogue = load_pieces()
    top, below = catalogue.top("pot"), catalogue.bottom("circle25")
    plan = BatchPlan(
        piece="pot", bottom="circle25", face=top.face, bottom_outline=below.upper,
        face_points_mm=face_points(top.face), grip_height_mm=top.grip_height_mm,
        width_mm=top.width_mm, episodes=count, seed=11, probes_per_grip=10,
    )  # fmt: skip
    rows = []
    for batch in simulate_episodes(plan):
        for k in range(len(batch.episode)):
            uuid = f"e{batch.episode[k]:02d}"
            rows.append(Recorded(uuid, batch.observation[k], batch.offset_mm[k], GOOD))
    return sorted(rows, key=lambda row: row.uuid)


@pytest.fixture(scope="module")
def clean() -> list[Recorded]:
    return simulated(60)


def kinds(rows) -> set[tuple[str, tuple[str, ...]]]:
    return {
        (finding.kind, finding.episodes)
        for finding in check_quality([row.examined for row in rows])
    }


def test_undisturbed_probes_and_none_have_no_findings(clean):
    assert kinds(clean) == kinds([]) == set()


def changed(row: Recorded, index: object, values: object) -> Recorded:
    observation = row.observation.copy()
    observation[index] = values
    return replace(row, observation=observation)


def knocked(row: Recorded) -> Recorded:
    return changed(row, (9, FZ), row.observation[9, FZ] + 1.0)


def never_touched(row: Recorded) -> Recorded:
    return changed(row, (slice(None), FZ), 0.2)


def deaf(row: Recorded) -> Recorded:
    return changed(row, (slice(None), FZ), np.nan)


def jumped_marker(row: Recorded) -> Recorded:
    return changed(row, (slice(12, None), 40), 33.0)


def late_gel(row: Recorded) -> Recorded:
    """Shift both gels 0.05 s behind the force."""
    gel = row.observation[:, :TACTILE_CHANNELS]
    moving = np.concatenate([np.zeros((1, TACTILE_CHANNELS)), gel])
    return changed(row, (slice(None), slice(TACTILE_CHANNELS)), 0.5 * (moving[:-1] + moving[1:]))


def worse(row: Recorded, **changes: float) -> Recorded:
    return replace(row, quality=replace(row.quality, **changes))


DISTURBED: dict[str, Callable[[Recorded], Recorded]] = {
    "jerk": knocked,
    "no contact": never_touched,
    "saturated markers": jumped_marker,
    "clock skew": late_gel,
    "lost markers": lambda row: worse(row, lost_markers=4),
    "dropped frames": lambda row: worse(row, dropped_frames=5),
    "slip": lambda row: worse(row, slip_mm=0.4),
}


@pytest.mark.parametrize(("kind", "disturb"), [*DISTURBED.items(), ("no contact", deaf)])
@pytest.mark.parametrize("which", [0, 17, 42])
def test_a_disturbed_probe_is_listed_by_its_kind(clean, kind, disturb, which):
    rows = [disturb(row) if k == which else row for k, row in enumerate(clean)]
    found = kinds(rows)
    assert (kind, (clean[which].uuid,)) in found
    assert {uuid for _, episodes in found for uuid in episodes} == {clean[which].uuid}


def test_the_lag_of_a_late_gel_is_measured(clean):
    for row in clean[:10]:
        late = list(lags_s(late_gel(row).observation))
        np.testing.assert_allclose(late, np.add(list(lags_s(row.observation)), 0.05), atol=0.005)
        assert np.abs(list(lags_s(row.observation))).max() < 0.02


@pytest.mark.promise("W13")
def test_the_same_signals_under_other_labels_are_twins(clean):
    rng = np.random.default_rng(2)
    copy = clean[5].observation + rng.normal(0, 0.01, (20, 258)).astype(np.float32)
    far = replace(clean[5], uuid="twin", observation=copy, offset_mm=clean[5].offset_mm + 6.0)
    near = replace(far, uuid="near", offset_mm=clean[5].offset_mm + 1.0)
    assert ("twins", ("e05", "twin")) in kinds([*clean, far])
    assert kinds([*clean, near]) == set()
    unknown = changed(far, (3, 0), np.nan)
    assert ("twins", ("e05", "twin")) not in kinds([*clean, unknown]), "a signal is unknown"


def test_a_shifted_distribution_is_uneven_along_its_axis(clean):
    moved = [replace(row, offset_mm=row.offset_mm + np.array([0.0, 5.0])) for row in clean]
    (finding,) = find_asymmetry([row.examined for row in moved])
    assert finding.kind == "asymmetry"
    assert "along y" in finding.text
    assert find_asymmetry([row.examined for row in moved[:10]]) == []


SERIES = [(f"m{m}", f"pot/{bottom}") for m in range(6) for bottom in ("short", "long")]
MOUNTING = [m for m, _ in SERIES for _ in range(10)]
PAIR = [pair for _, pair in SERIES for _ in range(10)]


@pytest.mark.parametrize("seed", range(5))
def test_no_pair_of_a_series_is_divided(seed):
    split = split_series(MOUNTING, PAIR, 0.25, seed)
    assert split.kept_together == "series"
    assert sorted([*split.train, *split.held_out]) == list(range(120))
    assert len(split.held_out) == 30
    groups = list(zip(MOUNTING, PAIR, strict=True))
    held_out = {groups[k] for k in split.held_out.tolist()}
    assert not held_out & {groups[k] for k in split.train.tolist()}


def test_many_mountings_are_held_out_whole():
    mountings = [f"m{k // 4}" for k in range(160)]
    pairs = [("pot/short", "pot/long")[k % 2] for k in range(160)]
    split = split_series(mountings, pairs, 0.1, 1)
    assert split.kept_together == "mounting"
    held_out = {mountings[k] for k in split.held_out.tolist()}
    assert len(held_out) == 4
    assert not held_out & {mountings[k] for k in split.train.tolist()}


@pytest.mark.parametrize(
    ("mountings", "pairs", "named"),
    [
        (["m"] * 8, ["pot on short"] * 8, "one series only of pot on short"),
        (["m", "n"] * 4, ["pot on short", "pot on long"] * 4, "one series only of each pair"),
    ],
)
def test_a_pair_with_one_series_cannot_be_split(mountings, pairs, named):
    with pytest.raises(InputError, match=named) as refused:
        split_series(mountings, pairs, 0.25, 0)
    assert "Collect another campaign" in refused.value.fix
    assert "--divide-series" in refused.value.fix


@pytest.mark.parametrize("seed", range(8))
def test_every_pair_keeps_a_series_to_train_on(seed):
    mountings = ["a"] * 5 + ["b"] * 5 + ["c"] * 5 + ["d"] * 5
    pairs = ["pot on short"] * 10 + ["pot on long"] * 5 + ["pot on hex20"] * 5
    split = split_series(mountings, pairs, 0.9, seed)
    assert {pairs[k] for k in split.train.tolist()} == set(pairs)
    assert {pairs[k] for k in split.held_out.tolist()} == {"pot on short"}


def test_a_short_series_is_held_out_rather_than_most_of_the_data():
    mountings = ["long"] * 98 + ["short"] * 2
    for seed in range(4):
        split = split_series(mountings, ["pot on short"] * 100, 0.1, seed)
        assert split.held_out.tolist() == [98, 99]


def test_the_episodes_of_divided_groups_are_found():
    sides = ["train", "train", "held_out", "held_out", "train"]
    groups = ["a", "b", "b", "c", "a"]
    np.testing.assert_array_equal(divided_indices(sides, groups), [1, 2])
    assert len(divided_indices(["train"] * 5, groups)) == 0
    assert len(divided_indices([], [])) == 0
