"""Quality checks: undisturbed probes pass, and each injected fault is reported."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from touchdown.backend.core.values import TACTILE_CHANNELS, EpisodeQuality
from touchdown.backend.episodes.quality import (
    ExaminedEpisode,
    check_quality,
    find_asymmetry,
    lags_s,
)
from touchdown.backend.geometry.outlines import face_points
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.simulation.batch import BatchPlan, simulate_episodes

GOOD = EpisodeQuality(True, (), 0, 0.0, 0, 20.0, 0.0)
FZ = TACTILE_CHANNELS + 2


def simulated(count: int) -> list[ExaminedEpisode]:
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
            rows.append(ExaminedEpisode(uuid, batch.observation[k], batch.offset_mm[k], GOOD))
    return sorted(rows, key=lambda row: row.uuid)


@pytest.fixture(scope="module")
def clean() -> list[ExaminedEpisode]:
    return simulated(60)


def kinds(rows) -> set[tuple[str, tuple[str, ...]]]:
    return {(finding.kind, finding.episodes) for finding in check_quality(rows)}


def seen(row: ExaminedEpisode) -> np.ndarray:
    return row.observation.copy()


def test_undisturbed_probes_have_no_findings(clean) -> None:
    assert check_quality(clean) == []


def knocked(row: ExaminedEpisode) -> ExaminedEpisode:
    values = seen(row)
    values[9, FZ] += 1.0
    return replace(row, observation=values)


def never_touched(row: ExaminedEpisode) -> ExaminedEpisode:
    values = seen(row)
    values[:, FZ] = 0.2
    return replace(row, observation=values)


def deaf(row: ExaminedEpisode) -> ExaminedEpisode:
    values = seen(row)
    values[:, FZ] = np.nan
    return replace(row, observation=values)


def jumped_marker(row: ExaminedEpisode) -> ExaminedEpisode:
    values = seen(row)
    values[12:, 40] = 33.0
    return replace(row, observation=values)


def late_gel(row: ExaminedEpisode) -> ExaminedEpisode:
    """Shift both gels 0.05 s behind the force."""
    values = seen(row)
    moving = np.concatenate([np.zeros((1, TACTILE_CHANNELS)), values[:, :TACTILE_CHANNELS]])
    values[:, :TACTILE_CHANNELS] = 0.5 * (moving[:-1] + moving[1:])
    return replace(row, observation=values)


def worse(row: ExaminedEpisode, **changes: float) -> ExaminedEpisode:
    return replace(row, quality=replace(row.quality, **changes))


@pytest.mark.parametrize(
    ("kind", "disturb"),
    [
        ("jerk", knocked),
        ("no contact", never_touched),
        ("no contact", deaf),
        ("saturated markers", jumped_marker),
        ("clock skew", late_gel),
        ("lost markers", lambda row: worse(row, lost_markers=4)),
        ("dropped frames", lambda row: worse(row, dropped_frames=5)),
        ("slip", lambda row: worse(row, slip_mm=0.4)),
    ],
)
@pytest.mark.parametrize("which", [0, 17, 42])
def test_a_disturbed_probe_is_listed_by_its_kind(clean, kind, disturb, which) -> None:
    rows = [disturb(row) if k == which else row for k, row in enumerate(clean)]
    found = kinds(rows)
    assert (kind, (clean[which].uuid,)) in found
    assert {uuid for _, episodes in found for uuid in episodes} == {clean[which].uuid}


def test_the_lag_of_a_late_gel_is_measured(clean) -> None:
    for row in clean[:10]:
        late = list(lags_s(late_gel(row).observation))
        np.testing.assert_allclose(late, np.add(list(lags_s(row.observation)), 0.05), atol=0.005)
        assert np.abs(list(lags_s(row.observation))).max() < 0.02


@pytest.mark.promise("W13")
def test_the_same_signals_under_other_labels_are_twins(clean) -> None:
    rng = np.random.default_rng(2)
    copy = clean[5].observation + rng.normal(0, 0.01, (20, 258)).astype(np.float32)
    far = replace(clean[5], uuid="twin", observation=copy, offset_mm=clean[5].offset_mm + 6.0)
    near = replace(far, uuid="near", offset_mm=clean[5].offset_mm + 1.0)
    assert ("twins", ("e05", "twin")) in kinds([*clean, far])
    assert kinds([*clean, near]) == set()


def test_a_shifted_distribution_is_uneven_along_its_axis(clean) -> None:
    moved = [replace(row, offset_mm=row.offset_mm + np.array([0.0, 5.0])) for row in clean]
    (finding,) = find_asymmetry(moved)
    assert finding.kind == "asymmetry"
    assert "along y" in finding.text
    assert find_asymmetry(moved[:10]) == []


def test_examining_nothing_finds_nothing() -> None:
    assert check_quality([]) == []
