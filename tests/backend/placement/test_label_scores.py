"""Queues ordered by models: wrong labels come first."""

import numpy as np
import pytest

from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.values import EpisodeContext, Label
from touchdown.backend.bench.assembly import shipped_model
from touchdown.backend.core.values import Episode, EpisodeQuality
from touchdown.backend.geometry.outlines import face_points
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.placement.estimator import Ensemble, Estimator
from touchdown.backend.placement.label_review import score_labels
from touchdown.backend.simulation.batch import BatchPlan, simulate_episodes

EPISODES, WRONG = 60, 3
QUALITY = EpisodeQuality(True, (), 0, 0.0, 0, 0.0, 0.0)


@pytest.fixture
def dataset(tmp_path):
    """Simulated probes; the labels of the first few were moved by 8 mm."""
    catalogue = load_pieces()
    pot, bottom = catalogue.top("pot"), catalogue.bottom("circle15")
    plan = BatchPlan("pot", "circle15", pot.face, bottom.face, face_points(pot.face), 30.0, 30.0,
                EPISODES, 5, probes_per_grip=1, grips_per_mounting=1)  # fmt: skip
    batch = next(iter(simulate_episodes(plan)))
    rng = np.random.default_rng(0)
    with Dataset.open(tmp_path / "dataset", person="setup") as made:
        pair = made.geometry.store_pair(pot, bottom)
        context = EpisodeContext("s", "circle15", pair, "setup", "g", "m")
        for i in range(EPISODES):
            at = np.array(batch.offset_mm[i])
            turn = rng.uniform(0, 2 * np.pi)
            said = at + (8.0 * np.array([np.cos(turn), np.sin(turn)]) if i < WRONG else 0.0)
            x_um, y_um = np.rint(1e3 * said).astype(int).tolist()
            episode = Episode(f"e{i}", "pot", np.array(batch.observation[i]), at, 0.0, QUALITY)
            made.record(episode, Label(x_um, y_um, 0, 300), source="commanded", context=context)
        yield made


@pytest.mark.slow
def test_wrong_labels_come_first(dataset):
    pot = load_pieces().top("pot")
    models = Ensemble([Estimator.load(shipped_model("pot"), pot)])
    wrong = {entry.uuid for entry in dataset.episodes()[:WRONG]}
    before = {entry.uuid: dataset.labels.head(entry.uuid) for entry in dataset.episodes()}
    seen = []
    count = score_labels(dataset, lambda piece: models, lambda k, n: seen.append((k, n)) is None)
    assert count == EPISODES
    assert seen[-1] == (EPISODES, EPISODES)
    order = dataset.queue("disagreement", "Ann")
    first = order[: 2 * WRONG]
    assert len(wrong & set(first)) >= 2  # base rate: 0.3 of these 6
    assert dataset.queue("doubt", "Ann") == []  # too few to tell what is felt where
    assert dataset.queue("disagreement", "Ann") == order
    assert len(wrong & set(dataset.queue("duplicates", "Ann")[: 2 * WRONG])) >= 2
    assert len(dataset.queue("uncertainty", "Ann")) == EPISODES
    assert {entry.uuid: dataset.labels.head(entry.uuid) for entry in dataset.episodes()} == before
    suggestion = dataset.scores.suggestion(order[0])
    assert suggestion.source == f"model:{models.weights}"


@pytest.mark.slow
def test_stopping_keeps_what_was_found(dataset):
    models = Ensemble([Estimator.load(shipped_model("pot"), load_pieces().top("pot"))])
    assert score_labels(dataset, lambda piece: models, lambda k, n: k < 5) == 5
    assert len(dataset.queue("uncertainty", "Ann")) == 5
