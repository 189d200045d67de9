"""Print every promised figure next to its target: ``make bench``.

``python -m tests.bench.run [name ...] [--json]`` measures the named groups or figures only, and
says each as it comes, since a whole group may take an hour. Exit code 0 if every measured figure
meets its target, else 1.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence

from rich.table import Table
from rich.text import Text

from tests.bench.registry import REGISTER, Figure
from touchdown.backend.cli.output import VerbOutput
from touchdown.backend.core.faults import TouchdownError

MODULES: tuple[str, ...] = (
    "tests.bench.command_line",
    "tests.bench.tracking",
    "tests.bench.simulation",
    "tests.bench.agreement",
    "tests.bench.window",
    "tests.bench.stacking",
    "tests.bench.store",
    "tests.bench.labelling",
    "tests.bench.labelling_slips",
    "tests.bench.labelling_day",
    "tests.bench.collecting",
    "tests.bench.experiments",
    "tests.bench.full_tables",
    "tests.bench.store_files",
    "tests.bench.queues",
    "tests.bench.arm",
    "tests.bench.arm_rig",
    "tests.bench.fault_cores",
    "tests.bench.faults",
    "tests.bench.faults_pictures",
    "tests.bench.wired",
    "tests.bench.operators_day",
    "tests.bench.faults_wired",
    "tests.bench.fault_streams",
    "tests.bench.fault_arm",
    "tests.bench.fault_plugs",
    "tests.bench.fault_contact",
    "tests.bench.fault_peaks",
    "tests.bench.fault_lines",
    "tests.bench.fault_controller",
    "tests.bench.fault_disk",
    "tests.bench.fault_memory",
    "tests.bench.fault_data",
    "tests.bench.fault_grip",
    "tests.bench.fault_workers",
    "tests.bench.fault_children",
    "tests.bench.fault_raising",
    "tests.bench.fault_lease",
    "tests.bench.fault_blocked_camera",
    "tests.bench.fault_flood",
    "tests.bench.fault_starved",
    "tests.bench.fault_locked_label",
    "tests.bench.wired_parts",
)
"""Modules that register figures, in the order of the table."""

WORDS = {
    True: Text("met", "green"),
    False: Text("missed", "bold red"),
    None: Text("stated", "yellow"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print; returns the exit code."""
    parser = argparse.ArgumentParser(prog="make bench", description=__doc__)
    for module in MODULES:
        importlib.import_module(module)
    groups = sorted({group for group, _ in REGISTER.values()})
    parser.add_argument(
        "names",
        nargs="*",
        metavar="name",
        help=f"measure these groups ({', '.join(groups)}) or single figures only",
    )
    parser.add_argument("--json", action="store_true", help="one JSON object and nothing else")
    args = parser.parse_args(argv)
    if unknown := sorted(set(args.names) - set(groups) - set(REGISTER)):
        parser.error(f"there is no group {', '.join(unknown)}; there are {', '.join(groups)}")
    wanted = {
        name: measure
        for name, (group, measure) in REGISTER.items()
        if not args.names or {name, group} & set(args.names)
    }
    screen = VerbOutput(json=args.json)
    figures: list[Figure] = []
    with screen.progress("Measuring", len(wanted)) as advance:
        for done, (name, measure) in enumerate(wanted.items()):
            advance(done, name.replace("_", " "))
            try:
                found = measure()
            except TouchdownError as error:
                found = [Figure(name, None, "", "", ok=False, note=str(error))]
            figures += found
            for one in found:
                screen.say(f"{one.name}: {measured(one)} ({WORDS[one.ok].plain})")
        advance(len(wanted))
    screen.show(table(figures))
    missed = [figure for figure in figures if figure.ok is False]
    screen.say(f"{len(figures)} figures, {len(missed)} missed.")
    screen.result({"figures": [as_record(figure) for figure in figures]})
    return 1 if missed else 0


def measured(f: Figure) -> str:
    """Return the value of one figure with its unit, "" without one."""
    value = f"{f.value:.4g}" if isinstance(f.value, float) else f.value
    return "" if value is None else f"{value} {f.unit}".strip()


def table(figures: Sequence[Figure]) -> Table:
    """Return the table of all figures."""
    shown = Table(title="Figures")
    for column in ("figure", "measured", "target", "", "note"):
        shown.add_column(column, overflow="fold")
    for f in figures:
        shown.add_row(f.name, measured(f), f"{f.target} {f.unit}".strip(), WORDS[f.ok], f.note)
    return shown


def as_record(f: Figure) -> dict[str, object]:
    """Return the JSON form of one figure."""
    names = ("name", "value", "unit", "target", "ok", "note")
    return {name: getattr(f, name) for name in names}


if __name__ == "__main__":
    sys.exit(main())
