"""With which mounting a campaign goes on after a restart: only its operator knows.

Splits and comparisons go by mounting. One that is counted anew though nothing was fitted tells a
model that it was tried on another mounting than it learned on.
"""

from __future__ import annotations

from dataclasses import dataclass

from backend.catalogue.dataset import Dataset
from backend.catalogue.values import EpisodeFilter
from backend.core.facts import MountingAwaited, Said
from backend.runs import words
from backend.runs.bench import Bench
from backend.runs.campaign import Campaign
from backend.runs.plan import Plan, Waiting

OPERATOR_S = 24 * 3600.0


@dataclass(frozen=True, slots=True)
class Mounting:
    """What a mounting that ``goes_on`` holds so far: ``series`` ("" for none), and ``grips``."""

    goes_on: bool = False
    series: str = ""
    grips: int = 0


NEW = Mounting()


def mounting_id(campaign: Campaign) -> str:
    """Return the id of the mounting that was begun last."""
    return f"{campaign.uuid}/mounting-{campaign.mountings}"


def mounting_to_go_on(bench: Bench, dataset: Dataset, campaign: Campaign) -> Plan[Mounting]:
    """Ask whether bottom or gels were fitted anew; return the last mounting if not, else ``NEW``.

    Nothing moves meanwhile.
    """
    bench.gate.ask()
    yield MountingAwaited(bench.now_s(), bench.bottom, campaign.mountings)
    yield Waiting(lambda: bench.gate.answered, OPERATOR_S, "word on the mounting")
    if bench.gate.yes:
        return NEW
    found = _last(dataset, campaign)
    yield Said(bench.now_s(), words.same_mounting(campaign.mountings, found.grips))
    return found


def _last(dataset: Dataset, campaign: Campaign) -> Mounting:
    """Return what the dataset holds of the last mounting, discarded probes as well."""
    wanted, series, grips = mounting_id(campaign), "", 0
    for entry in dataset.episodes(EpisodeFilter(campaign=campaign.uuid, deleted=None)):
        if entry.mounting_id == wanted:
            series = entry.series
            grips = max(grips, int(entry.grip_id.rpartition("-")[2]))
    return Mounting(True, series, grips)
