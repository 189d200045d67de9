"""Recorded campaign, as shown in review."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from touchdown.backend import core
from touchdown.widgets.base import count_noun, tr
from touchdown.widgets.views import offset_text


@dataclass(slots=True)
class CollectedRun:
    """A recorded collecting run. ``probes`` in order of recording; ``decided`` by episode."""

    head: core.RunStarted
    begun: core.CampaignBegan | None = None
    probes: list[core.ProbeCollected] = field(default_factory=list)
    decided: dict[str, core.EpisodeDecided] = field(default_factory=dict)
    grips: set[tuple[int, int]] = field(default_factory=set)
    told: list[str] = field(default_factory=list)
    ended: core.RunFinished | None = None

    @property
    def headline(self) -> str:
        """Number of probes taken and planned."""
        if self.begun is None:
            return tr("Nothing was collected")
        done = self.probes[-1].done if self.probes else self.begun.done
        return tr("{} of {} probes", done, self.begun.total)

    def lines(self) -> list[str]:
        """Return one line per probe."""
        return [f"{n}.  {self._probe_words(probe)}" for n, probe in enumerate(self.probes, start=1)]

    def facts(self) -> str:
        """Return plan, person and progress, one line each."""
        head, plan = self.head, _request(self.head)
        mountings = len({mounting for mounting, _ in self.grips})
        lines = [
            tr("{} on {}", head.piece, head.bottom),
            tr(
                "plan: {}, {} probes, seed {}", tr(head.strategy), plan.get("count", "?"), head.seed
            ),
            tr("collected by {}", plan.get("person") or tr("nobody named")),
            tr("{} in this run, {}", count_noun(len(self.probes), "probe"), self._decisions()),
            tr("{} on {}", count_noun(len(self.grips), "grip"), count_noun(mountings, "mounting")),
            _ending(self.ended),
        ]
        return "\n".join(lines)

    def _probe_words(self, probe: core.ProbeCollected) -> str:
        decided = self.decided.get(probe.uuid)
        word = "refused" if probe.reasons else "kept" if decided is None else decided.decision
        return f"{tr(word)}, {offset_text(probe.measured_mm)}"

    def _decisions(self) -> str:
        refused = sum(bool(probe.reasons) for probe in self.probes)
        said = Counter(one.decision for one in self.decided.values())
        parts = [tr("{} refused", refused), *(f"{n} {tr(word)}" for word, n in said.most_common())]
        return ", ".join(parts)


def collected_run(facts: Iterable[core.Event]) -> CollectedRun | None:
    """Return the collecting run described by the events, None for another kind of run."""
    found: CollectedRun | None = None
    for event in facts:
        if isinstance(event, core.RunStarted):
            found = CollectedRun(event) if event.activity == "collect" else None
        elif found is not None:
            _add_event(found, event)
    return found


def _add_event(found: CollectedRun, event: core.Event) -> None:
    if isinstance(event, core.CampaignBegan):
        found.begun = found.begun or event
    elif isinstance(event, core.ProbeCollected):
        found.probes.append(event)
    elif isinstance(event, core.EpisodeDecided):
        found.decided[event.uuid] = event
    elif isinstance(event, core.Gripped):
        found.grips.add((event.mounting, event.grip))
    elif isinstance(event, core.RunFinished):
        found.ended = event
    if text := event_text(event):
        found.told.append(text)


def event_text(event: core.Event) -> str:
    """Return an event of a collecting run as text, "" for other events."""
    if isinstance(event, core.Said | core.Refused):
        return event.text
    if isinstance(event, core.FaultRaised):
        return f"{event.fault.what} {event.fault.next_step}"
    if isinstance(event, core.Gripped):
        return tr("Grip {} of mounting {}, {:.1f} g held", event.grip, event.mounting, event.mass_g)
    if isinstance(event, core.OriginChecked):
        agrees, differs = "The origin agrees: off by {}", "The origin does not agree: off by {}"
        off = offset_text(event.residual_mm, event.sigma_mm)
        return tr(agrees if event.agrees else differs, off)
    if isinstance(event, core.EpisodeDecided):
        person = event.person or tr("nobody named")
        return tr("{}: {}, item {}", person, tr(event.decision), event.item)
    if isinstance(event, core.CampaignBegan):
        return tr("The campaign goes on at {} of {} probes", event.done, event.total)
    if isinstance(event, core.ProbeCollected):
        said = tr("Probe {} of {}", event.done, event.total)
        return f"{said}: {tr('refused')}, {event.reasons}" if event.reasons else said
    return _ending(event) if isinstance(event, core.RunFinished) else ""


def _ending(ended: core.RunFinished | None) -> str:
    if ended is None:
        return tr("The journal ends before the run did.")
    return tr("Run {}.", tr(ended.ending)) + (f" {ended.reason}" if ended.reason else "")


def _request(head: core.RunStarted) -> dict[str, Any]:
    """Return the request of the run; empty if the log does not contain it."""
    try:
        request = core.parse_json(head.settings).get("request", {})
    except (ValueError, AttributeError):
        return {}
    return request if isinstance(request, dict) else {}
