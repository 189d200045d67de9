"""``touchdown doctor``: check this computer and name the fix for what is missing."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

from rich.table import Table
from rich.text import Text

from backend.verbs import check_lab, check_machine, check_packages
from backend.verbs.check import Check, Examine
from backend.verbs.screen import Screen

NAME = "doctor"
HELP = "check this computer, each finding with its fix"

EXAMINATIONS: tuple[Examine, ...] = (
    check_packages.check_python,
    check_packages.check_qt_versions,
    check_packages.check_qt_libraries,
    check_packages.check_qt_platform,
    check_machine.check_display,
    check_packages.check_opencv,
    check_packages.check_torch,
    check_packages.check_others,
    check_packages.check_mujoco,
    check_machine.check_processors,
    check_machine.check_cameras,
    check_machine.check_serial_ports,
    check_machine.check_data_folder,
    check_machine.check_disk,
    check_machine.check_catalogue,
    check_machine.check_models,
)

COLOURS = {"OK": "green", "NOTE": "yellow", "FAIL": "bold red"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        "--bench", type=Path, metavar="FILE", help="ask the devices of a lab file instead"
    )
    parser.add_argument(
        "--dataset",
        nargs="?",
        const="",
        metavar="DIR",
        help="check a dataset instead, changing nothing (default: the one in the data folder)",
    )


def run(args: argparse.Namespace, screen: Screen) -> int:
    """Print all findings; returns 1 if one of them stops Touchdown from working."""
    # Imported here so that the check does not load what it checks (OpenCV).
    from backend.runs.store import dataset_folder
    from backend.verbs.dataset_care import examine_only

    if args.dataset is not None:
        folder = Path(args.dataset) if args.dataset else dataset_folder()
        return examine_only(folder, screen)
    looks: list[Examine] = [partial(_examine, look) for look in EXAMINATIONS]
    if args.bench is not None:
        looks = list(check_lab.looks(args.bench))
    with screen.progress("Examining", len(looks)) as advance:
        checks = []
        for look in looks:
            checks.append(look())
            advance(len(checks), checks[-1].name)
    screen.show(findings(checks))
    failed = [check for check in checks if not check.ok]
    screen.say("Everything that is needed is here." if not failed else f"{len(failed)} to fix.")
    screen.result(
        {"checks": [{"name": c.name, "ok": c.ok, "detail": c.detail, "fix": c.fix} for c in checks]}
    )
    return 1 if failed else 0


def findings(checks: list[Check]) -> Table:
    """Return the table for people."""
    table = Table(title="touchdown doctor", show_lines=False)
    for column in ("", "check", "found", "what to do"):
        table.add_column(column, overflow="fold")
    for check in checks:
        word = Text(check.word, style=COLOURS[check.word])
        table.add_row(word, check.name, check.detail, check.fix)
    return table


def _examine(look: Examine) -> Check:
    name = look.__name__.removeprefix("check_").replace("_", " ")
    try:
        return look()
    except (ImportError, OSError) as error:
        # A damaged installation is what doctor is for: it must not end there.
        return Check(name, False, f"cannot be examined: {error}", "make setup")
