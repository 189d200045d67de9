"""``touchdown simulate``: write labelled episodes of the simulated bench into pack files."""

from __future__ import annotations

import argparse
import time
from datetime import UTC, datetime
from pathlib import Path

from touchdown.backend.cli.output import VerbOutput, make_output_folder, require_positive
from touchdown.backend.config import load_simulation
from touchdown.backend.core import InputError
from touchdown.backend.experiments import batch_plan, run_jobs, split_jobs
from touchdown.backend.geometry import load_pieces
from touchdown.backend.simulation import BatchPlan


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("--piece", default="pot", help="grasped piece")
    parser.add_argument(
        "--bottoms", default="circle15,circle25,square15", help="bottoms, separated by commas"
    )
    parser.add_argument("--episodes", type=int, default=2000, help="episodes per bottom")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", metavar="DIR", required=True, help="folder for the pack files")
    parser.add_argument(
        "--probes-per-grip", type=int, default=50, help="1: a new grip for every probe"
    )
    parser.add_argument("--grips-per-mounting", type=int, default=10)
    parser.add_argument(
        "--preset", help="mixed (default), quiet, hard, off, realistic, bench-v1, bench-v2"
    )
    parser.add_argument("--bench", metavar="FILE", help="settings of the simulated bench (TOML)")
    parser.add_argument("--pieces", metavar="DIR", help="folder with further piece files")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument(
        "--start", metavar="TIME",
        help="time of the first episode, such as 2026-01-31T12:00:00+01:00 (default: now); the "
        "same seed and start give the same files",
    )  # fmt: skip


def run(args: argparse.Namespace, screen: VerbOutput) -> int:
    """Simulate all pairs and write them; the result does not depend on ``--workers``."""
    require_positive(args, "episodes", "probes_per_grip", "grips_per_mounting", "workers")
    if args.seed < 0:
        raise InputError("--seed must not be negative.", "--seed", "Give 0, 1, 2 ...")
    out = Path(args.out)
    if out.exists() and not out.is_dir():
        raise InputError("This is a file, not a folder.", str(out), "Name a new folder.")
    if any(out.rglob("*.mcap")):
        raise InputError(
            "The folder already holds episodes.", str(out), "Name a new or an empty folder."
        )
    start = _start(args.start)
    start_ns = int(start.timestamp() * 1e6) * 1000
    jobs = [job for plan, label in _plans(args) for job in split_jobs(plan, label, out, start_ns)]
    make_output_folder(out)
    total = sum(job.episodes for job in jobs)
    began_s = time.monotonic()
    with screen.progress(f"Simulating {total} episodes", total) as advance:
        redraws = run_jobs(jobs, args.workers, advance)
    seconds = time.monotonic() - began_s
    screen.say(
        f"{total} simulated episodes in {seconds:.1f} s, {redraws.drawn_again} probes drawn again, "
        f"{redraws.unsolved} of them without a balance in the simulation: {out}"
    )
    facts = {
        "episodes": total,
        **redraws._asdict(),
        "seconds": round(seconds, 3),
        "start": start.isoformat(),
    }
    screen.result({**facts, "out": str(out)})
    return 0


def _start(text: str | None) -> datetime:
    """Return the start in UTC; a text without an offset is in UTC."""
    try:
        start = datetime.now(UTC) if text is None else datetime.fromisoformat(text)
        start = (start if start.tzinfo else start.replace(tzinfo=UTC)).astimezone(UTC)
        if not 1970 <= start.year < 2200:
            raise ValueError(f"the year {start.year} is outside 1970 to 2199")
    except (ValueError, OverflowError) as error:
        raise InputError(
            f"This is no start time: {error}.", "--start", "Give one such as 2026-01-31T12:00:00Z."
        ) from error
    return start


def _plans(args: argparse.Namespace) -> list[tuple[BatchPlan, dict[str, object]]]:
    """Return for each pair the plan and the label fields common to all its episodes."""
    catalogue = load_pieces(Path(args.pieces) if args.pieces else None)
    settings = load_simulation(Path(args.bench) if args.bench else None, args.preset)
    piece = catalogue.top(args.piece)
    names = [name for name in args.bottoms.split(",") if name]
    if not names or len(set(names)) != len(names):
        raise InputError(
            "Name each bottom once.", "--bottoms", "For example circle15,circle25,square15."
        )
    plans: list[tuple[BatchPlan, dict[str, object]]] = []
    for name in names:
        plan = batch_plan(
            piece, catalogue.bottom(name), settings, args.episodes, args.seed,
            args.probes_per_grip, args.grips_per_mounting,
        )  # fmt: skip
        plans.append((plan, {"geometry": piece.sha256}))
    return plans
