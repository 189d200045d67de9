"""``touchdown identify``: identify a bench from the recordings of a dataset."""

from __future__ import annotations

import argparse
from pathlib import Path

from touchdown.backend.annotations import Dataset
from touchdown.backend.cli.output import VerbOutput, progress_lines
from touchdown.backend.config import load_simulation
from touchdown.backend.core import InputError, disk_errors, write_atomically
from touchdown.backend.experiments import identification_page
from touchdown.backend.geometry import load_pieces
from touchdown.backend.identification import identify_bench, read_recordings, write_identification

KEPT = "Free some space, or name another file; finished stages are kept."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("dataset", metavar="DATASET", help="dataset with recordings of one bench")
    parser.add_argument(
        "--out", type=Path, metavar="FILE", default=Path("lab-bench.toml"),
        help="bench file to write; figures (.json) and report (.html) beside it",
    )  # fmt: skip
    parser.add_argument("--preset", help="nominal bench: mixed (default), bench-v1, ...")
    parser.add_argument("--bench", metavar="FILE", help="nominal bench: settings file (TOML)")
    parser.add_argument("--pieces", metavar="DIR", help="folder with further piece files")


def run(args: argparse.Namespace, screen: VerbOutput) -> int:
    """Identify; return 0 if the bench was accepted, 1 if the replay gate refused it."""
    nominal = load_simulation(Path(args.bench) if args.bench else None, args.preset)
    library = load_pieces(Path(args.pieces) if args.pieces else None)
    out: Path = args.out
    if out.suffix != ".toml":
        raise InputError("The bench file is TOML.", str(out), "Name a file that ends with .toml.")
    with Dataset.open(Path(args.dataset), write=False, progress=progress_lines()) as dataset:
        reading = progress_lines()
        recordings = read_recordings(dataset, lambda done, of: reading("Reading", done, of))
    with disk_errors("The result cannot be written", out, KEPT):
        out.parent.mkdir(parents=True, exist_ok=True)
        stages, source = out.with_suffix(".stages"), str(args.dataset)
        found = identify_bench(recordings, nominal, library, stages, progress_lines())
        page = out.with_suffix(".html")
        write_atomically(page, identification_page(found, source).encode())
        figures = write_identification(found, out, source)
    rows = [
        (e.key, f"{e.value:.4g}", f"{e.sigma:.2g}", e.unit, "yes" if e.key in found.used else "no")
        for e in found.estimates
    ]
    header = ("parameter", "value", "standard uncertainty", "unit", "used")
    screen.table("Identified bench", header, *rows, right=("value", "standard uncertainty"))
    screen.say(found.reason)
    screen.say(f"Report: {page}. " + (f"Bench file: {out}." if found.gate.accepted else ""))
    screen.result({
        "accepted": found.gate.accepted, "reason": found.reason, "share": found.gate.share,
        "bench": str(out) if found.gate.accepted else None, "report": str(page),
        "figures": str(figures), "used": list(found.used),
        "estimates": {e.key: [e.value, e.sigma] for e in found.estimates},
    })  # fmt: skip
    return 0 if found.gate.accepted else 1
