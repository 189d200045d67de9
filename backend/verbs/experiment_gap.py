"""``touchdown experiment gap``: the share of the way to the ceiling, from comparisons on disk."""

from __future__ import annotations

import argparse
import json
from typing import Any

from rich.table import Table

from backend.core.faults import InputError
from backend.verbs.experiment_report import written_whole
from backend.verbs.screen import Screen

Json = dict[str, Any]
KEPT, TABLE = "gap.json", "gap.md"


def tell_gap(args: argparse.Namespace, screen: Screen) -> Json:
    """Print the shares over all files of ``--beyond``, and leave them in ``--out``.

    Raises ``InputError`` for files that cannot be held together, or hold no paper or no ceiling.
    """
    # Imported here so that `touchdown --help` starts without torch.
    from backend.core.files import write_atomically
    from backend.experiments.compared import gap_sheet, markdown
    from backend.experiments.formats import BEYOND_FORMAT
    from backend.experiments.gap import merged_gaps
    from backend.experiments.reading import read_beyond

    stored = [(str(path), read_beyond(path)) for path in args.beyond]
    rows = merged_gaps(stored)
    if not rows:
        raise InputError(
            "The files hold no seeds of paper, ceiling and another strategy.",
            "--beyond",
            "Name each beyond.json that one of them stands in.",
        )
    sheet = gap_sheet(rows)
    table = Table(title=sheet.title)
    for column in sheet.columns:
        table.add_column(column)
    for row in sheet.rows:
        table.add_row(*row)
    screen.show(table)
    first = stored[0][1]
    content = {
        "format": BEYOND_FORMAT,
        "bench_sha256": first["bench_sha256"],
        "code": first["code"],
        "models": {},
        "cells": [],
        "pooled": [],
        "gaps": rows,
    }
    file = args.out / KEPT
    with written_whole(file):
        args.out.mkdir(parents=True, exist_ok=True)
        write_atomically(args.out / TABLE, markdown([sheet]).encode())
        write_atomically(file, json.dumps(content, indent=1, sort_keys=True).encode() + b"\n")
    screen.say(f"Written: {file} and {TABLE}")
    return {"file": str(file), "gaps": rows}
