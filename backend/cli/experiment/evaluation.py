"""``touchdown experiment elsewhere``: existing models in the second world."""

from __future__ import annotations

import argparse

from touchdown.backend import experiments
from touchdown.backend.cli.experiment.campaign import (
    ExperimentRun,
    Json,
    parse_names,
    parse_strategies,
    write_json,
)
from touchdown.backend.cli.output import require_positive
from touchdown.backend.core import InputError, package_version


def add_evaluation_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``elsewhere``."""
    asked = parser.add_argument_group("elsewhere")
    asked.add_argument("--groups", type=int, default=20, help="of three probes, in each cell")
    asked.add_argument("--gel", choices=("half-space", "finite-elements"), default="half-space",
                       help="of the second world")  # fmt: skip
    asked.add_argument("--first", type=int, default=0, metavar="N", help="number of the first "
                       "group and trial in each cell; tune on others than reported")  # fmt: skip


def run_evaluation(run: ExperimentRun) -> Json:
    """Run ``elsewhere`` and write its file.

    Raises ``InputError`` for counts without work, for unknown names, and if the second world lacks
    its engine.
    """
    from touchdown.backend.simulation import import_mujoco
    from touchdown.backend.simulation.second_world import import_skfem

    args, bench, code = run.args, run.bench(), package_version("touchdown")
    if min(args.groups, args.trials) < 0 or args.groups + args.trials == 0:
        raise InputError(
            "The counts give no presses.", "--groups, --trials", "Give a positive number of one."
        )
    (piece, *others) = parse_names(args.pieces, experiments.PIECES, "--pieces")
    if others:
        raise InputError("Only one piece is evaluated.", "--pieces", "Name one piece.")
    bottoms = parse_names(args.bottoms, experiments.TABLE_BOTTOMS, "--bottoms")
    strategies = parse_strategies(args.strategies, experiments.EVALUATED_STRATEGIES)
    found = run.models(bench)
    import_mujoco()
    there = "elsewhere"
    if args.gel != "half-space":
        import_skfem()
        there = f"elsewhere-{args.gel}"
    require_positive(args, "first", least=0)
    plan = experiments.DomainShift(
        bench=bench,
        code=code,
        piece=piece,
        models={n: found[piece, n] for n in ("FT+Tac", "FT") if (piece, n) in found},
        bottoms=bottoms,
        strategies=strategies,
        groups=args.groups,
        trials=args.trials,
        first=args.first,
        there=there,
    )
    run.run(plan.jobs())
    answer = plan.answer(run.store)
    for table in experiments.shift_tables(answer):
        run.screen.table(table.title, *table.texts())
    path = args.out / "elsewhere.json"
    write_json(path, answer)
    return {"file": str(path), **run.counts(), "elsewhere": answer}
