"""``touchdown identify``: identify benches from the recordings of datasets."""

from __future__ import annotations

import argparse
import shutil
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from touchdown.backend.cli.experiment.executors import add_executor_arguments, run_jobs
from touchdown.backend.cli.output import VerbOutput, check_output, progress_lines
from touchdown.backend.config import SimulationSettings, load_simulation, read_toml
from touchdown.backend.core import InputError, disk_errors, program_version
from touchdown.backend.experiments import identify_dataset
from touchdown.backend.jobs import JobSpec, JobStore

KEPT = "Free some space, or name another file; finished stages are kept."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "dataset", metavar="DATASET", nargs="+", help="dataset with recordings of one bench"
    )
    parser.add_argument(
        "--out", type=Path, metavar="FILE", default=Path("lab-bench.toml"),
        help="bench file to write; figures (.json) and report (.html) beside it; of several "
        "datasets: folder for a bench file each",
    )  # fmt: skip
    parser.add_argument("--preset", help="nominal bench: mixed (default), bench-v1, ...")
    parser.add_argument("--bench", metavar="FILE", help="nominal bench: settings file (TOML)")
    parser.add_argument("--pieces", metavar="DIR", help="folder with further piece files")
    add_executor_arguments(parser)


def run(args: argparse.Namespace, screen: VerbOutput) -> int:
    """Identify; return 0 if all benches were accepted, 1 if a replay gate refused one."""
    nominal = load_simulation(Path(args.bench) if args.bench else None, args.preset)
    several, out = len(args.dataset) > 1, args.out
    if (out.suffix == ".toml") == several:
        what = "Several benches need a folder." if several else "The bench file is TOML."
        fix = "Name a folder." if several else "Name a file that ends with .toml."
        raise InputError(what, str(out), fix)
    files = [out / f"{Path(name).resolve().name}.toml" for name in args.dataset]
    if len(set(files)) < len(files):
        fix = "Give each dataset a folder of another name."
        raise InputError("Two datasets have one name.", "DATASET", fix)
    files = files if several else [out]
    for file in files:
        check_output(file, ".toml", args.bench and Path(args.bench))
        if file.is_file() and read_toml(file).keys() - SimulationSettings.model_fields.keys():
            what = "This file is of no simulated bench; it would be replaced."
            raise InputError(what, str(file), "Name another file.")
    pieces = str(Path(args.pieces).resolve()) if args.pieces else None
    jobs = [
        JobSpec("identify", {
            "dataset": str(Path(dataset).resolve()), "name": file.name, "pieces": pieces,
            "stages": str(file.with_suffix(".stages").resolve()),
            "bench": nominal.model_dump(mode="json"),
        }, code=program_version())
        for dataset, file in zip(args.dataset, files, strict=True)
    ]  # fmt: skip
    args.executor = "serial" if args.executor == "local" and not several else args.executor
    here = partial(identify_dataset, tell=progress_lines())
    kinds = {"identify": here if args.executor == "serial" else identify_dataset}
    store = JobStore(files[0].parent / f".{out.stem}.jobs")
    with disk_errors("The result cannot be written", out, KEPT):
        store.root.mkdir(parents=True, exist_ok=True)
        failed = run_jobs(args, screen, store, kinds, jobs, lambda job: (job.params["dataset"], 1))
        ended = [pair for pair in zip(jobs, files, strict=True) if store.has(pair[0].id)]
        found = [_publish(store, spec, file) for spec, file in ended]
    for one in found:
        if "refused" in one and not several:
            raise InputError(*one["refused"])
        _show(one, screen)
    answer = {"benches": found} if several or not found else found[0]
    screen.result({**answer, "failed": failed})
    return 0 if not failed and all(one.get("accepted") for one in found) else 1


def _publish(store: JobStore, spec: JobSpec, out: Path) -> dict[str, Any]:
    """Move the files of a finished job beside ``out``; return its answer and their paths."""
    answer, folder = store.result(spec.id), store.folder(spec.id)
    for suffix in (".html", ".json", ".toml"):
        if (path := folder / out.with_suffix(suffix).name).is_file():
            path.replace(out.with_suffix(suffix))
    shutil.rmtree(folder)
    with suppress(OSError):  # jobs of other shards are there
        store.root.rmdir()
    paths = {"report": str(out.with_suffix(".html")), "figures": str(out.with_suffix(".json"))}
    bench = str(out) if answer.get("accepted") else None
    paths["earlier"] = str(out) if bench is None and out.is_file() else ""
    return {**answer, "dataset": spec.params["dataset"], "bench": bench, **paths}


def _show(found: dict[str, Any], screen: VerbOutput) -> None:
    if "refused" in found:
        screen.say(" ".join(found["refused"]))
        return
    rows = [
        (key, f"{value:.4g}", f"{sigma:.2g}", unit, found["use"][key])
        for key, (value, sigma, unit) in found["estimates"].items()
    ]
    header = ("parameter", "value", "standard uncertainty", "unit", "used")
    title = f"Identified bench of {found['dataset']}"
    screen.table(title, header, *rows, right=("value", "standard uncertainty"))
    screen.say(found["reason"])
    for verdict in found["verdicts"]:
        screen.say(verdict)
    bench = f"Bench file: {found['bench']}." if found["accepted"] else ""
    if found["earlier"]:
        bench = f"{found['earlier']} is the bench file of an earlier identification."
    screen.say(f"Report: {found['report']}. {bench}")
