"""Comparison of two labellers, in one dataset or in a merged one."""

from __future__ import annotations

import math

import pytest

from tests.backend.annotations.conftest import Record
from tests.backend.annotations.test_values import contents
from touchdown.backend.annotations.agreement import suggestion_bias
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.values import AnswerContext, Label

SHIFTS_UM = (100, -200, 300, 0, 300)


def test_opinions_are_compared_and_change_no_label(dataset: Dataset, record: Record) -> None:
    labels = dataset.labels
    uuids = [record(2000 * k, -1000 * k).uuid for k in range(5)]
    for k, uuid in enumerate(uuids):
        verdict = "stable" if k < 2 else "unstable"
        labels.accept("ann", uuid, Label(2000 * k + SHIFTS_UM[k], -1000 * k + 1, 0, 50),
                      verdict=verdict, context=AnswerContext(4000 + 1000 * k))  # fmt: skip
        labels.approve("cleo", uuid)
    before, chain = contents(dataset), len(labels.log(limit=1000))
    for k, uuid in enumerate(uuids):
        verdict = "stable" if k < 3 else "unstable"
        labels.opinion("bob", uuid, Label(999, 999, 0, 50))
        labels.opinion("bob", uuid, Label(2000 * k, -1000 * k, 0, 50), verdict=verdict,
                       context=AnswerContext(90_000, blind=True))  # fmt: skip
    assert contents(dataset) == before
    assert len(labels.log(limit=1000)) == chain + 10
    assert not labels.can_undo("bob")
    found = dataset.compare("ann", "bob")
    assert found.episodes == 5
    bias = found.bias_x_mm
    assert (bias.mean, bias.deviation) == pytest.approx((0.1, 0.21213), abs=5e-5)
    assert (bias.lower, bias.upper) == pytest.approx((-0.3158, 0.5158), abs=5e-5)
    assert found.rms_mm == pytest.approx(math.sqrt((1e4 + 4e4 + 9e4 + 9e4) / 5 + 1) / 1e3)
    assert found.icc_x > 0.99
    assert 0.8 < found.patch_iou < 1.0
    assert found.kappa == pytest.approx((0.8 - 0.48) / 0.52)
    assert found.drift_mm == pytest.approx(((300 + 0 + 300) / 3e3 - (100 - 200) / 2e3, 0.0))
    assert found.seconds == (6.0, 60.0)


def test_two_persons_without_a_common_episode(dataset: Dataset, record: Record) -> None:
    dataset.labels.set("ann", record().uuid, Label(1, 1))
    found = dataset.compare("ann", "bob")
    assert found.episodes == 0
    figures = (found.rms_mm, found.icc_x, found.patch_iou, found.kappa, found.alpha)
    assert all(math.isnan(figure) for figure in (*figures, *found.drift_mm, *found.seconds))


def test_one_common_episode_gives_what_one_can_give(dataset: Dataset, record: Record) -> None:
    uuid = record().uuid
    dataset.labels.opinion("ann", uuid, Label(100, 0, 0, 1))
    dataset.labels.opinion("bob", uuid, Label(0, 0, 0, 1))
    found = dataset.compare("ann", "bob")
    assert (found.bias_x_mm.mean, found.rms_mm) == pytest.approx((0.1, 0.1))
    assert math.isnan(found.bias_x_mm.deviation)
    assert math.isnan(found.icc_x)


def test_labels_made_blind_are_held_against_those_made_with_the_model_in_sight(
    dataset: Dataset, record: Record
) -> None:
    uuids = [record(1000 * k, 0).uuid for k in range(5)]
    for k, uuid in enumerate(uuids):
        shown = Label(1000 * k, 0, 0, 50)
        dataset.labels.opinion("ann", uuid, shown, context=AnswerContext(2000, blind=False))
        if k < 4:
            blind = Label(1000 * k + SHIFTS_UM[k], 500, 0, 50)
            dataset.labels.opinion("bob", uuid, blind, context=AnswerContext(2000, blind=True))
    found = suggestion_bias(dataset.database, ["ann", "bob"])
    assert found.episodes == 4
    assert found.x_mm.mean == pytest.approx(sum(SHIFTS_UM[:4]) / 4e3)
    assert found.y_mm.mean == pytest.approx(0.5)
    assert suggestion_bias(dataset.database, ["ann"]).episodes == 0
