"""Read what experiments wrote; a file that is something else, or damaged, is one clear error."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from backend.core.faults import InputError
from backend.experiments.by_seed import answers_in, trials_in
from backend.experiments.document import Report
from backend.experiments.formats import BEYOND_READABLE, TABLES_FORMAT
from backend.experiments.strategies_report import strategy_sections
from backend.experiments.tables_report import report_of

MOST_BYTES = 64 * 2**20
"""A report in full has one."""
Json = dict[str, Any]
STRANGE = (KeyError, TypeError, ValueError, AttributeError, IndexError)
"""What content of another shape raises where it is looked into."""


def read_report(file: Path) -> tuple[Json, Report]:
    """Return the content of a ``tables.json`` and its report; raises ``InputError``."""
    fix = "Name a tables.json, as `touchdown experiment tables` writes it."
    found = _read(file, (TABLES_FORMAT,), fix)
    try:
        return found, report_of(found)
    except STRANGE as error:
        raise InputError(_damaged(error), str(file), fix) from error


def read_beyond(file: Path) -> Json:
    """Return the content of a ``beyond.json``; raises ``InputError``."""
    fix = "Name a beyond.json, as `touchdown experiment beyond` writes it."
    found = _read(file, BEYOND_READABLE, fix)
    try:
        strategy_sections({"table2": [], "table3": [], "beyond": [found]})
        str(found["bench_sha256"])
        trials_in(found)
        answers_in(found)
    except STRANGE as error:
        raise InputError(_damaged(error), str(file), fix) from error
    return found


def _read(file: Path, wanted: tuple[str, ...], fix: str) -> Json:
    try:
        if file.stat().st_size > MOST_BYTES:
            raise InputError(f"It has more than {MOST_BYTES >> 20} MB.", str(file), fix)
        found = json.loads(file.read_bytes())
    except OSError as error:
        what = f"It cannot be read: {error.strerror or error}."
        raise InputError(what, str(file), fix) from error
    except (ValueError, RecursionError) as error:
        raise InputError("It is no JSON, or damaged.", str(file), fix) from error
    said = found.get("format") if isinstance(found, dict) else None
    if said not in wanted:
        what = f"It says to be '{said}' and not '{wanted[-1]}'." if said else "It is no report."
        raise InputError(what, str(file), fix)
    return dict(found)


def _damaged(error: Exception) -> str:
    return f"Its content is damaged ({type(error).__name__}: {error})."
