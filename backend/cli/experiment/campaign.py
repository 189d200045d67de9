"""Campaign of an experiment: its arguments, bench and models, and the jobs that ran and failed."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeAlias

from touchdown.backend import experiments
from touchdown.backend.cli.experiment.executors import add_device, add_executor_arguments, run_jobs
from touchdown.backend.cli.output import VerbOutput, require_positive
from touchdown.backend.config import SimulationSettings, StackSettings, load_simulation
from touchdown.backend.core import InputError, disk_errors, make_folder, write_atomically
from touchdown.backend.jobs import JobSpec, JobStore

UNWRITTEN = "It could not be written"
KEPT = "Free some space, or name another folder; finished jobs are kept."
Json: TypeAlias = dict[str, Any]


def add_campaign_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of bench, models and jobs."""
    add = parser.add_argument
    add("--out", type=Path, default=Path("output/experiment"), metavar="DIR",
        help="folder of page, JSON and jobs; resumes there")  # fmt: skip
    add("--preset", default="bench-v1", help="preset of the bench")
    add("--bench", type=Path, metavar="FILE", help="settings of the bench (TOML)")
    add("--pieces", default="mushroom,barrel,pot", help="separated by commas")
    add("--models", type=Path, metavar="DIR", help="models for --quick (default: those that ship)")
    add("--keep-models", type=Path, metavar="DIR",
        help="write the models that --full trained, in half precision")  # fmt: skip
    add_device(parser)
    add_executor_arguments(parser)


def parse_names(text: str, known: Iterable[str], where: str) -> tuple[str, ...]:
    """Return the names in a comma-separated text; raises ``InputError`` for an unknown one."""
    names, known = tuple(text.split(",")), tuple(known)
    if unknown := [name for name in names if name not in known]:
        raise InputError(f"'{unknown[0]}' is not known.", where, f"Name some of {','.join(known)}.")
    return names


def parse_strategies(text: str, known: Iterable[str]) -> tuple[str, ...]:
    """Return names of strategies, each with the settings behind it; raises ``InputError``."""
    names = tuple(text.split(","))
    parse_names(",".join(map(experiments.base_strategy, names)), known, "--strategies")
    for name in names:
        if ":" in name:
            experiments.method_of(name, StackSettings())
    return names


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a result file; raises ``InputError`` if it cannot be written."""
    with disk_errors(UNWRITTEN, path, KEPT):
        write_atomically(path, json.dumps(content, indent=1, sort_keys=True).encode() + b"\n")


class ExperimentRun:
    """One call of an experiment. ``jobs``: all that it needs; ``failed``: ids of failed ones."""

    def __init__(self, args: argparse.Namespace, screen: VerbOutput) -> None:
        require_positive(args, "workers")
        self.args, self.screen = args, screen
        self.store: JobStore = JobStore(args.out / "jobs")
        self.jobs: dict[str, JobSpec] = {}
        self.failed: list[str] = []

    def bench(self) -> SimulationSettings:
        """Return the bench of the arguments."""
        return load_simulation(self.args.bench, None if self.args.bench else self.args.preset)

    def models(self, bench: SimulationSettings) -> dict[tuple[str, str], str]:
        """Return the ids of the models of the arguments, by piece and table name."""
        own = self.args.models
        return experiments.adopt_models(
            self.store, *([own] if own else experiments.shipped_model_folders(bench.preset))
        )

    def run(self, jobs: list[JobSpec]) -> bool:
        """Run the unfinished jobs, or those of one shard; return True if none failed.

        Raises ``OSError`` if the folder of the jobs cannot be made.
        """
        make_folder(self.store.root)
        self.jobs |= {spec.id: spec for spec in jobs}
        failed = run_jobs(self.args, self.screen, self.store, experiments.KINDS, jobs, _described)
        self.failed += failed
        return not failed

    def counts(self) -> Json:
        """Return the numbers of all and of missing jobs, and the failed ones."""
        missing = sum(not self.store.has(name) for name in self.jobs)
        return {"jobs": len(self.jobs), "missing": missing, "failed": self.failed}


def _described(spec: JobSpec) -> tuple[str, int]:
    p = spec.params
    over = "+".join(p["bottoms"]) if "bottoms" in p else p.get("bottom", "")
    training = p.get("training", {}).get("modality", "")
    words = (spec.kind, p.get("piece", ""), over, training, p.get("strategy", ""))
    return " ".join(word for word in words if word), experiments.job_effort(spec)
