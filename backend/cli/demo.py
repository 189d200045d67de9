"""``touchdown demo``: stack three pieces headless and write a report."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from touchdown.backend.cli.output import VerbOutput
from touchdown.backend.cli.stack import narrate, trial_table
from touchdown.backend.core import EpisodeRecorded, Event, Outcome, TrialFinished
from touchdown.backend.runs import StackRequest

SHOWN = (("pot", "short"), ("barrel", "long"), ("mushroom", "short"))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", default="output/demo", metavar="DIR", help="folder of the report")


def run(args: argparse.Namespace, screen: VerbOutput) -> int:
    """Stack pot, barrel and mushroom; return 0 if all three were placed."""
    # Imported here so that `touchdown doctor` starts without torch.
    from touchdown.backend.bench import SimulatedBenchChoice, simulated_session
    from touchdown.backend.experiments import write_run_report
    from touchdown.backend.runs import RecordingOptions

    out = Path(args.out)
    runs: list[list[Event]] = []
    session = simulated_session(
        SimulatedBenchChoice(), keep=RecordingOptions(out / "runs"), animate=True
    )
    session.events.subscribe(lambda fact: runs[-1].append(_with_signals(fact, session.run_folder)))
    session.events.subscribe(lambda fact: narrate(fact, screen))
    try:
        for piece, bottom in SHOWN:
            runs.append([])
            screen.say(f"{piece} on {bottom}")
            session.run(StackRequest(piece=piece, bottoms=(bottom,), seed=args.seed))
    finally:
        session.close()
    outlines = {b: session.catalogue.piece(b).face.path() for _, b in SHOWN}
    report = out / "report.html"
    write_run_report(report, runs, outlines)
    ended = [
        (piece, fact)
        for (piece, _), facts in zip(SHOWN, runs, strict=True)
        for fact in facts
        if isinstance(fact, TrialFinished)
    ]
    ends = [end for _, end in ended]
    screen.show(trial_table(ends, [piece for piece, _ in ended]))
    screen.say(f"Report: {report}")
    screen.say(f"Replay: touchdown replay latest --runs {out / 'runs'}")
    placed = sum(end.outcome is Outcome.PLACED for end in ends)
    screen.result({"placed": placed, "trials": len(SHOWN), "report": str(report)})
    return 0 if placed == len(SHOWN) else 1


def _with_signals(fact: Event, folder: Path | None) -> Event:
    from touchdown.backend.episodes import read_episode

    if not isinstance(fact, EpisodeRecorded) or folder is None or not fact.path:
        return fact
    return replace(fact, episode=read_episode(folder / "episodes" / fact.path))
