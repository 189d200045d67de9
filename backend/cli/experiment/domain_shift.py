"""``touchdown experiment elsewhere`` and ``sensitivity``: existing models on other benches."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias, get_args

from touchdown.backend.cli.output import VerbOutput
from touchdown.backend.config import SimulationSettings, load_simulation
from touchdown.backend.core import InputError, write_atomically
from touchdown.backend.experiments import (
    EVALUATED_STRATEGIES,
    PIECES,
    TABLE_BOTTOMS,
    CollectionKind,
    DomainShift,
    NuisanceSensitivity,
    RandomisedTraining,
    adopt_models,
    change_rows,
    job_effort,
    load_model,
    press_rows,
    program_version,
    report_page,
    sensitivity_report,
    sensitivity_table,
    shipped_model_folders,
    trial_rows,
)
from touchdown.backend.jobs import JobSpec, JobStore

EVALUATIONS = ("elsewhere", "sensitivity")
# runs the unfinished jobs, given the effort of each; returns the ids of failed jobs
RunJobs: TypeAlias = Callable[[list[JobSpec], Callable[[JobSpec], int]], list[str]]
Json: TypeAlias = dict[str, Any]


def add_evaluation_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``elsewhere`` and ``sensitivity``."""
    asked = parser.add_argument_group("elsewhere, sensitivity")
    asked.add_argument("--groups", type=int, default=20, help="of three probes, in each cell")
    asked.add_argument("--first", type=int, default=0, metavar="N", help="number of the first "
                       "group and trial in each cell, to make choices on other ones than are "
                       "reported (elsewhere)")  # fmt: skip
    asked.add_argument("--train", metavar="NAMES", help="train FT+Tac first, with the assumed "
                       "training of the paper, and evaluate it too: on probes of 120 mountings of "
                       "the bench (mountings), of 120 mountings with random nuisances, gel and "
                       "friction (randomised), or both, separated by a comma "
                       "(elsewhere)")  # fmt: skip
    asked.add_argument(
        "--probes", type=int, default=2000, help="of --train on each of three outlines"
    )
    asked.add_argument("--epochs", type=int, default=30, help="of --train")


def run_evaluation(
    args: argparse.Namespace, screen: VerbOutput, store: JobStore, done: RunJobs
) -> Json:
    """Run ``args.what``, one of ``EVALUATIONS``; write a JSON file, and a page for the sensitivity.

    Raises ``InputError`` for counts without work, for unknown names, and if the second world lacks
    its engine.
    """
    if args.groups < 1 or args.trials < 0:
        raise InputError(
            "The counts give no presses.", "--groups, --trials", "Give a positive number of groups."
        )
    bench = load_simulation(args.bench, None if args.bench else args.preset)
    sources = _models(args, bench, store)
    way = _elsewhere if args.what == "elsewhere" else _sensitivity
    return way(args, screen, store, done, (bench, sources))


def _elsewhere(
    args: argparse.Namespace,
    screen: VerbOutput,
    store: JobStore,
    done: RunJobs,
    given: tuple[SimulationSettings, Mapping[str, str]],
) -> Json:
    from touchdown.backend.simulation import import_mujoco

    import_mujoco()
    if args.first < 0 or args.epochs < 1 or args.probes < 10:
        raise InputError(
            "A number is out of range.",
            "--first, --epochs, --probes",
            "Give --first 0 or more, --epochs 1 or more, --probes 10 or more.",
        )
    trained = _trained(args, given[0])
    plan = DomainShift(
        bench=given[0],
        code=program_version(),
        piece=args.pieces,
        models=given[1],
        bottoms=tuple(args.bottoms.split(",")),
        strategies=tuple(args.strategies.split(",")) if args.trials else (),
        groups=args.groups,
        trials=args.trials,
        trained=trained,
        first=args.first,
    )
    failed = done(plan.jobs(), plan.effort)
    if args.keep_models:
        _keep(args.keep_models, trained, store, screen)
    answer = plan.answer(store)
    screen.table(
        "Presses: IoU %, stability right after one probe %; bench, elsewhere, change",
        ("model", "IoU", "elsewhere", "", "right", "elsewhere", "", "unsafe"),
        *press_rows(answer),
    )
    screen.table(
        "Change of the IoU in points, group by group",
        ("what", "bottom", "change", "groups"),
        *change_rows(answer),
    )
    screen.table(
        "Trials: placed %, unsafe %; bench, elsewhere, change",
        ("strategy", "trials", "placed", "elsewhere", "", "unsafe", "elsewhere", ""),
        *trial_rows(answer),
    )
    return _kept(args.out, "elsewhere", answer, (plan.jobs(), failed), store)


def _sensitivity(
    args: argparse.Namespace,
    screen: VerbOutput,
    store: JobStore,
    done: RunJobs,
    given: tuple[SimulationSettings, Mapping[str, str]],
) -> Json:
    plan = NuisanceSensitivity(
        bench=given[0],
        code=program_version(),
        piece=args.pieces,
        model=given[1]["FT+Tac"],
        bottoms=tuple(args.bottoms.split(",")),
        strategy=args.strategies.split(",")[0],
        groups=args.groups,
        trials=args.trials,
    )
    failed = done(plan.jobs(), job_effort)
    answer = plan.answer(store)
    page = report_page(sensitivity_report(answer))
    write_atomically(args.out / "sensitivity.html", page.encode())
    table = sensitivity_table(answer)
    screen.table(table.title, *table.texts())
    return _kept(args.out, "sensitivity", answer, (plan.jobs(), failed), store)


def _trained(args: argparse.Namespace, bench: SimulationSettings) -> tuple[RandomisedTraining, ...]:
    """Return the required trainings; raises ``InputError`` for unknown collections."""
    names: tuple[CollectionKind, ...] = get_args(CollectionKind)
    wanted = args.train.split(",") if args.train else []
    if unknown := [word for word in wanted if word not in names]:
        raise InputError(
            f"'{unknown[0]}' is no collection.", "--train", f"Name some of {','.join(names)}."
        )
    own = RandomisedTraining(
        bench,
        program_version(),
        args.pieces,
        "randomised",
        probes=args.probes,
        epochs=args.epochs,
        device=args.device,
    )
    return tuple(replace(own, collected=name) for name in names if name in wanted)


def _keep(
    folder: Path, trained: Sequence[RandomisedTraining], store: JobStore, screen: VerbOutput
) -> None:
    """Write the trained models, each to its own folder for ``--models``."""
    from touchdown.backend.learning import save_half_precision

    for plan in trained:
        source = plan.training().id
        if store.has(source):
            path = folder / plan.collected / f"{plan.piece}-{plan.inputs.lower()}.safetensors"
            path.parent.mkdir(parents=True, exist_ok=True)
            save_half_precision(path, load_model(source, store))
            screen.say(f"A model: {path}")


def _models(args: argparse.Namespace, bench: SimulationSettings, store: JobStore) -> dict[str, str]:
    """Return the models of the piece, FT+Tac first; raises ``InputError`` for unknown names."""
    known = ((args.pieces, PIECES), *((b, TABLE_BOTTOMS) for b in args.bottoms.split(",")))
    known += tuple((s, EVALUATED_STRATEGIES) for s in args.strategies.split(","))
    for name, names in known:
        if name not in names:
            fix = f"Name one piece, or some of {','.join(names)}."
            raise InputError(
                f"'{name}' is not available.", "--pieces, --bottoms, --strategies", fix
            )
    folders = [args.models] if args.models else shipped_model_folders(bench.preset)
    found = adopt_models(store, *folders)
    return {n: found[args.pieces, n] for n in ("FT+Tac", "FT") if (args.pieces, n) in found}


def _kept(
    out: Path, name: str, answer: Json, ended: tuple[list[JobSpec], list[str]], store: JobStore
) -> Json:
    jobs, failed = ended
    path = out / f"{name}.json"
    write_atomically(path, json.dumps(answer, indent=1, sort_keys=True).encode() + b"\n")
    missing = sum(not store.has(spec.id) for spec in jobs)
    counts = {"jobs": len(jobs), "missing": missing, "failed": failed}
    return {"file": str(path), **counts, name: answer}
