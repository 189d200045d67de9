"""Labelling costs nothing extra: no server, no account, hardly a package of its own."""

from __future__ import annotations

import ast
import sys
from importlib.metadata import files, packages_distributions
from importlib.util import find_spec
from pathlib import Path

OWN = "touchdown"
ELSEWHERE = (
    "touchdown.app.operate.workspace",
    "touchdown.app.stack.workspace",
    "touchdown.app.train.workspace",
)
ONLINE = {"requests", "urllib3", "httpx", "aiohttp", "websockets", "socketserver", "http"}
MOST_BYTES = 1_000_000


def exported(package: str) -> dict[str, str]:
    """Return the module that defines each name which a package exports."""
    stub = Path(*package.split("."), "__init__.pyi")
    if not stub.is_file():
        return {}
    return {
        name.name: f"{package}.{node.module}"
        for node in ast.parse(stub.read_text()).body
        if isinstance(node, ast.ImportFrom) and node.module
        for name in node.names
    }


def imported(path: Path) -> set[str]:
    """Return the modules that one file imports from, its own and others'."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            defined = exported(node.module)
            found |= {node.module} | {defined.get(n.name, node.module) for n in node.names}
    return found


def needed(*starts: str) -> set[str]:
    """Return all foreign top-level packages that these modules reach."""
    waiting, seen, foreign = list(starts), set(starts), set()
    while waiting:
        name = waiting.pop()
        path = Path(*name.split(".")).with_suffix(".py")
        if not path.is_file():
            continue
        for other in imported(path):
            if other.split(".")[0] != OWN:
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


def test_the_page_asks_for_less_than_a_megabyte_more_and_for_no_network(monkeypatch):
    monkeypatch.chdir(Path(__file__).parents[3])
    page = needed("touchdown.app.label.workspace")
    assert {"PySide6", "numpy", "zstandard"} <= page  # the walk found what is known to be there
    extra = page - needed(*ELSEWHERE)
    assert all(find_spec(package) for package in extra)
    assert sum(map(size_of, extra)) < MOST_BYTES
    assert not page & ONLINE
