"""``touchdown experiment fused``: simulate sequences of probes, train the network of fusion."""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from backend.core.faults import InputError
from backend.verbs.screen import Screen

if TYPE_CHECKING:
    from backend.jobs.spec import JobSpec
    from backend.jobs.store import JobStore

Done = Callable[[list["JobSpec"], Callable[["JobSpec"], int]], list[str]]
"""Does the jobs that are not done, given the effort of each; returns the ids of the failed."""


def add_fused_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    fused = parser.add_argument_group("fused")
    fused.add_argument("--parts", type=int, default=60, help="jobs of 240 sequences of probes "
                       "(default: %(default)s)")  # fmt: skip
    fused.add_argument("--steps", type=int, default=6000, help="of the training (default: "
                       "%(default)s)")  # fmt: skip
    fused.add_argument("--seed", type=int, default=0, help="of data and training (default: "
                       "%(default)s)")  # fmt: skip


def train_fused(
    args: argparse.Namespace, screen: Screen, store: JobStore, done: Done
) -> dict[str, Any]:
    """Make the network; copies it with its card to the folder of the experiment when it is there.

    Raises ``InputError`` for counts with which nothing can be held out or trained.
    """
    # Imported here so that `touchdown --help` starts without torch.
    from backend.config.simulation import load_simulation
    from backend.experiments.fused import WEIGHTS, FusedRecipe
    from backend.experiments.writing import program_version
    from backend.learning.checkpoint import card_path

    if not 2 <= args.parts <= 120 or args.steps < 1 or args.seed < 0:
        raise InputError(
            "The number of parts or steps is out of range, or the seed is negative.",
            "--parts, --steps, --seed",
            "Give 2 to 120 parts, at least 1 step and seed 0.",
        )
    bench = load_simulation(args.bench, None if args.bench else args.preset)
    recipe = FusedRecipe(bench, program_version(), args.parts, args.steps, args.seed)
    jobs = recipe.jobs()
    failed = done(jobs, recipe.effort)
    training = jobs[-1].id
    made = store.has(training)
    out = args.out / WEIGHTS
    if made:
        weights = store.folder(training) / WEIGHTS
        shutil.copyfile(card_path(weights), card_path(out))
        shutil.copyfile(weights, out)
        screen.say(f"The network lies in {out}.")
    missing = sum(not store.has(spec.id) for spec in jobs)
    return {
        "file": str(out) if made else None,
        "jobs": len(jobs),
        "missing": missing,
        "failed": failed,
        "fused": store.result(training) if made else None,
    }
