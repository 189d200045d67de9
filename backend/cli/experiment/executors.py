"""Execution of the jobs of a verb: ``--executor``, ``--workers``, ``--cluster`` and ``--shard``.

The verbs ``experiment``, ``simulate``, ``train`` and ``identify`` share these arguments.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Sequence

from touchdown.backend.cli.output import VerbOutput, require_positive
from touchdown.backend.core import InputError
from touchdown.backend.jobs import (
    Executor,
    JobFunctions,
    JobSpec,
    JobStore,
    independent_jobs,
    parse_shard,
    run_campaign,
    shard_of,
)

EXECUTORS = ("serial", "local", "dask", "slurm")


def add_device(parser: argparse.ArgumentParser) -> None:
    """Add the argument ``--device``."""
    parser.add_argument(
        "--device", choices=("auto", "cpu", "cuda"), default="auto",
        help="cpu, cuda, or auto: a graphics processor if torch finds one",
    )  # fmt: skip


def add_executor_arguments(parser: argparse.ArgumentParser, workers: int = 0) -> None:
    """Add the arguments; ``workers``: default number of processes (0: all cores but one)."""
    jobs = parser.add_argument_group("jobs")
    jobs.add_argument(
        "--executor", choices=EXECUTORS, default="local", help="where jobs run: this process, "
        "processes of this computer, a Dask cluster, or job arrays of Slurm",
    )  # fmt: skip
    jobs.add_argument(
        "--workers", type=int, default=workers or max(1, (os.cpu_count() or 2) - 1),
        help="processes of the local executor",
    )  # fmt: skip
    jobs.add_argument("--cluster", metavar="ADDRESS", help="scheduler of the executor dask")
    jobs.add_argument("--shard", metavar="i/n", help="run every n-th job only, for batch queues")


def _executor(
    args: argparse.Namespace, kinds: JobFunctions, store: JobStore, tell: Callable[[str], None]
) -> Executor:
    from touchdown.backend.jobs import DaskCluster, ProcessPool, SerialExecutor, SlurmArrays

    if args.executor == "serial":
        return SerialExecutor(kinds, store)
    if args.executor == "local":
        return ProcessPool(kinds, store, args.workers, tell)
    if args.executor == "slurm":
        return SlurmArrays(kinds, store)
    if not args.cluster:
        raise InputError("The executor dask needs a scheduler.", "--cluster", "Give its address.")
    return DaskCluster.at(kinds, store, args.cluster)


def run_jobs(
    args: argparse.Namespace,
    screen: VerbOutput,
    store: JobStore,
    kinds: JobFunctions,
    jobs: Sequence[JobSpec],
    described: Callable[[JobSpec], tuple[str, int]],
) -> list[str]:
    """Run the unfinished jobs, or those of one shard; return the ids of the failed ones.

    ``described`` returns the name and the relative duration of a job, for the progress.
    """
    require_positive(args, "workers")
    part, failed, done = list(jobs), list[str](), 0
    if args.shard:
        part = independent_jobs(jobs, shard_of(jobs, *parse_shard(args.shard)), store)
    else:
        store.sweep()
    known = {spec.id: spec for spec in part}
    with screen.progress(f"{len(part)} jobs", sum(described(s)[1] for s in part)) as advance:
        for result in run_campaign(part, _executor(args, kinds, store, screen.say), store):
            name, effort = described(known[result.id])
            done += effort
            advance(done, name)
            if result.state == "failed":
                failed.append(result.id)
                screen.say(f"{name} failed: {result.error.strip()}")
    for spec in part:
        if spec.id not in failed and not store.has(spec.id):
            failed.append(spec.id)
            told = f"ended without a result in {store.root}; all workers need this folder"
            screen.say(f"{described(spec)[0]} {told}.")
    return failed
