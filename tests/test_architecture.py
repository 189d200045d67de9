"""House rules that no other tool checks: sizes, names, output, hosts. (Layers: import-linter.)"""

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("app", "widgets", "backend")
CODE = sorted(path for name in PACKAGES for path in (ROOT / name).rglob("*.py"))
TESTS = sorted((ROOT / "tests").rglob("*.py"))
TEXTS = sorted(
    path
    for pattern in (
        "*.md",
        "*.toml",
        "*.txt",
        "Makefile",
        ".ci/*",
        "docs/**/*.md",
        "resources/**/*.toml",
    )
    for path in ROOT.glob(pattern)
    if path.is_file()
)
TOP = {"app", "widgets", "backend", "resources", "tests", "docs", ".ci"}
FORBIDDEN_NAMES = {"utils", "util", "helpers", "helper", "manager", "common", "misc", "base"}


def _name(path: Path) -> str:
    return str(path.relative_to(ROOT))


@cache
def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def _nodes(path: Path) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(_tree(path)))


@pytest.fixture(autouse=True, scope="module")
def _forgotten() -> Iterator[None]:
    """Give back the trees of all files, 100 MB."""
    yield
    _tree.cache_clear()
    _nodes.cache_clear()


def _calls(path: Path, *names: str) -> list[ast.Call]:
    return [
        node
        for node in _nodes(path)
        if isinstance(node, ast.Call)
        and (
            (isinstance(node.func, ast.Name) and node.func.id in names)
            or (isinstance(node.func, ast.Attribute) and node.func.attr in names)
        )
    ]


def test_the_tree_was_found():
    assert len(CODE) > 50


def test_a_file_has_at_most_400_lines():
    sizes = {_name(p): len(p.read_text(encoding="utf-8").splitlines()) for p in CODE + TESTS}
    assert {name: size for name, size in sizes.items() if size > 400} == {}


def test_a_function_has_at_most_60_lines():
    long = [
        f"{_name(path)}:{node.name}"
        for path in CODE
        for node in _nodes(path)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and node.end_lineno - node.lineno + 1 > 60
    ]
    assert long == []


def test_a_file_opens_with_a_sentence():
    assert [_name(path) for path in CODE if not ast.get_docstring(_tree(path))] == []


def test_names_say_what_is_inside():
    def words(path):
        return {w for part in path.relative_to(ROOT).with_suffix("").parts for w in part.split("_")}

    assert [_name(path) for path in CODE if words(path) & FORBIDDEN_NAMES] == []


def test_nothing_is_printed():
    prints = [
        f"{_name(path)}:{call.lineno}"
        for path in CODE
        for call in _calls(path, "print")
        if isinstance(call.func, ast.Name)
    ]
    assert prints == []


def test_style_sheets_have_one_door():
    users = [_name(p) for p in CODE if _calls(p, "setStyleSheet")]
    assert [name for name in users if not name.startswith("widgets/base/theme")] == []


def test_no_signal_carries_samples():
    """Samples are pulled at the display's pace: a burst of signals would starve the event loop."""
    samples = {"TactileFrame", "MarkerField", "Samples", "Recording", "ndarray"}
    carriers = [
        f"{_name(path)}:{call.lineno}"
        for path in CODE
        for call in _calls(path, "Signal")
        if samples & {n.id for n in ast.walk(call) if isinstance(n, ast.Name)}
        or samples & {n.attr for n in ast.walk(call) if isinstance(n, ast.Attribute)}
    ]
    assert carriers == []


def test_the_window_starts_no_qthread():
    assert [
        _name(path) for path in CODE if re.search(r"\bQThread\b", path.read_text("utf-8"))
    ] == []


def test_only_the_live_bench_and_writers_start_threads():
    starters = {_name(p) for p in CODE if _calls(p, "Thread", "ThreadPoolExecutor")}
    assert not {name for name in starters if name.startswith("widgets/")}


# Written in pieces, so that this file does not match itself.
MACHINE_PATH = re.compile(r"(?<![\w.~$}])/" + r"(?:work|root|tmp|home/\w+)/")
HOST = re.compile("py" + "pi\\.org|python" + "hosted|download\\.py" + "torch|hugging" + "face\\.co")


@pytest.mark.parametrize("rule", [MACHINE_PATH, HOST], ids=["machine path", "package host"])
def test_no_machine_path_and_no_package_host(rule):
    offenders = {_name(p): rule.findall(p.read_text("utf-8")) for p in CODE + TESTS + TEXTS}
    assert {name: found for name, found in offenders.items() if found} == {}


def test_the_machine_path_rule_can_fail():
    assert MACHINE_PATH.search("open('/" + "tmp/x')")
    assert not MACHINE_PATH.search("~/tmp" + "/x and docs/tmp" + "/x")


def test_no_other_top_level_folder():
    done = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        pytest.skip("not a git checkout")
    tops = {line.split("/")[0] for line in done.stdout.splitlines() if "/" in line}
    assert tops <= TOP


IMPORTED_AS = {
    "PySide6-Essentials": {"PySide6", "shiboken6"},
    "opencv-contrib-python-headless": {"cv2"},
    "pyserial": {"serial"},
}


def test_what_is_imported_is_declared_and_nothing_else():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    names = [re.match(r"[A-Za-z0-9_-]+", wanted)[0] for wanted in project["dependencies"]]
    declared = {module for name in names for module in IMPORTED_AS.get(name, {name})}
    imported = set()
    for path in CODE:
        for node in _nodes(path):
            if isinstance(node, ast.Import):
                imported |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                imported.add(node.module.split(".")[0])
    imported -= sys.stdlib_module_names | set(PACKAGES) | {"resources"}
    assert imported - declared == set()
    assert declared - imported - {"shiboken6"} == set()


def test_mujoco_has_one_door():
    """It is optional and imported by name, which the import contracts do not see."""
    imports = re.compile(r"""import_module\(["']mujoco|^\s*(import|from) mujoco""", re.MULTILINE)
    doors = [_name(path) for path in CODE if imports.search(path.read_text("utf-8"))]
    assert doors == ["backend/simulation/release_mujoco.py"]
