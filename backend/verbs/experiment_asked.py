"""``touchdown experiment elsewhere`` and ``sensitivity``: what exists, asked on other benches."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from rich.table import Table

from backend.core.faults import InputError
from backend.verbs.screen import Screen

if TYPE_CHECKING:
    from backend.config.simulation import SimulationSettings
    from backend.jobs.spec import JobSpec
    from backend.jobs.store import JobStore

ASKED = ("elsewhere", "sensitivity")
Done: TypeAlias = Callable[[list["JobSpec"], Callable[["JobSpec"], int]], list[str]]
"""Does the jobs that are not done, given the effort of each; returns the ids of the failed."""
Json: TypeAlias = dict[str, Any]


def add_asked_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    asked = parser.add_argument_group("elsewhere, sensitivity")
    asked.add_argument("--groups", type=int, default=20, help="of three probes, in each cell "
                       "(default: %(default)s)")  # fmt: skip


def ask(args: argparse.Namespace, screen: Screen, store: JobStore, done: Done) -> Json:
    """Do ``args.what``, a name of ``ASKED``; leaves a JSON file, and a page of the sensitivity.

    Raises ``InputError`` for counts that ask nothing, for names that are not known, and where the
    second world needs an engine that is missing.
    """
    # Imported here so that `touchdown --help` starts without torch.
    from backend.config.simulation import load_simulation

    if args.groups < 1 or args.trials < 0:
        raise InputError(
            "There is nothing to press.", "--groups, --trials", "Give a positive number of groups."
        )
    bench = load_simulation(args.bench, None if args.bench else args.preset)
    sources = _models(args, bench, store)
    way = _elsewhere if args.what == "elsewhere" else _sensitivity
    return way(args, screen, store, done, (bench, sources))


def _elsewhere(
    args: argparse.Namespace,
    screen: Screen,
    store: JobStore,
    done: Done,
    given: tuple[SimulationSettings, Mapping[str, str]],
) -> Json:
    from backend.experiments.asking import effort
    from backend.experiments.elsewhere import Both, press_rows, trial_rows
    from backend.experiments.writing import program_version
    from backend.simulation.release_mujoco import engine

    engine()
    plan = Both(
        bench=given[0],
        code=program_version(),
        piece=args.pieces,
        models=given[1],
        bottoms=tuple(args.bottoms.split(",")),
        strategies=tuple(args.strategies.split(",")) if args.trials else (),
        groups=args.groups,
        trials=args.trials,
    )
    failed = done(plan.jobs(), effort)
    answer = plan.answer(store)
    _show(
        screen,
        "Presses: IoU %, stability right after one probe %; bench, elsewhere, change",
        ("model", "IoU", "elsewhere", "", "right", "elsewhere", "", "unsafe"),
        press_rows(answer),
    )
    _show(
        screen,
        "Trials: placed %, unsafe %; bench, elsewhere, change",
        ("strategy", "trials", "placed", "elsewhere", "", "unsafe", "elsewhere", ""),
        trial_rows(answer),
    )
    return _kept(args.out, "elsewhere", answer, (plan.jobs(), failed), store)


def _sensitivity(
    args: argparse.Namespace,
    screen: Screen,
    store: JobStore,
    done: Done,
    given: tuple[SimulationSettings, Mapping[str, str]],
) -> Json:
    from backend.core.files import write_atomically
    from backend.experiments.asking import effort
    from backend.experiments.sensitivity import Sensitivity, sensitivity_rows
    from backend.experiments.sensitivity_page import COLUMNS, sensitivity_page
    from backend.experiments.writing import program_version

    plan = Sensitivity(
        bench=given[0],
        code=program_version(),
        piece=args.pieces,
        model=given[1]["FT+Tac"],
        bottoms=tuple(args.bottoms.split(",")),
        strategy=args.strategies.split(",")[0],
        groups=args.groups,
        trials=args.trials,
    )
    failed = done(plan.jobs(), effort)
    answer = plan.answer(store)
    write_atomically(args.out / "sensitivity.html", sensitivity_page(answer).encode())
    title = "Change of IoU in points at 0 to 3 times each nuisance; stability right, %"
    _show(screen, title, ("nuisance", *COLUMNS[1:]), sensitivity_rows(answer))
    return _kept(args.out, "sensitivity", answer, (plan.jobs(), failed), store)


def _models(args: argparse.Namespace, bench: SimulationSettings, store: JobStore) -> dict[str, str]:
    """Return the models of the piece, FT+Tac first; raises ``InputError`` for unknown names."""
    from backend.experiments.beyond import STRATEGIES
    from backend.experiments.given_models import adopt_models, models_that_ship
    from backend.experiments.recipes import BOTTOMS, PIECES

    known = ((args.pieces, PIECES), *((b, BOTTOMS) for b in args.bottoms.split(",")))
    known += tuple((s, STRATEGIES[:3]) for s in args.strategies.split(","))
    for name, names in known:
        if name not in names:
            raise InputError(
                f"'{name}' cannot be asked.",
                "--pieces, --bottoms, --strategies",
                f"Name one piece, or some of {','.join(names)}.",
            )
    folders = [args.models] if args.models else models_that_ship(bench.preset)
    found = adopt_models(store, *folders)
    return {n: found[args.pieces, n] for n in ("FT+Tac", "FT") if (args.pieces, n) in found}


def _show(
    screen: Screen, title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]
) -> None:
    table = Table(title=title)
    for column in columns:
        table.add_column(column)
    for row in rows:
        table.add_row(*row)
    screen.show(table)


def _kept(
    out: Path, name: str, answer: Json, ended: tuple[list[JobSpec], list[str]], store: JobStore
) -> Json:
    from backend.core.files import write_atomically

    jobs, failed = ended
    path = out / f"{name}.json"
    write_atomically(path, json.dumps(answer, indent=1, sort_keys=True).encode() + b"\n")
    missing = sum(not store.has(spec.id) for spec in jobs)
    return {
        "file": str(path),
        "jobs": len(jobs),
        "missing": missing,
        "failed": failed,
        name: answer,
    }
