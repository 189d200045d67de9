"""Bring finished jobs to paper: one page and one JSON file."""

from __future__ import annotations

import json
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from backend.core.files import write_atomically
from backend.experiments.kinds import FILM
from backend.experiments.recipes import BOTTOMS, TWO, Recipe
from backend.experiments.tables import tables
from backend.experiments.tables_page import tables_page
from backend.jobs.store import JobStore

PAGE, DATA = "tables.html", "tables.json"


def write_tables(out: Path, recipe: Recipe, store: JobStore) -> tuple[Path, dict[str, Any]]:
    """Write what is finished to ``out``; returns the page's path and the content of the JSON."""
    found = tables(recipe, store)
    spec = recipe.twins()
    twins = store.result(spec.id) if store.has(spec.id) else None
    page = tables_page(found, twins, _films(recipe, store))
    write_atomically(out / PAGE, page.encode())
    write_atomically(out / DATA, json.dumps(found, indent=1, sort_keys=True).encode() + b"\n")
    return out / PAGE, found


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
