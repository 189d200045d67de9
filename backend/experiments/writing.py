"""Bring finished jobs to paper: one page and one JSON file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from backend.core.faults import InputError
from backend.core.files import write_atomically
from backend.experiments.beyond_page import beyond_page
from backend.experiments.compared import markdown, sheets
from backend.experiments.film import FILM
from backend.experiments.gap import merged_gaps
from backend.experiments.reading import read_beyond, read_report
from backend.experiments.recipes import BOTTOMS, TWO, Recipe
from backend.experiments.tables import tables
from backend.experiments.tables_page import tables_page
from backend.experiments.tables_report import report_of
from backend.jobs.store import JobStore

PAGE, DATA = "tables.html", "tables.json"
BEYOND_PAGE, BEYOND_DATA, BEYOND_TABLES = "beyond.html", "beyond.json", "beyond.md"
Json = dict[str, Any]


def write_tables(out: Path, recipe: Recipe, store: JobStore) -> tuple[Path, Json]:
    """Write what is finished to ``out``; returns the page's path and the content of the JSON."""
    found = tables(recipe, store)
    spec = recipe.twins()
    twins = store.result(spec.id) if store.has(spec.id) else None
    found["figures"] = {"twins": twins, "films": _films(recipe, store)}
    compared = compared_beside(out, found["bench_sha256"])
    if compared is not None:
        found["beyond"] = [compared]
    return _written(out / DATA, found), found


def rewrite_tables(file: Path, compared: Sequence[Path]) -> Path:
    """Give a ``tables.json`` other comparisons, and write its page anew; returns the page's path.

    Without ``compared`` it keeps those that it has. Raises ``InputError`` for a file that holds
    something else, or a comparison on another bench.
    """
    found = dict(read_report(file)[0])
    answers = []
    for path in compared:
        answer = read_beyond(path)
        if answer["bench_sha256"] != found["bench_sha256"]:
            raise InputError("It was made on another bench.", str(path), f"Leave it out of {file}.")
        answers.append(answer)
    if answers:
        found["beyond"] = answers
        found["gaps"] = _gaps_over(compared, answers)
    return _written(file, found)


def _written(file: Path, found: Json) -> Path:
    """Write the page beside ``file``, then the file; returns the page's path."""
    page = file.with_suffix(".html")
    write_atomically(page, tables_page(report_of(found)).encode())
    write_atomically(file, json.dumps(found, indent=1, sort_keys=True).encode() + b"\n")
    return page


def _gaps_over(files: Sequence[Path], answers: Sequence[Json]) -> list[Json]:
    """Return the shares of the way over all files; those of each where they hold a cell twice."""
    try:
        return merged_gaps([(str(f), a) for f, a in zip(files, answers, strict=True)])
    except InputError:
        return [row for answer in answers for row in answer.get("gaps") or ()]


def write_beyond(out: Path, answer: Mapping[str, Any]) -> Path:
    """Write what strategies beyond the paper did; tables written there later show it too."""
    content = json.dumps(answer, indent=1, sort_keys=True).encode() + b"\n"
    write_atomically(out / BEYOND_DATA, content)
    write_atomically(out / BEYOND_PAGE, beyond_page(answer).encode())
    write_atomically(out / BEYOND_TABLES, markdown(sheets(answer)).encode())
    return out / BEYOND_DATA


def compared_beside(out: Path, bench_id: str) -> Json | None:
    """Return the comparison that lies beside the tables, if it is of the same bench.

    Raises ``InputError`` for a damaged one.
    """
    if not (out / BEYOND_DATA).exists():
        return None
    answer = read_beyond(out / BEYOND_DATA)
    return answer if answer["bench_sha256"] == bench_id else None


def program_version() -> str:
    """Return the version of the program, part of the name of every job."""
    try:
        return version("touchdown")
    except PackageNotFoundError:
        return "source tree"


def _films(recipe: Recipe, store: JobStore) -> list[Json]:
    """Return the first trials of each piece on one bottom, and on two, probe by probe."""
    films = []
    for k, piece in enumerate(recipe.pieces):
        for bottoms in ((BOTTOMS[k % len(BOTTOMS)],), TWO):
            spec = recipe.stacking(piece, bottoms, "paper")
            if spec is None or not store.has(spec.id):
                continue
            path = store.folder(spec.id) / FILM
            if path.is_file():
                title = f"{piece.title()} on {' + '.join(bottoms)}"
                films += [{"title": title, **film} for film in json.loads(path.read_bytes())]
    return films
