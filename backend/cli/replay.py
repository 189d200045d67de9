"""``touchdown replay``: replay a recorded run as text."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from rich.table import Table

from touchdown.backend.cli.output import VerbOutput, text_table
from touchdown.backend.cli.stack import narrate, trial_table
from touchdown.backend.core import (
    CampaignBegan,
    InputError,
    ProbeCollected,
    RunFinished,
    RunStarted,
    TrialFinished,
    data_folder,
)
from touchdown.backend.runs import EVENT_LOG_NAME, read_events


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("run", metavar="RUN", help="folder of a run, its name, or 'latest'")
    parser.add_argument("--runs", metavar="DIR", help="folder for runs (default: data folder)")


def find_run(name: str, runs: Path) -> Path:
    """Return the run folder for a path, a run name or ``latest``; raises ``InputError``."""
    if Path(name).exists():
        return Path(name)
    if name == "latest":
        found = sorted(folder for folder in runs.glob("*") if (folder / EVENT_LOG_NAME).is_file())
        if found:
            return found[-1]
        raise InputError("There are no runs.", str(runs), "Start one with `touchdown stack`.")
    if (runs / name).is_dir():
        return runs / name
    raise InputError("There is no such run.", name, f"Name a folder, or one of those in {runs}.")


def run(args: argparse.Namespace, screen: VerbOutput) -> int:
    """Replay; return 0 if the log could be read to its end."""
    runs = Path(args.runs) if args.runs else data_folder() / "runs"
    folder = find_run(args.run, runs)
    trials: list[TrialFinished] = []
    counts: Counter[str] = Counter()
    head: RunStarted | None = None
    ending: RunFinished | None = None
    campaign: CampaignBegan | None = None
    probes: list[ProbeCollected] = []
    for fact in read_events(folder):
        counts[type(fact).__name__] += 1
        head = fact if isinstance(fact, RunStarted) else head
        ending = fact if isinstance(fact, RunFinished) else ending
        if isinstance(fact, TrialFinished):
            trials.append(fact)
        elif isinstance(fact, CampaignBegan):
            campaign = fact
        elif isinstance(fact, ProbeCollected):
            probes.append(fact)
        narrate(fact, screen)
    if not counts:
        raise InputError("This event log has no events.", str(folder), "Name another run.")
    if head is None or head.activity == "stack" or trials:
        screen.show(trial_table(trials))
    elif head.activity == "collect":
        screen.show(_probe_table(campaign, probes))
    else:
        screen.say(f"This run is of the kind '{head.activity}': it has no trials.")
    if ending is None:
        screen.say("The journal is incomplete: the program was interrupted.")
    screen.result({
        "run": str(folder),
        **{name: getattr(head, name, None) for name in ("activity", "piece", "bottom")},
        "ending": "interrupted" if ending is None else ending.ending,
        "facts": counts,
        "trials": [
            {"seed": t.seed, "outcome": t.outcome.value, "reason": t.reason, "probes": t.probes}
            for t in trials
        ],
        "probes": [
            {"episode": p.uuid, "item": p.item, "measured_mm": p.measured_mm, "reasons": p.reasons}
            for p in probes
        ],
    })  # fmt: skip
    return 0


def _probe_table(campaign: CampaignBegan | None, probes: Sequence[ProbeCollected]) -> Table:
    """Return the probes of a collection: displacements, uncertainty, and why it is excluded."""
    rows = [
        (
            str(p.item),
            *(f"{x:+.2f}, {y:+.2f}" for x, y in (p.commanded_mm, p.measured_mm)),
            f"{p.sigma_mm:.2f}",
            p.reasons,
        )
        for p in probes
    ]
    title = f"Collection: {len(probes)} probes"
    if campaign is not None:
        done = probes[-1].done if probes else campaign.done
        title += f", {done} of {campaign.total} of campaign {campaign.campaign}"
        title += f", in {campaign.dataset}"
    header = ("item", "commanded mm", "measured mm", "sigma mm", "not an observation because")
    return text_table(title, header, *rows, right=("item", "sigma mm"))
