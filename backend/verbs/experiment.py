"""``touchdown experiment``: the paper's tables on the simulated bench, and strategies beyond it."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Table

from backend.core.faults import InputError
from backend.verbs.experiment_asked import ASKED, add_asked_arguments, ask
from backend.verbs.experiment_fused import add_fused_arguments, train_fused
from backend.verbs.experiment_gap import tell_gap
from backend.verbs.experiment_report import (
    add_report_arguments,
    compare,
    tables_to_compare,
    write_anew,
    written_whole,
)
from backend.verbs.screen import Screen
from backend.verbs.train import add_device

if TYPE_CHECKING:
    from backend.experiments.compared import Compared
    from backend.experiments.recipes import Recipe
    from backend.jobs.executor import Executor
    from backend.jobs.spec import JobSpec
    from backend.jobs.store import JobStore

NAME = "experiment"
HELP = "measure the paper's three tables on the simulated bench, or strategies beyond it"
JSON_VERSION = 1
EXECUTORS = ("serial", "local", "dask")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        "what",
        choices=("tables", "report", "beyond", "gap", "fused", *ASKED),
        help="the paper's Tables I to III; their page anew, with other comparisons; strategies "
        "beyond the paper, and the ceiling; the share of the way to it; train the network of "
        "fusion; what exists in a second simulated world; or what each nuisance of the bench "
        "costs",
    )
    scale = parser.add_mutually_exclusive_group()
    scale.add_argument(
        "--quick", dest="scale", action="store_const", const="quick", help="existing models, a few "
        "probes and trials per cell (default)",
    )  # fmt: skip
    scale.add_argument(
        "--full", dest="scale", action="store_const", const="full", help="train as the paper does; "
        "400 places and 100 trials per cell",
    )  # fmt: skip
    parser.set_defaults(scale="quick")
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("output/experiment"),
        metavar="DIR",
        help="page, JSON and jobs; an interrupted experiment goes on there (default: %(default)s)",
    )
    parser.add_argument(
        "--preset", default="bench-v1", help="preset of the bench (default: %(default)s)"
    )
    parser.add_argument("--bench", type=Path, metavar="FILE", help="settings of the bench (TOML)")
    parser.add_argument("--pieces", default="mushroom,barrel,pot", help="separated by commas")
    parser.add_argument(
        "--models", type=Path, metavar="DIR", help="models for --quick (default: those that ship)"
    )
    parser.add_argument(
        "--keep-models", type=Path, metavar="DIR", help="write the models that --full trained, in "
        "half precision",
    )  # fmt: skip
    parser.add_argument(
        "--against", type=Path, metavar="JSON", help="tell which 95 %% intervals miss the values "
        "of another tables.json",
    )  # fmt: skip
    add_device(parser)
    parser.add_argument("--executor", choices=EXECUTORS, default="local", help="default: local")
    parser.add_argument(
        "--workers",
        type=int,
        default=max(1, (os.cpu_count() or 2) - 1),
        help="processes of the local executor (default: %(default)s)",
    )
    parser.add_argument("--cluster", metavar="ADDRESS", help="scheduler of the executor dask")
    parser.add_argument("--shard", metavar="i/n", help="do every n-th job only, for batch queues")
    _add_beyond_arguments(parser)
    add_asked_arguments(parser)
    add_fused_arguments(parser)
    add_report_arguments(parser)


def _add_beyond_arguments(parser: argparse.ArgumentParser) -> None:
    beyond = parser.add_argument_group("beyond")
    beyond.add_argument("--strategies", default="paper,fused", help="or "
                        "zero-wrench, ceiling, ceiling-diameter, pick-and-place "
                        "(default: %(default)s)")  # fmt: skip
    beyond.add_argument("--bottoms", default="short,long", help="or hex20, rect12x28, and towers "
                        "short+long, short+hex20, short+rect12x28 "
                        "(default: %(default)s)")  # fmt: skip
    beyond.add_argument("--trials", type=int, default=50, help="of a cell (default: %(default)s)")
    beyond.add_argument("--statics", type=int, default=0, metavar="GROUPS", help="also ask each "
                        "strategy at so many places of a cell, after 1 to 5 probes")  # fmt: skip
    beyond.add_argument("--entry-sigma", type=float, default=1.0, metavar="MM", help="how well the "
                        "operator knows where the upper bottom of a tower stands "
                        "(default: %(default)s)")  # fmt: skip
    beyond.add_argument("--no-entry", action="store_true", help="nobody tells strategies of the "
                        "lower bottom")  # fmt: skip


def run(args: argparse.Namespace, screen: Screen) -> int:
    """Do all jobs that are not done, then write the page; 0 when no job failed."""
    if args.workers < 1:
        raise InputError("--workers must be at least 1.", "--workers", "Give a positive number.")
    if args.what in ("report", "gap"):
        way = write_anew if args.what == "report" else tell_gap
        screen.result({"version": JSON_VERSION, **way(args, screen)})
        return 0
    other = tables_to_compare(args.against)
    # Imported here so that `touchdown --help` starts without torch.
    from backend.experiments.writing import write_tables
    from backend.jobs.store import JobStore

    store = JobStore(_folder(args.out) / "jobs")
    if args.what == "beyond":
        return _run_beyond(args, screen, store)
    if args.what in ("fused", *ASKED):
        asked = train_fused if args.what == "fused" else ask
        answer = asked(args, screen, store, lambda j, e: _done(j, e, args, screen, store))
        screen.result({"version": JSON_VERSION, **answer})
        return 1 if answer["failed"] else 0
    recipe = _recipe(args, store)
    jobs = recipe.jobs()
    failed = _done(jobs, recipe.effort, args, screen, store)
    missing = sum(not store.has(spec.id) for spec in jobs)
    with written_whole(args.out):
        page, answer = write_tables(args.out, recipe, store)
    if args.keep_models:
        _keep(args, recipe, store, screen)
    screen.say(f"{len(jobs) - missing} of {len(jobs)} jobs are done: {page}")
    if other is not None:
        compare(answer, other, args.against, screen)
    screen.result(
        {
            "version": JSON_VERSION,
            "page": str(page),
            "jobs": len(jobs),
            "missing": missing,
            "failed": failed,
            "tables": answer,
        }
    )
    return 1 if failed else 0


def _keep(args: argparse.Namespace, recipe: Recipe, store: JobStore, screen: Screen) -> None:
    from backend.experiments.given_models import keep_models

    with written_whole(args.keep_models):
        args.keep_models.mkdir(parents=True, exist_ok=True)
        kept = keep_models(store, recipe, args.keep_models)
    screen.say(f"{len(kept)} models: {args.keep_models}")


def _done(
    jobs: list[JobSpec],
    effort_of: Callable[[JobSpec], int],
    args: argparse.Namespace,
    screen: Screen,
    store: JobStore,
) -> list[str]:
    """Do what is not done of all jobs, or of one shard; return the ids of those that failed."""
    from backend.jobs.campaign import parse_shard, run_campaign, shard_of, startable

    part = jobs
    if args.shard:
        part = startable(jobs, shard_of(jobs, *parse_shard(args.shard)), store)
    else:
        store.sweep()
    effort = sum(map(effort_of, part))
    failed: list[str] = []
    done = 0
    with screen.progress(f"{len(part)} jobs", effort) as advance:
        by_id = {spec.id: spec for spec in part}
        for result in run_campaign(part, _executor(args, store, screen.say), store):
            done += effort_of(by_id[result.id])
            advance(done, _name(by_id[result.id]))
            if result.state == "failed":
                failed.append(result.id)
                screen.say(f"{_name(by_id[result.id])} failed: {result.error.strip()}")
    return failed


def _run_beyond(args: argparse.Namespace, screen: Screen, store: JobStore) -> int:
    """Compare strategies; writes ``beyond.json`` with all that is finished by now."""
    from backend.experiments.compared import sheets
    from backend.experiments.writing import write_beyond

    plan = _beyond(args, store)
    jobs = plan.jobs()
    failed = _done(jobs, plan.effort, args, screen, store)
    answer = plan.answer(store)
    missing = sum(not store.has(spec.id) for spec in jobs)
    with written_whole(args.out):
        path = write_beyond(args.out, answer)
    for sheet in sheets(answer):
        table = Table(title=sheet.title)
        for column in sheet.columns:
            table.add_column(column)
        for row in sheet.rows:
            table.add_row(*row)
        screen.show(table)
    screen.result({"version": JSON_VERSION, "file": str(path), "jobs": len(jobs),
                   "missing": missing, "failed": failed, "beyond": answer})  # fmt: skip
    return 1 if failed else 0


def _beyond(args: argparse.Namespace, store: JobStore) -> Compared:
    from backend.config.simulation import load_simulation
    from backend.experiments.beyond import BOTTOMS, STRATEGIES, Beyond
    from backend.experiments.compared import Compared
    from backend.experiments.given_models import adopt_models, models_that_ship
    from backend.experiments.promises import Promises
    from backend.experiments.recipes import PIECES
    from backend.experiments.writing import program_version

    pieces = _named(args.pieces, PIECES, "--pieces")
    bench = load_simulation(args.bench, None if args.bench else args.preset)
    folders = [args.models] if args.models else models_that_ship(bench.preset)
    found = adopt_models(store, *folders)
    if args.trials < (0 if args.statics else 1):
        raise InputError("--trials must be at least 1.", "--trials", "Give a positive number.")
    if args.statics < 0:
        raise InputError("--statics is negative.", "--statics", "Give 0 or a positive number.")
    if not args.entry_sigma > 0.0:
        raise InputError("--entry-sigma must be positive.", "--entry-sigma", "Give it in mm.")
    loops = Beyond(
        bench=bench,
        code=program_version(),
        models={piece: found[piece, "FT+Tac"] for piece in pieces},
        pieces=pieces,
        bottoms=_named(args.bottoms, BOTTOMS, "--bottoms"),
        strategies=_named(args.strategies, STRATEGIES, "--strategies"),
        trials=args.trials,
        entry_sigma_mm=None if args.no_entry else args.entry_sigma,
    )
    said = None
    if args.statics:
        said = Promises(
            bench, loops.code, loops.models, pieces, loops.bottoms, loops.strategies, args.statics
        )
    return Compared(loops, said)


def _named(text: str, known: tuple[str, ...], where: str) -> tuple[str, ...]:
    """Return the names in a text with commas; raises ``InputError`` for one that is not known."""
    names = tuple(text.split(","))
    if unknown := [name for name in names if name not in known]:
        raise InputError(f"'{unknown[0]}' is not known.", where, f"Name some of {','.join(known)}.")
    return names


def _recipe(args: argparse.Namespace, store: JobStore) -> Recipe:
    from backend.config.simulation import load_simulation
    from backend.experiments.given_models import adopt_models, models_that_ship
    from backend.experiments.recipes import SCALES, Recipe
    from backend.experiments.tables import pieces_of
    from backend.experiments.writing import program_version

    pieces = pieces_of(args.pieces)
    if not pieces or len(pieces) != len(args.pieces.split(",")):
        raise InputError(
            f"'{args.pieces}' names other pieces than those of the tables.",
            "--pieces",
            "Name some of mushroom,barrel,pot.",
        )
    scale = SCALES[args.scale]
    if args.keep_models and not scale.probes:
        raise InputError("--quick trains no models.", "--keep-models", "Leave it out, or --full.")
    if args.models and scale.probes:
        raise InputError("--full trains its own models.", "--models", "Leave it out, or --quick.")
    bench = load_simulation(args.bench, None if args.bench else args.preset)
    models = {}
    if not scale.probes:
        folders = [args.models] if args.models else models_that_ship(bench.preset)
        models = adopt_models(store, *folders)
    return Recipe(scale, bench, program_version(), models, pieces, args.device)


def _executor(args: argparse.Namespace, store: JobStore, tell: Callable[[str], None]) -> Executor:
    from backend.experiments.kinds import KINDS
    from backend.jobs.cluster import DaskCluster
    from backend.jobs.executor import LocalPool, Serial

    if args.executor == "serial":
        return Serial(KINDS, store)
    if args.executor == "local":
        return LocalPool(KINDS, store, args.workers, tell)
    if not args.cluster:
        raise InputError("The executor dask needs a scheduler.", "--cluster", "Give its address.")
    return DaskCluster.at(KINDS, store, args.cluster)


def _folder(out: Path) -> Path:
    try:
        (out / "jobs").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"The folder cannot be made: {error.strerror or error}.",
            str(out),
            "Name another folder.",
        ) from error
    return out


def _name(spec: JobSpec) -> str:
    """Say in words which job this is."""
    p = spec.params
    over = "+".join(p["bottoms"]) if "bottoms" in p else p.get("bottom", "")
    training = p.get("training", {}).get("modality", "")
    words = (spec.kind, p.get("piece", ""), over, training, p.get("strategy", ""))
    return " ".join(word for word in words if word)
