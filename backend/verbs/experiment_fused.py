"""``touchdown experiment fused``: simulate sequences of probes, train the network of fusion."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rich.table import Table

from backend.core.faults import InputError
from backend.core.files import write_atomically
from backend.verbs.screen import Screen

if TYPE_CHECKING:
    from backend.jobs.spec import JobSpec
    from backend.jobs.store import JobStore

ABLATIONS = ("wrench", "fields", "others", "mirrors")
Done = Callable[[list["JobSpec"], Callable[["JobSpec"], int]], list[str]]
"""Does the jobs that are not done, given the effort of each; returns the ids of the failed."""


def add_fused_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    fused = parser.add_argument_group("fused")
    fused.add_argument("--parts", type=int, default=100, help="jobs of 240 sequences of five "
                       "probes (default: %(default)s)")  # fmt: skip
    fused.add_argument("--long-parts", type=int, default=0, help="of eight probes (default: "
                       "%(default)s)")  # fmt: skip
    fused.add_argument("--free-parts", type=int, default=0, help="of eight probes on bottoms that "
                       "rock and slide (default: %(default)s)")  # fmt: skip
    fused.add_argument("--steps", type=int, default=6000, help="of the training (default: "
                       "%(default)s)")  # fmt: skip
    fused.add_argument("--seed", type=int, default=0, help="of data and training (default: "
                       "%(default)s)")  # fmt: skip
    fused.add_argument("--without", choices=ABLATIONS, help="an ablation: the wrench, the marker "
                       "fields, the other probes, or mirror images of the data")  # fmt: skip
    fused.add_argument("--rule-trials", type=int, default=0, help="trials of each piece on each of "
                       "four bottoms of their own, under every rule of release "
                       "(default: %(default)s)")  # fmt: skip


def train_fused(
    args: argparse.Namespace, screen: Screen, store: JobStore, done: Done
) -> dict[str, Any]:
    """Make the network; copies it with its card to the folder of the experiment when it is there.

    Raises ``InputError`` for counts with which nothing can be held out or trained.
    """
    # Imported here so that `touchdown --help` starts without torch.
    from backend.config.simulation import load_simulation
    from backend.experiments.fused import PORTIONS, FusedRecipe
    from backend.experiments.fused_rules import WEIGHTS, rule_jobs
    from backend.experiments.writing import program_version
    from backend.learning.checkpoint import card_path

    half = args.parts // 2
    counts = {"short": args.parts - half, "more": half}
    counts |= {"free": args.free_parts, "long": args.long_parts}
    known = all(n == 0 or 2 <= n <= PORTIONS[name].most for name, n in counts.items())
    if not known or args.parts < 4 or args.steps < 1 or min(args.seed, args.rule_trials) < 0:
        raise InputError(
            "The number of parts, steps or trials is out of range, or the seed is negative.",
            "--parts, --long-parts, --free-parts, --steps, --rule-trials, --seed",
            "Give 4 to 120 parts, none or 2 to 400 long and 2 to 100 free ones, at least 1 step.",
        )
    bench = load_simulation(args.bench, None if args.bench else args.preset)
    code = program_version()
    recipe = FusedRecipe(bench, code, counts, args.steps, args.seed, args.without, args.device)
    jobs = recipe.jobs()
    training = jobs[-1].id
    asked = rule_jobs(bench, code, training, args.rule_trials)
    failed = done([*jobs, *asked], recipe.effort)
    made = store.has(training)
    out = args.out / WEIGHTS
    if made:
        weights = store.folder(training) / WEIGHTS
        for made_there, wanted in ((card_path(weights), card_path(out)), (weights, out)):
            write_atomically(wanted, made_there.read_bytes())
        screen.say(f"The network lies in {out}.")
    missing = sum(not store.has(spec.id) for spec in [*jobs, *asked])
    return {
        "file": str(out) if made else None,
        "jobs": len(jobs) + len(asked),
        "missing": missing,
        "failed": failed,
        "fused": store.result(training) if made else None,
        "rules": _rules(screen, store, asked),
    }


def _rules(screen: Screen, store: JobStore, asked: list[JobSpec]) -> list[dict[str, Any]]:
    """Show and return what would have come of the finished trials under every rule."""
    from backend.experiments.fused_rules import rules

    trials = [t for spec in asked if store.has(spec.id) for t in store.result(spec.id)["trials"]]
    if not trials:
        return []
    found = rules(trials)
    table = Table(title=f"Rules of release, {len(trials)} trials on bottoms of their own")
    for column in found[0]:
        table.add_column(column)
    for row in found:
        table.add_row(*(str(value) for value in row.values()))
    screen.show(table)
    return found
