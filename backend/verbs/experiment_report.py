"""``touchdown experiment report``: the page of tables that are there, and tables held together."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from backend.core.faults import InputError
from backend.verbs.screen import Screen

Json = dict[str, Any]


def add_report_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    report = parser.add_argument_group("report")
    report.add_argument("--tables", type=Path, metavar="JSON", help="the tables.json whose page is "
                        "written anew, beside it (default: that of --out)")  # fmt: skip
    report.add_argument("--beyond", type=Path, nargs="+", default=[], metavar="JSON", help="its "
                        "comparisons of strategies from now on: each a beyond.json of the same "
                        "bench (default: those that it has); gap: those to count")  # fmt: skip


@contextmanager
def written_whole(where: Path) -> Iterator[None]:
    """Turn a disk that refuses into ``InputError``; files are as they were, or whole."""
    try:
        yield
    except OSError as error:
        raise InputError(
            f"It could not be written: {error.strerror or error}.",
            str(error.filename or where),
            "Free some space, or name another folder; finished jobs are kept.",
        ) from error


def write_anew(args: argparse.Namespace, screen: Screen) -> Json:
    """Write the page, and the comparisons into the JSON; raises ``InputError`` for a bad file."""
    from backend.experiments.writing import DATA, rewrite_tables

    file = args.tables or args.out / DATA
    with written_whole(file):
        page = rewrite_tables(file, args.beyond)
    screen.say(f"Written: {page}")
    return {"page": str(page), "file": str(file)}


def tables_to_compare(file: Path | None) -> Json | None:
    """Return the content of a tables.json that others are held against, None without one.

    Read before the first job: a wrong file is told at once. Raises ``InputError``.
    """
    from backend.experiments.reading import read_report

    return None if file is None else read_report(file)[0]


def compare(answer: Json, other: Json, file: Path, screen: Screen) -> None:
    """Tell which 95 % intervals of ``answer`` miss the values of ``other``, read from ``file``."""
    from backend.experiments.reading import STRANGE
    from backend.experiments.within import within

    try:
        found = within(answer, other)
    except STRANGE as error:
        what = f"There are no tables to compare with: {error}."
        raise InputError(what, str(file), "Name a tables.json.") from error
    agree = found.cells - len(found.outside)
    screen.say(f"{agree} of {found.cells} cells agree with {file}")
    for name in found.outside:
        screen.say(f"  not: {name}")
