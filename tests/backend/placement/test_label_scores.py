"""Queues that a model orders: wrong labels come first."""

import numpy as np
import pytest

from backend.assembly import shipped_model
from backend.catalogue.dataset import Dataset
from backend.catalogue.values import EpisodeContext, Label
from backend.core.flow import Episode, EpisodeQuality
from backend.objects.catalogue import load_catalogue
from backend.objects.surface import face_points
from backend.placement.estimator import Estimator
from backend.placement.label_scores import alike, score_labels
from backend.simulation.episodes import Plan, simulate

EPISODES, WRONG = 60, 3
QUALITY = EpisodeQuality(True, (), 0, 0.0, 0, 0.0, 0.0)


def test_alike_signals_with_other_labels_by_hand():
    features = {"a": np.array([0.0, 0.0]), "b": np.array([0.1, 0.0]), "c": np.array([3.0, 0.0])}
    offsets = {"a": np.array([0.0, 0.0]), "b": np.array([9.0, 0.0]), "c": np.array([0.5, 0.0])}
    found = alike(features, offsets)
    deviation = np.std([0.0, 0.1, 3.0])
    assert found["a"] == pytest.approx(0.1 / deviation)
    assert found["b"] == pytest.approx(0.1 / deviation)
    assert found["c"] == pytest.approx(2.9 / deviation)  # "a" is alike but also labelled alike


def test_what_has_no_label_is_not_compared():
    nowhere = np.array([np.nan, np.nan])
    assert alike({"a": np.zeros(2), "b": np.ones(2)}, {"a": nowhere, "b": np.zeros(2)}) == {}


@pytest.fixture
def dataset(tmp_path):
    """Simulated probes; the labels of the first few were moved by 8 mm."""
    catalogue = load_catalogue()
    pot, bottom = catalogue.top("pot"), catalogue.bottom("circle15")
    plan = Plan("pot", "circle15", pot.face, bottom.face, face_points(pot.face), 30.0, 30.0,
                EPISODES, 5, probes_per_grip=1, grips_per_mounting=1)  # fmt: skip
    batch = next(iter(simulate(plan)))
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
    pot = load_catalogue().top("pot")
    model = Estimator.load(shipped_model("pot"), pot)
    wrong = {entry.uuid for entry in dataset.episodes()[:WRONG]}
    before = {entry.uuid: dataset.labels.head(entry.uuid) for entry in dataset.episodes()}
    seen = []
    count = score_labels(dataset, lambda piece: model, lambda k, n: seen.append((k, n)) is None)
    assert count == EPISODES
    assert seen[-1] == (EPISODES, EPISODES)
    order = dataset.queue("disagreement", "Ann")
    first = order[: 2 * WRONG]
    assert len(wrong & set(first)) >= 2  # base rate: 0.3 of these 6
    assert dataset.queue("disagreement", "Ann") == order
    assert len(dataset.queue("uncertainty", "Ann")) == EPISODES
    assert {entry.uuid: dataset.labels.head(entry.uuid) for entry in dataset.episodes()} == before
    suggestion = dataset.scores.suggestion(order[0])
    assert suggestion.source == f"model:{model.card.weights_sha256}"


@pytest.mark.slow
def test_stopping_keeps_what_was_found(dataset):
    model = Estimator.load(shipped_model("pot"), load_catalogue().top("pot"))
    assert score_labels(dataset, lambda piece: model, lambda k, n: k < 5) == 5
    assert len(dataset.queue("uncertainty", "Ann")) == 5
