"""One self-contained page per set of runs: what was felt, believed and done, probe by probe."""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from backend.core.facts import (
    ActionChosen,
    BeliefUpdated,
    EpisodeRecorded,
    Fact,
    FaultRaised,
    RunStarted,
    StabilityJudged,
    TrialFinished,
    TrialStarted,
)
from backend.core.files import write_atomically
from backend.core.flow import FloatArray, Outcome
from backend.experiments.figures import belief_svg, tactile_png, wrench_svg

_STYLE = """
body{font:15px/1.45 'DejaVu Sans',system-ui,sans-serif;color:#1B2127;background:#F2F4F6;margin:2em}
h1{font-size:1.5em}h2{font-size:1.15em;margin:1.6em 0 .3em}
.banner{background:#F9C800;color:#14181C;padding:.35em .8em;display:inline-block;font-weight:600}
.strip{display:flex;gap:14px;flex-wrap:wrap}
.probe{background:#fff;border:1px solid #C9D0D7;padding:10px;width:232px}
.probe p{margin:.4em 0;font-size:.85em}.end{font-weight:600}
.placed{color:#1b6b3a}.other{color:#B3261E}
table{border-collapse:collapse}td,th{text-align:left}
td,th{padding:.2em .9em;border-bottom:1px solid #C9D0D7}
"""

_LEGEND = (
    "Belief maps, 40 mm wide: yellow is support, blue is none, grey is unknown. Double line: hull "
    "of support above 90 %. Cross: centre of mass and planned step. Dashed: the true support, "
    "drawn after the fact. Below: forces of the press, and both tactile images at its end."
)


@dataclass
class _Trial:
    started: TrialStarted
    beliefs: list[BeliefUpdated] = field(default_factory=list)
    judged: list[StabilityJudged] = field(default_factory=list)
    chosen: list[ActionChosen] = field(default_factory=list)
    episodes: dict[int, EpisodeRecorded] = field(default_factory=dict)
    faults: list[FaultRaised] = field(default_factory=list)
    finished: TrialFinished | None = None


def write_report(
    path: Path, runs: Sequence[Iterable[Fact]], outlines_mm: Mapping[str, FloatArray]
) -> None:
    """Write the page atomically.

    ``runs``: the facts of each run in order. ``outlines_mm``: true outline (k, 2) per bottom name,
    drawn dashed after the fact; leave it out where the truth is unknown.
    """
    sections, rows = [], []
    for facts in runs:
        head, trials = _sort(facts)
        if head is None:
            continue
        outline = outlines_mm.get(head.bottom.split("+")[-1])
        for trial in trials:
            sections.append(_section(head, trial, outline if head.simulated else None))
            rows.append(_row(head, trial))
    placed = sum('class="placed"' in row for row in rows)
    body = (
        f"<h1>Touchdown: {placed} of {len(rows)} placed</h1>"
        '<p class="banner">SIMULATED BENCH: no robot moved for these figures</p>'
        f"<p>{_LEGEND}</p>"
        "<table><tr><th>piece</th><th>on</th><th>seed</th><th>outcome</th><th>probes</th>"
        f"<th>true margin</th></tr>{''.join(rows)}</table>{''.join(sections)}"
    )
    page = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f"<title>Touchdown report</title><style>{_STYLE}</style></head><body>{body}</body></html>"
    )
    write_atomically(path, page.encode())


def _sort(facts: Iterable[Fact]) -> tuple[RunStarted | None, list[_Trial]]:
    head: RunStarted | None = None
    trials: list[_Trial] = []
    for fact in facts:
        if isinstance(fact, RunStarted):
            head = fact
        elif isinstance(fact, TrialStarted):
            trials.append(_Trial(fact))
        elif trials:
            _add(trials[-1], fact)
    return head, trials


def _add(trial: _Trial, fact: Fact) -> None:
    if isinstance(fact, BeliefUpdated):
        trial.beliefs.append(fact)
    elif isinstance(fact, StabilityJudged):
        trial.judged.append(fact)
    elif isinstance(fact, ActionChosen):
        trial.chosen.append(fact)
    elif isinstance(fact, EpisodeRecorded):
        trial.episodes[fact.probe] = fact
    elif isinstance(fact, FaultRaised):
        trial.faults.append(fact)
    elif isinstance(fact, TrialFinished):
        trial.finished = fact


def _row(head: RunStarted, trial: _Trial) -> str:
    end = trial.finished
    word = "interrupted" if end is None else end.outcome.value.replace("_", " ")
    css = "placed" if end is not None and end.outcome is Outcome.PLACED else "other"
    margin = "" if end is None or end.margin_mm is None else f"{end.margin_mm:+.2f} mm"
    probes = "" if end is None else str(end.probes)
    cells = (head.piece, head.bottom, str(trial.started.seed))
    plain = "".join(f"<td>{html.escape(cell)}</td>" for cell in cells)
    return f'<tr>{plain}<td class="{css}">{word}</td><td>{probes}</td><td>{margin}</td></tr>'


def _section(head: RunStarted, trial: _Trial, outline_mm: FloatArray | None) -> str:
    title = f"{head.piece} on {head.bottom}, seed {trial.started.seed}"
    panels = []
    for updated, judged, chosen in zip(trial.beliefs, trial.judged, trial.chosen, strict=False):
        recorded = trial.episodes.get(updated.probe)
        signals = "" if recorded is None else tactile_png(recorded.episode)
        traces = "" if recorded is None else wrench_svg(recorded.episode)
        panels.append(
            f'<div class="probe"><b>Probe {updated.probe}</b>'
            f"{belief_svg(updated, judged, chosen, outline_mm)}{traces}{signals}"
            f"<p>{html.escape(chosen.action.reason)}</p></div>"
        )
    faults = "".join(f"<p>{html.escape(f.fault.what)}</p>" for f in trial.faults)
    reason = "Interrupted." if trial.finished is None else trial.finished.reason
    return (
        f'<h2>{html.escape(title)}</h2><div class="strip">{"".join(panels)}</div>{faults}'
        f'<p class="end">{html.escape(reason)}</p>'
    )
