"""The public API: its names, signatures, documentation and examples."""

import ast
import doctest
import inspect
import os
import re
import shutil
import subprocess
import sys
from enum import Enum
from pathlib import Path

import pytest

import touchdown as td

ROOT = Path(__file__).resolve().parents[1]
# Reviewed by hand: run `python -m tests.test_public_api` to write it anew after a change.
SNAPSHOT = ROOT / "tests" / "data" / "public-api.txt"
WRITTEN = ROOT / "tests" / "data" / "written_0_1"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")), ROOT / "CONTRIBUTING.md"]
PUBLIC = sorted(set(td.__all__) - {"__version__"})
BLOCK = re.compile(r"^```python( no-run)?\n(.*?)^```", re.MULTILINE | re.DOTALL)


def signature_of(name: str) -> list[str]:
    """Return the lines of the snapshot for one public name."""
    item = getattr(td, name)
    if not inspect.isclass(item):
        return [f"{name}{inspect.signature(item)}"]
    if issubclass(item, Enum):
        return [f"{name}: {', '.join(member.name for member in item)}"]
    lines = [name] if issubclass(item, Exception) else [f"{name}{inspect.signature(item)}"]
    for member, value in sorted(vars(item).items()):
        if member.startswith("_") or member in ("model_config", "model_post_init"):
            continue
        plain = inspect.unwrap(getattr(value, "__func__", value))
        if inspect.isfunction(plain):
            lines.append(f"    {member}{inspect.signature(plain)}")
        elif isinstance(value, property):
            lines.append(f"    {member}: property")
    return lines


def snapshot() -> str:
    text = "\n".join(line for name in PUBLIC for line in signature_of(name)) + "\n"
    return re.sub(r" at 0x[0-9a-f]+", "", text)


def test_the_api_is_the_reviewed_one_that_a_reader_can_hold() -> None:
    assert 25 <= len(PUBLIC) <= 35
    assert snapshot() == SNAPSHOT.read_text("utf-8")
    assert set(td.__all__) <= set(dir(td))
    with pytest.raises(AttributeError):
        _ = td.no_such_name


def sections(name: str) -> set[str]:
    text = inspect.getdoc(getattr(td, name)) or ""
    return set(re.findall(r"^([A-Z][A-Za-z ]+)\n-{3,}$", text, re.MULTILINE))


@pytest.mark.parametrize("name", PUBLIC)
def test_a_public_name_has_numpydoc_sections(name: str) -> None:
    item = getattr(td, name)
    found = sections(name)
    if inspect.isclass(item):
        assert found & {"Parameters", "Attributes"}, found
    else:
        assert "Parameters" in found or not inspect.signature(item).parameters
        assert found & {"Returns", "Yields"}, found
    assert "Examples" in found, found


@pytest.mark.parametrize("name", PUBLIC)
def test_the_example_of_a_public_name_runs(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    item = getattr(td, name)
    names = vars(sys.modules[item.__module__]) | {"td": td}
    tests = [t for t in doctest.DocTestFinder().find(item, name, globs=names) if t.examples]
    assert tests, "no example"
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
    failed = [test.name for test in tests if runner.run(test).failed]
    assert failed == []


def blocks(path: Path) -> list[str]:
    """Return the Python of a page that is meant to run, in order."""
    return [code for mark, code in BLOCK.findall(path.read_text("utf-8")) if not mark]


# The program of the README stands in docs/python.md as well, where it runs.
RUNNABLE = [path for path in PAGES if blocks(path) and path != ROOT / "README.md"]


def furnish(folder: Path) -> None:
    """Put the files that the pages name into ``folder``: an episode, packs, a dataset, runs."""
    shutil.unpack_archive(WRITTEN / "dataset.zip", folder / "data" / "dataset")
    shutil.copy(next((folder / "data" / "dataset" / "raw").rglob("*.mcap")), folder / "0190.mcap")
    shutil.copytree(WRITTEN / "pack", folder / "data" / "packs")
    shutil.copytree(WRITTEN / "runs", folder / "output" / "demo" / "runs")
    for suffix in ("json", "safetensors"):
        shutil.copy(ROOT / "resources" / "models" / f"pot.{suffix}", folder)


@pytest.mark.parametrize("path", RUNNABLE, ids=[str(p.relative_to(ROOT)) for p in RUNNABLE])
def test_the_python_of_a_page_runs(path: Path, tmp_path: Path) -> None:
    """The blocks of a page run one after the other, as one script beside the files they name."""
    furnish(tmp_path)
    (tmp_path / "script.py").write_text("\n".join(blocks(path)), "utf-8")
    done = subprocess.run(
        [sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, timeout=300,
        env=os.environ | {"TOUCHDOWN_DATA": str(tmp_path / "data")}, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]


def test_stacking_takes_five_statements() -> None:
    """README: one statement a line, no helper written for the example."""
    (code,) = blocks(ROOT / "README.md")
    assert code in blocks(ROOT / "docs" / "python.md")
    tree = ast.parse(code)
    statements = [node for node in ast.walk(tree) if isinstance(node, ast.stmt)]
    assert len(statements) <= 5
    assert len(statements) == len([line for line in code.splitlines() if line.strip()])
    assert not any(isinstance(node, ast.FunctionDef | ast.Lambda) for node in ast.walk(tree))


if __name__ == "__main__":
    SNAPSHOT.write_text(snapshot(), "utf-8")
