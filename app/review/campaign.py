"""Recorded campaign, as shown in review."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from touchdown.backend.core import (
    CampaignBegan,
    EpisodeDecided,
    Event,
    FaultRaised,
    Gripped,
    OriginChecked,
    ProbeCollected,
    Refused,
    RunFinished,
    RunStarted,
    Said,
)
from touchdown.widgets.views import offset_text


@dataclass(slots=True)
class CollectedRun:
    """``probes`` in the order in which they were taken; ``decided`` by episode."""

    head: RunStarted
    begun: CampaignBegan | None = None
    probes: list[ProbeCollected] = field(default_factory=list)
    decided: dict[str, EpisodeDecided] = field(default_factory=dict)
    grips: set[tuple[int, int]] = field(default_factory=set)
    told: list[str] = field(default_factory=list)
    ended: RunFinished | None = None

    @property
    def headline(self) -> str:
        """How many of the planned probes there were at the end."""
        if self.begun is None:
            return "Nothing was collected"
        done = self.probes[-1].done if self.probes else self.begun.done
        return f"{done} of {self.begun.total} probes"

    def lines(self) -> list[str]:
        """Return one line a probe."""
        return [f"{n}.  {self._probe_words(probe)}" for n, probe in enumerate(self.probes, start=1)]

    def facts(self) -> str:
        """Return plan, person and progress, a line each."""
        head, plan = self.head, _request(self.head)
        mountings = len({mounting for mounting, _ in self.grips})
        lines = [
            f"{head.piece} on {head.bottom}",
            f"plan: {head.strategy}, {plan.get('count', '?')} probes, seed {head.seed}",
            f"collected by {plan.get('person') or 'nobody named'}",
            f"{_count_noun(len(self.probes), 'probe')} in this run, {self._decisions()}",
            f"{_count_noun(len(self.grips), 'grip')} on {_count_noun(mountings, 'mounting')}",
            _ending(self.ended),
        ]
        return "\n".join(lines)

    def _probe_words(self, probe: ProbeCollected) -> str:
        decided = self.decided.get(probe.uuid)
        word = "refused" if probe.reasons else "kept" if decided is None else decided.decision
        return f"{word}, {offset_text(probe.measured_mm)}"

    def _decisions(self) -> str:
        refused = sum(bool(probe.reasons) for probe in self.probes)
        said = Counter(one.decision for one in self.decided.values())
        parts = [f"{refused} refused", *(f"{n} {word}" for word, n in said.most_common())]
        return ", ".join(parts)


def collected_run(facts: Iterable[Event]) -> CollectedRun | None:
    """Return the collection that ``facts`` tell of; None for a run of another kind."""
    found: CollectedRun | None = None
    for fact in facts:
        if isinstance(fact, RunStarted):
            found = CollectedRun(fact) if fact.activity == "collect" else None
        elif found is not None:
            _add_event(found, fact)
    return found


def _add_event(found: CollectedRun, fact: Event) -> None:
    if isinstance(fact, CampaignBegan):
        found.begun = found.begun or fact
    elif isinstance(fact, ProbeCollected):
        found.probes.append(fact)
    elif isinstance(fact, EpisodeDecided):
        found.decided[fact.uuid] = fact
    elif isinstance(fact, Gripped):
        found.grips.add((fact.mounting, fact.grip))
    elif isinstance(fact, RunFinished):
        found.ended = fact
    if text := event_text(fact):
        found.told.append(text)


def event_text(fact: Event) -> str:
    """Return what a fact of a collection says in words, "" for one that says nothing."""
    if isinstance(fact, Said | Refused):
        return fact.text
    if isinstance(fact, FaultRaised):
        return f"{fact.fault.what} {fact.fault.next_step}"
    if isinstance(fact, Gripped):
        return f"Grip {fact.grip} of mounting {fact.mounting}, {fact.mass_g:.1f} g held"
    if isinstance(fact, OriginChecked):
        agrees = "agrees" if fact.agrees else "does not agree"
        return f"The origin {agrees}: off by {offset_text(fact.residual_mm, fact.sigma_mm)}"
    if isinstance(fact, EpisodeDecided):
        return f"{fact.person or 'nobody named'}: {fact.decision}, item {fact.item}"
    return _progress(fact)


def _progress(fact: Event) -> str:
    if isinstance(fact, CampaignBegan):
        return f"The campaign goes on at {fact.done} of {fact.total} probes"
    if isinstance(fact, ProbeCollected):
        why = f": refused, {fact.reasons}" if fact.reasons else ""
        return f"Probe {fact.done} of {fact.total}{why}"
    if isinstance(fact, RunFinished):
        return _ending(fact)
    return ""


def _ending(ended: RunFinished | None) -> str:
    if ended is None:
        return "The journal ends before the run did."
    return f"Run {ended.ending}." + (f" {ended.reason}" if ended.reason else "")


def _request(head: RunStarted) -> dict[str, Any]:
    """Return what was asked for; nothing of a journal that does not say."""
    try:
        request = json.loads(head.settings).get("request", {})
    except (ValueError, AttributeError):
        return {}
    return request if isinstance(request, dict) else {}


def _count_noun(count: int, noun: str) -> str:
    return f"1 {noun}" if count == 1 else f"{count} {noun}s"


def count_text(words: Sequence[str]) -> str:
    """Return how often there is each word, the commonest first."""
    return ", ".join(f"{count} {word}" for word, count in Counter(words).most_common())
