"""``touchdown simulate``: write labelled episodes of the simulated bench into pack files."""

from __future__ import annotations

import argparse
import time
from datetime import UTC, datetime
from pathlib import Path

from touchdown.backend import experiments
from touchdown.backend.cli.experiment import add_executor_arguments, run_jobs
from touchdown.backend.cli.output import VerbOutput, require_positive
from touchdown.backend.config import load_simulation
from touchdown.backend.core import InputError, disk_errors, errors_as_input, make_folder
from touchdown.backend.geometry import load_pieces
from touchdown.backend.jobs import JobSpec, JobStore

JOBS = ".jobs"  # folder of the finished jobs beside the packs
KEPT = "Free some space, then repeat the call with the same --start; finished jobs are kept."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add = parser.add_argument
    add("--piece", default="pot", help="grasped piece")
    add("--bottoms", default="circle15,circle25,square15", help="bottoms, separated by commas")
    add("--episodes", type=int, default=2000, help="episodes per bottom")
    add("--seed", type=int, default=1)
    add("--out", metavar="DIR", required=True, help="folder for the pack files")
    add("--probes-per-grip", type=int, default=50, help="1: a new grip for every probe")
    add("--grips-per-mounting", type=int, default=10)
    add("--preset", help="mixed (default), quiet, hard, off, realistic, bench-v1, bench-v2")
    add("--bench", metavar="FILE", help="settings of the simulated bench (TOML)")
    add("--ranges", type=Path, metavar="JSON", help="figures of 'identify' beside its bench file: "
        "jobs of 20 grips draw their bench from the 95 %% intervals")  # fmt: skip
    add("--pieces", metavar="DIR", help="folder with further piece files")
    add("--start", metavar="TIME",
        help="time of the first episode, such as 2026-01-31T12:00:00+01:00 (default: now); the "
        "same seed and start give the same files, and continue an interrupted call")  # fmt: skip
    add_executor_arguments(parser, workers=2)


def run(args: argparse.Namespace, screen: VerbOutput) -> int:
    """Simulate all pairs and write them; the result does not depend on the executor."""
    require_positive(args, "episodes", "probes_per_grip", "grips_per_mounting", "workers")
    require_positive(args, "seed", least=0)
    if args.shard and args.start is None:
        fix = "Give all calls the same, such as 2026-01-31T12:00:00Z."
        raise InputError("All shards need one time of the first episode.", "--start", fix)
    out = Path(args.out)
    start = _start(args.start)
    jobs = _jobs(args, int(start.timestamp() * 1e6) * 1000)
    store, known = JobStore(out / JOBS), {spec.id for spec in jobs}
    finished = {path.name for path in store.root.glob("[!.]*")}
    held = any(JOBS not in path.parts for path in out.rglob("*.mcap"))
    if held and not (args.start and finished and finished <= known):
        fix = "Name a new or an empty folder."
        raise InputError("The folder already holds episodes.", str(out), fix)
    make_folder(store.root)
    if args.executor == "local" and min(args.workers, len(jobs)) == 1:
        args.executor = "serial"
    began_s = time.monotonic()
    failed = run_jobs(
        args, screen, store, {"collection": experiments.collect_packs}, jobs,
        lambda job: (f"{job.params['piece']} {job.params['bottom']}", int(job.params["probes"])),
    )  # fmt: skip
    with disk_errors("The packs cannot be moved", out, KEPT):
        experiments.publish_packs(store, jobs, out)
    seconds = time.monotonic() - began_s
    done = [spec for spec in jobs if store.has(spec.id)]
    total = sum(spec.params["probes"] for spec in done)
    redraws = experiments.total_redraws(
        [experiments.Redraws(**store.result(spec.id)) for spec in done]
    )
    screen.say(
        f"Simulated episodes: {total} in {seconds:.1f} s, probes drawn again: "
        f"{redraws.drawn_again}, {redraws.unsolved} of them without a simulated balance: {out}"
    )
    if left := len(jobs) - len(done):
        screen.say(f"{left} of {len(jobs)} jobs are missing.")
    screen.result({
        "episodes": total, **redraws._asdict(), "seconds": round(seconds, 3),
        "start": start.isoformat(), "out": str(out), "missing": left, "failed": failed,
    })  # fmt: skip
    return 1 if failed else 0


def _start(text: str | None) -> datetime:
    """Return the start in UTC; a text without an offset is in UTC."""
    said, fix = "This is no start time", "Give one such as 2026-01-31T12:00:00Z."
    with errors_as_input(said, "--start", fix, ValueError, OverflowError):
        start = datetime.now(UTC) if text is None else datetime.fromisoformat(text)
        start = (start if start.tzinfo else start.replace(tzinfo=UTC)).astimezone(UTC)
        if not 1970 <= start.year < 2200:
            raise ValueError(f"the year {start.year} is outside 1970 to 2199")
    return start


def _jobs(args: argparse.Namespace, start_ns: int) -> list[JobSpec]:
    folder = Path(args.pieces) if args.pieces else None
    catalogue = load_pieces(folder)
    settings = load_simulation(Path(args.bench) if args.bench else None, args.preset)
    piece = catalogue.top(args.piece)
    names = [name for text in args.bottoms.split(",") if (name := text.strip())]
    if not names or len(set(names)) != len(names):
        fix = "For example circle15,circle25,square15."
        raise InputError("Name each bottom once, and at least one.", "--bottoms", fix)
    ranges = experiments.read_ranges(args.ranges) if args.ranges else {}
    jobs: list[JobSpec] = []
    for name in names:
        plan = experiments.batch_plan(
            piece, catalogue.bottom(name), settings, args.episodes, args.seed,
            args.probes_per_grip, args.grips_per_mounting,
        )  # fmt: skip
        jobs += experiments.collection_jobs(
            plan, piece, start_ns, folder, last=name == names[-1], ranges=ranges
        )
    return jobs
