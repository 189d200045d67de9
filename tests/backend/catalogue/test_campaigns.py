"""Progress of a campaign follows from its episodes."""

from __future__ import annotations

from dataclasses import replace

from tests.backend.catalogue.conftest import context_for, small_episode
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.episode_index import CampaignEntry, list_campaigns
from touchdown.backend.annotations.values import Label


def probe(dataset: Dataset, campaign: str, item: int | None, accepted: bool = True) -> str:
    context = replace(context_for(dataset), campaign=campaign, plan_item=item)
    episode = small_episode(accepted=accepted)
    return dataset.record(episode, Label(1, 1, 0, 1), source="measured", context=context).uuid


def only(dataset: Dataset) -> CampaignEntry:
    (entry,) = list_campaigns(dataset.database)
    return entry


def test_done_counts_items_once_and_neither_rejected_nor_deleted_ones(dataset: Dataset) -> None:
    assert list_campaigns(dataset.database) == []
    first = probe(dataset, "c", 0)
    probe(dataset, "c", 0)
    probe(dataset, "c", 1, accepted=False)
    probe(dataset, "c", 2)
    probe(dataset, "", None)
    entry = only(dataset)
    assert (entry.uuid, entry.piece, entry.bottom) == ("c", "pot", "circle15")
    assert (entry.episodes, entry.done) == (4, 2)
    assert entry.began_ns == dataset.entry(first).recorded_ns < entry.last_ns
    dataset.labels.delete("ann", first, "slip")
    assert only(dataset).done == 2
    for done in dataset.episodes()[2:3]:
        dataset.labels.delete("ann", done.uuid, "slip")
    assert only(dataset).done == 1
    dataset.labels.undo("ann")
    assert only(dataset).done == 2


def test_campaigns_stand_in_the_order_in_which_they_began(dataset: Dataset) -> None:
    for name in ("late", "early", "late"):
        probe(dataset, name, 0)
    assert [entry.uuid for entry in list_campaigns(dataset.database)] == ["late", "early"]
