"""What fusion is learned from: outlines that resemble nothing unseen, sequences pressed as the
bench presses, and a network with its card at the end.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.backend.config.simulation import SimulationSettings, load_simulation
from touchdown.backend.core.values import CHANNELS, TACTILE_CHANNELS
from touchdown.backend.experiments.fusion import (
    FUSED_KINDS,
    PORTIONS,
    SIMILAR_IOU,
    UNSEEN_BOTTOMS,
    UNSEEN_PIECES,
    WEIGHTS,
    DataPortion,
    FusionRecipe,
    MixedBottomLockstep,
    ShapeFamily,
    is_similar,
    load_sequences,
    next_places,
    similarity,
    threshold_jobs,
)
from touchdown.backend.experiments.tables import (
    CELL_SEEDS,
    STACKING_SEED,
    STATIC_SEED,
    TRAINING_SEED,
)
from touchdown.backend.geometry.outlines import Outline, circle, rectangle, square
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.geometry.tower import Body, Tower
from touchdown.backend.jobs.execution import SerialExecutor, run_campaign
from touchdown.backend.jobs.job import JobStore
from touchdown.backend.learning.fused.checkpoint import load_fused
from touchdown.backend.simulation.batch import BatchedTrials
from touchdown.backend.simulation.scene import Scene


@pytest.fixture(scope="module")
def bench_v1() -> SimulationSettings:
    return load_simulation(preset="bench-v1")


def covered_alike(first: Outline, second: Outline) -> float:
    """Intersection over union on a fine grid, the best of all turns by 3 degrees."""
    steps = np.arange(-20.0, 20.0, 0.4)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1)
    inside = first.contains(grid)
    best = 0.0
    for angle in np.radians(np.arange(0.0, 180.0, 5.0)):
        c, s = np.cos(angle), np.sin(angle)
        other = second.contains(grid @ np.array([[c, -s], [s, c]]))
        best = max(best, float((inside & other).sum() / (inside | other).sum()))
    return best


def test_likeness_is_the_common_share_at_the_best_turn() -> None:
    assert similarity(circle(20.0), circle(19.0)) == pytest.approx((19.0 / 20.0) ** 2, abs=2e-3)
    turned = rectangle(12.0, 20.0)
    assert similarity(rectangle(20.0, 12.0), turned) == pytest.approx(1.0, abs=1e-3)
    assert similarity(square(18.0), circle(20.0)) == pytest.approx(
        covered_alike(square(18.0), circle(20.0)), abs=0.01
    )


def test_nothing_drawn_resembles_what_is_called_unseen() -> None:
    catalogue = load_pieces()
    family, rng = ShapeFamily.of(catalogue), np.random.default_rng(1)
    bottoms = [family.bottom(rng) for _ in range(12)]
    unseen = [catalogue.bottom(name).face for name in UNSEEN_BOTTOMS]
    assert max(covered_alike(b.lower, u) for b in bottoms[:4] for u in unseen) <= SIMILAR_IOU + 0.01
    assert not any(is_similar(b.lower, u) for b in bottoms for u in unseen)
    faces = [family.piece(rng).face for _ in range(12)]
    held = [catalogue.top(name).face for name in UNSEEN_PIECES]
    assert not any(is_similar(face, u) for face in faces for u in held)
    # Without the rule the same draws do come near them.
    careless = ShapeFamily((), ())
    anything = [careless.bottom(rng).lower for _ in range(20)]
    assert any(is_similar(o, u) for o in anything for u in unseen)
    assert {o.kind for o in faces} == {"circle", "polygon"}


@pytest.mark.parametrize("fixed", [True, False])
def test_side_by_side_each_presses_its_own_bottom(
    bench_v1: SimulationSettings, fixed: bool
) -> None:
    piece = load_pieces().top("pot")
    bottoms = [
        Body("bottom", face, face, 20.0, 30.0, 10.0, fixed=fixed)
        for face in (circle(14.0), square(22.0))
    ]
    scenes = [Scene(piece, Tower((b,)), (0.0, 0.0), 3 + k, bench_v1) for k, b in enumerate(bottoms)]
    places = np.array([[5.0, 1.0], [-6.0, 2.0]])
    together = MixedBottomLockstep(scenes).press([0, 1], places)
    for k in range(2):
        alone = BatchedTrials(scenes[k : k + 1]).press([0], places[k : k + 1])
        np.testing.assert_allclose(together.observation[k], alone.observation[0], atol=2e-3)
        np.testing.assert_allclose(together.true_mm[k], alone.true_mm[0], atol=1e-4)
    with pytest.raises(ValueError, match="share"):
        BatchedTrials(scenes)


def test_a_step_knows_only_where_the_press_acted() -> None:
    rng = np.random.default_rng(2)
    last = np.tile([4.0, 0.0], (500, 1))
    acted = np.tile([-6.0, 0.0], (500, 1))
    step = next_places(last, acted, rng) - last
    assert np.hypot(*step.T).max() <= 3.0 + 1e-9
    assert step[:, 0].mean() < -1.5
    assert abs(step[:, 1].mean()) < 0.3


TINY = {
    "short": DataPortion(0, 60, pieces=1, bottoms=2, probes=2, free=False),
    "free": DataPortion(500, 100, pieces=1, bottoms=1, probes=3, free=True),
}


def tiny(bench: SimulationSettings, **others: Any) -> FusionRecipe:
    return FusionRecipe(bench, "test", {"short": 2, "free": 2}, steps=3, portions=TINY, **others)


def test_from_nothing_to_a_network_with_its_card(
    bench_v1: SimulationSettings, tmp_path: Path
) -> None:
    store = JobStore(tmp_path)
    jobs = tiny(bench_v1).jobs()
    for result in run_campaign(jobs, SerialExecutor(FUSED_KINDS, store), store):
        assert result.state == "done", result.error
    data = load_sequences([store.folder(job.id) for job in (jobs[0], jobs[2])])
    # Two sequences of two presses and one of three, all padded to three.
    assert data["wrench"].shape == (3, 3, 8, CHANNELS - TACTILE_CHANNELS)
    assert data["count"].tolist()[:2] == [2, 2]
    assert data["count"][2] <= 3
    assert not data["wrench"][:2, 2].any()
    assert data["wrench"][:2, :2].any(axis=(2, 3)).all()
    # The start of a sequence overlaps its bottom, and steps are those of a trial or anywhere.
    found = load_fused(store.folder(jobs[-1].id) / WEIGHTS)
    assert found.card.bench_sha256.startswith("03b08d28746d9339")
    assert found.card.left_out == (*UNSEEN_PIECES, *UNSEEN_BOTTOMS)
    # The first part of either portion is held out.
    assert found.card.training["sequences"] == 3
    assert found.card.training["held_out_sequences"] == 3
    again = tiny(bench_v1, seed=1)
    assert not {job.seed for job in again.jobs()[:4]} & {job.seed for job in jobs[:4]}


def test_no_two_parts_share_a_seed_and_none_has_one_of_the_tables(
    bench_v1: SimulationSettings,
) -> None:
    counts = {name: portion.most for name, portion in PORTIONS.items()}
    seeds: list[int] = []
    for seed in (0, 1):
        jobs = FusionRecipe(bench_v1, "test", counts, seed=seed).jobs()[:-1]
        seeds += [job.seed + k for job in jobs for k in range(240)]
    assert len(set(seeds)) == len(seeds)
    highest = max(TRAINING_SEED, STATIC_SEED, STACKING_SEED) + 100 * CELL_SEEDS
    own = [job.seed + k for job in threshold_jobs(bench_v1, "test", "n", 64) for k in range(8)]
    assert highest < min(seeds) < max(seeds) < min(own)
    assert len(set(own)) == len(own)
