"""Register of measured figures, their stored results and the page that shows them.

A figure is a function in a module of this folder; ``MODULES`` of ``run.py`` names the modules::

    @figure("tracking")
    def tracker_speed() -> list[Figure]:
        return [Figure("tracker, median per frame", 0.8, "ms", "<= 1 (must 2)", ok=True)]

``docs/results/measured.json`` holds one record a figure. ``python -m tests.bench.figures`` renders
``docs/measured.md`` from it; ``python -m tests.bench.run --save`` replaces the records of the
measurements that it ran and renders the page. Figures named after ``--remove`` are dropped.
"""

import argparse
import datetime
import json
import os
import platform
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from touchdown.backend.core.files import write_atomically

DOCS = Path(__file__).resolve().parents[2] / "docs"
DATA, PAGE = DOCS / "results" / "measured.json", DOCS / "measured.md"
FORMAT = "touchdown-measured/1"
KEYS = (
    "date", "machine", "group", "measure", "figure", "value", "unit", "target", "met", "note",
)  # fmt: skip
RESULTS = {True: "met", False: "**missed**", None: ""}
BLOCK = re.compile(r"(<!-- figures -->\n).*(\n<!-- end -->)", re.DOTALL)
Record = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Figure:
    """One measured figure. ``ok`` None: no target, or not measured (``note`` gives the reason)."""

    name: str
    value: float | str | None
    unit: str
    target: str
    ok: bool | None
    note: str = ""


def at_most(name: str, value: float, unit: str, limit: float, note: str = "") -> Figure:
    return Figure(name, value, unit, f"<= {limit:g}", bool(value <= limit), note)


def at_least(name: str, value: float, unit: str, limit: float, note: str = "") -> Figure:
    return Figure(name, value, unit, f">= {limit:g}", bool(value >= limit), note)


def failures(name: str, count: int, unit: str = "", note: str = "") -> Figure:
    return Figure(name, count, unit, "0", not count, note)


def stated(name: str, value: float | str, unit: str, note: str = "") -> Figure:
    return Figure(name, value, unit, "stated", None, note)


def paired(
    name: str, ours: Callable[[], float], theirs: Callable[[], float], limit: float, pairs: int = 5
) -> Figure:
    """Return the median ratio of two costs, measured by turns; ``limit`` inf: no target.

    The note has the spread of the ratio over the pairs, and the medians of both.
    """
    costs = np.array(
        [(ours(), theirs()) if k % 2 == 0 else (theirs(), ours())[::-1] for k in range(pairs)]
    )
    ratio = costs[:, 0] / costs[:, 1]
    own, other = np.median(costs, axis=0)
    note = f"{ratio.min():.3g} to {ratio.max():.3g} in {pairs} pairs; {own:.4g} beside {other:.4g}"
    if np.isinf(limit):
        return stated(name, float(np.median(ratio)), "", note)
    return at_most(name, float(np.median(ratio)), "", limit, note)


Measure = Callable[[], list[Figure]]
REGISTER: dict[str, tuple[str, Measure]] = {}
LONG: set[str] = set()


def figure(group: str, *, long: bool = False) -> Callable[[Measure], Measure]:
    """Register a function that measures one or more figures; ``group`` selects it by name.

    A ``long`` one takes many minutes, or is a study: it only runs if it or its group is named.
    """

    def register(measure: Measure) -> Measure:
        if measure.__name__ in REGISTER:
            raise ValueError(f"two figures are called {measure.__name__}")
        REGISTER[measure.__name__] = (group, measure)
        if long:
            LONG.add(measure.__name__)
        return measure

    return register


def read_records() -> list[Record]:
    """Return the stored records; raises ValueError for another format."""
    content = json.loads(DATA.read_text("utf-8"))
    if content["format"] != FORMAT:
        raise ValueError(f"{DATA} has the format {content['format']}")
    return list(content["figures"])


def records_of(
    group: str, measure: str, figures: Iterable[Figure], seconds: float | None = None
) -> list[Record]:
    """Return the records of what one function measured today on this computer, in ``seconds``."""
    machine = f"{os.cpu_count()} cores, {platform.platform()}, CPython {platform.python_version()}"
    date = datetime.datetime.now(tz=datetime.UTC).date().isoformat()
    took = {} if seconds is None else {"seconds": round(seconds, 1)}
    return [
        dict(zip(KEYS, (date, machine, group, measure, f.name, f.value, f.unit, f.target, f.ok,
                        f.note), strict=True)) | took
        for f in figures
        if f.value is not None
    ]  # fmt: skip


def merge_records(stored: Sequence[Record], new: Sequence[Record]) -> list[Record]:
    """Return ``stored`` with the records of each function in ``new`` replaced, groups together."""
    measured = {record["measure"] for record in new}
    kept = [record for record in stored if record["measure"] not in measured]
    groups = list(dict.fromkeys(record["group"] for record in (*stored, *new)))
    return sorted((*kept, *new), key=lambda record: groups.index(record["group"]))


def save(new: Sequence[Record], removed: Iterable[str] = ()) -> None:
    """Store the records, without the figures named in ``removed``, and render the page."""
    stored = read_records()
    if unknown := set(removed) - {record["figure"] for record in stored}:
        raise ValueError(f"there is no figure {', '.join(sorted(unknown))}")
    kept = [record for record in stored if record["figure"] not in set(removed)]
    records = merge_records(kept, new)
    lines = ",\n".join("  " + json.dumps(record, ensure_ascii=False) for record in records)
    content = f'{{\n "format": "{FORMAT}",\n "figures": [\n{lines}\n ]\n}}\n'
    write_atomically(DATA, content.encode())
    write_atomically(PAGE, page(PAGE.read_text("utf-8"), records).encode())


def page(text: str, records: Sequence[Record]) -> str:
    found, count = BLOCK.subn(lambda match: match[1] + tables(records) + match[2], text)
    if count != 1:
        raise ValueError(f"{count} places for the figures")
    return found


def tables(records: Sequence[Record]) -> str:
    """Return the summary, the missed targets and a table a group, as Markdown."""
    results = [record["met"] for record in records]
    missed = [record for record in records if record["met"] is False]
    parts = [
        f"{len(records)} figures: {results.count(True)} meet their target, {len(missed)} miss it, "
        f"{results.count(None)} have none.",
        "## Missed targets",
        _table(
            ("group", "figure", "measured", "target", "remark"),
            ((r["group"], r["figure"], value(r), target(r), r["note"]) for r in missed),
        ),
    ]
    for group, part in groupby(records, key=lambda record: record["group"]):
        parts.append(f"## Group {group}")
        own_records = list(part)
        if took := duration(own_records):
            parts.append(took)
        by_machine: dict[str, list[Record]] = {}
        for record in own_records:
            by_machine.setdefault(record["machine"], []).append(record)
        for machine, own in by_machine.items():
            rows = ((r["figure"], value(r), target(r), RESULTS[r["met"]], r["date"]) for r in own)
            parts.append(f"Machine: {machine}.")
            parts.append(_table(("figure", "measured", "target", "result", "date"), rows))
    return "\n\n".join(parts)


def duration(records: Sequence[Record]) -> str:
    """Return a sentence with the time of the measurements of which it is stored, "" without any."""
    times = {record["measure"]: record["seconds"] for record in records if "seconds" in record}
    if not times:
        return ""
    every = len({record["measure"] for record in records})
    whole = sum(times.values()) / 60.0
    return f"Time of {len(times)} of {every} measurements: {whole:.1f} min."


def value(record: Record) -> str:
    number = record["value"]
    if isinstance(number, float):
        number = f"{number:,.0f}" if number >= 1000 else f"{number:.4g}"
    elif isinstance(number, int):
        number = f"{number:,}"
    return f"{number} {record['unit']}".strip()


def target(record: Record) -> str:
    """Return the target with its unit; "" where the figure is only stated."""
    text = record["target"]
    if text == "stated":
        return ""
    return text.replace("<=", "≤").replace(">=", "≥")


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = (header, ("---",) * len(header), *rows)
    return "\n".join(f"| {' | '.join(row)} |" for row in lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Render docs/measured.md.")
    parser.add_argument("--remove", nargs="+", default=(), metavar="FIGURE")
    save([], parser.parse_args().remove)
    sys.stdout.write(f"{PAGE}\n")
