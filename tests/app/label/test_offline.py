"""Labelling costs nothing extra: no server, no account, hardly a package of its own."""

from __future__ import annotations

import sys
from importlib.metadata import files, packages_distributions
from importlib.util import find_spec
from pathlib import Path

from tests.import_contracts import imports

ELSEWHERE = (
    "touchdown.app.operate.workspace",
    "touchdown.app.stack.workspace",
    "touchdown.app.train.workspace",
)
ONLINE = {"requests", "urllib3", "httpx", "aiohttp", "websockets", "socketserver", "http"}
MOST_BYTES = 1_000_000


def needed(*starts: str) -> set[str]:
    """Return all foreign top-level packages that these modules reach."""
    graph = imports()
    waiting, seen, foreign = list(starts), set(starts), set()
    while waiting:
        for other in graph.get(waiting.pop(), ()):
            if other.split(".")[0] != "touchdown":
                foreign.add(other.split(".")[0])
            elif other not in seen:
                seen.add(other)
                waiting.append(other)
    return foreign - set(sys.stdlib_module_names) - {"__future__"} | (foreign & ONLINE)


def size_of(package: str) -> int:
    """Return the bytes of the distributions that a package comes from."""
    return sum(
        Path(file.locate()).stat().st_size
        for name in packages_distributions().get(package, ())
        for file in files(name) or ()
        if Path(file.locate()).is_file() and "__pycache__" not in file.parts
    )


def test_the_page_asks_for_less_than_a_megabyte_more_and_for_no_network() -> None:
    page = needed("touchdown.app.label.workspace")
    assert {"PySide6", "numpy", "zstandard"} <= page  # the walk found what is known to be there
    extra = page - needed(*ELSEWHERE)
    assert all(find_spec(package) for package in extra)
    assert sum(map(size_of, extra)) < MOST_BYTES
    assert not page & ONLINE
