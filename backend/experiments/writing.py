"""Bring finished jobs to paper: one page and one JSON file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from backend.core.files import write_atomically
from backend.experiments.beyond import FORMAT as BEYOND_FORMAT
from backend.experiments.beyond_page import beyond_page, beyond_section
from backend.experiments.film import FILM
from backend.experiments.recipes import BOTTOMS, TWO, Recipe
from backend.experiments.tables import tables
from backend.experiments.tables_page import tables_page
from backend.jobs.store import JobStore

PAGE, DATA = "tables.html", "tables.json"
BEYOND_PAGE, BEYOND_DATA = "beyond.html", "beyond.json"


def write_tables(out: Path, recipe: Recipe, store: JobStore) -> tuple[Path, dict[str, Any]]:
    """Write what is finished to ``out``; returns the page's path and the content of the JSON."""
    found = tables(recipe, store)
    spec = recipe.twins()
    twins = store.result(spec.id) if store.has(spec.id) else None
    compared = compared_beside(out, found["bench_sha256"])
    if compared is not None:
        found["beyond"] = compared
    more = "" if compared is None else beyond_section(compared)
    page = tables_page(found, twins, _films(recipe, store), more)
    write_atomically(out / PAGE, page.encode())
    write_atomically(out / DATA, json.dumps(found, indent=1, sort_keys=True).encode() + b"\n")
    return out / PAGE, found


def write_beyond(out: Path, answer: Mapping[str, Any]) -> Path:
    """Write what strategies beyond the paper did; tables written there later show it too."""
    content = json.dumps(answer, indent=1, sort_keys=True).encode() + b"\n"
    write_atomically(out / BEYOND_DATA, content)
    write_atomically(out / BEYOND_PAGE, beyond_page(answer).encode())
    return out / BEYOND_DATA


def compared_beside(out: Path, bench_id: str) -> dict[str, Any] | None:
    """Return the comparison that lies beside the tables, if it is of the same bench."""
    try:
        answer = json.loads((out / BEYOND_DATA).read_text("utf-8"))
    except FileNotFoundError:
        return None
    same = answer.get("format") == BEYOND_FORMAT and answer.get("bench_sha256") == bench_id
    return dict(answer) if same else None


def program_version() -> str:
    """Return the version of the program, part of the name of every job."""
    try:
        return version("touchdown")
    except PackageNotFoundError:
        return "source tree"


def _films(recipe: Recipe, store: JobStore) -> list[tuple[str, str]]:
    """Return title and strip of the first trials of each piece on one bottom, and on two."""
    films = []
    for k, piece in enumerate(recipe.pieces):
        for bottoms in ((BOTTOMS[k % len(BOTTOMS)],), TWO):
            spec = recipe.stacking(piece, bottoms, "paper")
            if spec is None or not store.has(spec.id):
                continue
            path = store.folder(spec.id) / FILM
            if path.is_file():
                films.append((f"{piece.title()} on {' + '.join(bottoms)}", path.read_text("utf-8")))
    return films
