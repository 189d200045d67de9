"""Print every figure next to its target: ``make bench``.

``python -m tests.bench.run [name ...] [--json] [--save] [--since DATE]`` measures the named groups
or figures only and prints each as it comes. Without names, long measurements are left out.
``--save`` stores the results of each measurement when it ends and renders ``docs/measured.md``, so
that ``--since`` can resume: it leaves out what was stored with its time on or after that day. Exit
code 0 if every measured figure meets its target, else 1.
"""

import argparse
import importlib
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict

from rich.table import Table
from rich.text import Text

from tests.bench.figures import LONG, REGISTER, Figure, read_records, records_of, save
from touchdown.backend.cli.output import VerbOutput
from touchdown.backend.core.faults import TouchdownError

# Modules that register figures, in the order of the table.
MODULES = tuple(
    f"tests.bench.{name}"
    for name in (
        "throughput", "window", "experiments", "dataset", "labelling", "arm", "rig",
        "device_faults", "wired", "campaign", "worker_faults", "machinery", "laboratories",
        "laboratory_labels",
    )
)  # fmt: skip

WORDS = {True: Text("met", "green"), False: Text("missed", "bold red"),
         None: Text("stated", "yellow")}  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print; returns the exit code."""
    parser = argparse.ArgumentParser(prog="make bench", description=__doc__)
    for module in MODULES:
        importlib.import_module(module)
    groups = sorted({group for group, _ in REGISTER.values()})
    told = f"measure these groups ({', '.join(groups)}) or single figures only"
    parser.add_argument("names", nargs="*", metavar="name", help=told)
    parser.add_argument("--json", action="store_true", help="one JSON object and nothing else")
    parser.add_argument("--save", action="store_true", help="store and render the results")
    parser.add_argument("--since", default="", metavar="DATE", help="leave out what is stored with "
                        "its time and was measured on this day (YYYY-MM-DD) or later")  # fmt: skip
    args = parser.parse_args(argv)
    if unknown := sorted(set(args.names) - set(groups) - set(REGISTER)):
        parser.error(f"there is no group {', '.join(unknown)}; there are {', '.join(groups)}")
    wanted = {
        name: (group, measure)
        for name, (group, measure) in REGISTER.items()
        if {name, group} & set(args.names) or (not args.names and name not in LONG)
    }
    if args.since:
        for record in read_records():
            if record["date"] >= args.since and "seconds" in record:
                wanted.pop(record["measure"], None)
    screen = VerbOutput(json=args.json)
    figures: list[Figure] = []
    with screen.progress("Measuring", len(wanted)) as advance:
        for done, (name, (group, measure)) in enumerate(wanted.items()):
            advance(done, name.replace("_", " "))
            begun_s = time.monotonic()
            try:
                found = measure()
            except Exception as error:  # noqa: BLE001 - the others are measured all the same
                known = isinstance(error, TouchdownError)
                note = str(error) if known else f"{type(error).__name__}: {error}"
                found = [Figure(name, None, "", "", ok=False, note=note)]
            figures += found
            if args.save:
                save(records_of(group, name, found, time.monotonic() - begun_s))
            for one in found:
                screen.say(f"{one.name}: {measured(one)} ({WORDS[one.ok].plain})")
        advance(len(wanted))
    screen.show(table(figures))
    missed = [figure for figure in figures if figure.ok is False]
    screen.say(f"{len(figures)} figures, {len(missed)} missed.")
    if not args.names and LONG:
        screen.say(f"Measured by name only: {', '.join(sorted(LONG))}.")
    screen.result({"figures": [asdict(figure) for figure in figures]})
    return 1 if missed else 0


def measured(f: Figure) -> str:
    """Return the value of one figure with its unit, "" without one."""
    value = f"{f.value:.4g}" if isinstance(f.value, float) else f.value
    return "" if value is None else f"{value} {f.unit}".strip()


def table(figures: Sequence[Figure]) -> Table:
    shown = Table(title="Figures")
    for column in ("figure", "measured", "target", "", "note"):
        shown.add_column(column, overflow="fold")
    for f in figures:
        shown.add_row(f.name, measured(f), f"{f.target} {f.unit}".strip(), WORDS[f.ok], f.note)
    return shown


if __name__ == "__main__":
    sys.exit(main())
