"""House rules that no other tool checks: sizes, packages, output, hosts.

Layers and exports are checked by import-linter.
"""

import ast
import gc
import re
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from tests.import_contracts import imports
from touchdown.backend.jobs import lazy_exports

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("app", "widgets", "backend", "touchdown")
CODE = sorted(
    path
    for name in PACKAGES
    for path in (ROOT / name).rglob("*.py")
    if not any(part.is_symlink() for part in path.parents)
)
TESTS = sorted((ROOT / "tests").rglob("*.py"))
MODULES, LINES = 470, 108_000
TEXT_FILES = [
    "*.md",
    "*.toml",
    "*.txt",
    "*.cff",
    "Makefile",
    ".ci/*",
    ".github/**/*",
    "docs/**/*.md",
]
TEXT_FILES += ["resources/**/*.toml"]
TEXTS = sorted(p for pattern in TEXT_FILES for p in ROOT.glob(pattern) if p.is_file())
TOP = {
    ".ci",
    ".github",
    "app",
    "backend",
    "docs",
    "examples",
    "resources",
    "tests",
    "touchdown",
    "widgets",
}


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
    """Give back the trees of all files, 100 MB; until then no collector looks through them."""
    gc.disable()
    yield
    gc.enable()
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


def test_the_tree_stays_small() -> None:
    lines = sum(len(p.read_text("utf-8").splitlines()) for p in CODE)
    assert 50 < len(CODE) <= MODULES
    assert lines <= LINES


def test_a_class_name_has_one_meaning() -> None:
    names = Counter(n.name for p in CODE for n in _nodes(p) if isinstance(n, ast.ClassDef))
    assert [name for name, count in names.items() if count > 1] == []


def test_a_module_has_at_most_900_lines() -> None:
    sizes = {_name(p): len(p.read_text("utf-8").splitlines()) for p in CODE + TESTS}
    assert {name: size for name, size in sizes.items() if size > 900} == {}


def test_a_folder_has_at_most_20_modules() -> None:
    sizes = Counter(p.parent for p in CODE if p.name not in ("__init__.py", "__main__.py"))
    assert {_name(folder): n for folder, n in sizes.items() if n > 20} == {}


LAZY = "__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)"


def _is_declaration(node: ast.stmt) -> bool:
    typing_only = isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    return isinstance(node, ast.Import | ast.ImportFrom) or typing_only


def test_an_init_holds_docstring_imports_and_the_lazy_table() -> None:
    others = [
        f"{_name(path)}:{node.lineno}"
        for path in CODE
        if path.name == "__init__.py"
        for node in _tree(path).body[1:]
        if not _is_declaration(node) and ast.unparse(node) != ast.unparse(ast.parse(LAZY))
    ]
    assert others == []


def test_an_export_is_one_line_of_the_stub() -> None:
    """Only the root repeats its packages: chains of import-linter may lead through it."""
    for init in (p for p in CODE if p.name == "__init__.py" and p.with_suffix(".pyi").is_file()):
        stub = _tree(init.with_suffix(".pyi")).body
        names = [a.asname for n in stub if isinstance(n, ast.ImportFrom) for a in n.names]
        assert len(names) == len(set(names)), _name(init)
        assert not [n for n in stub if isinstance(n, ast.Assign)], _name(init)
        typed = {
            f"{node.module}.{alias.name}"
            for node in _nodes(init)
            if isinstance(node, ast.ImportFrom) and node.module == "touchdown.backend"
            for alias in node.names
        }
        listed = {f"touchdown.{n.module}" for n in stub if isinstance(n, ast.ImportFrom)}
        assert typed == (listed if _package(init) == "touchdown" else set()), _name(init)


def test_no_export_has_the_name_of_a_module_beside_it() -> None:
    """After ``import r.train`` a function ``train`` exported by ``r`` would be the module."""
    clashes = []
    for init in (p for p in CODE if p.name == "__init__.py"):
        beside = {p.stem for p in init.parent.iterdir() if p.suffix == ".py" or p.is_dir()}
        clashes += [
            f"{_package(init)}.{n}" for n in lazy_exports(init, _package(init)) if n in beside
        ]
    assert clashes == []


def test_no_export_comes_from_a_module_that_is_started() -> None:
    """``python -m`` would make a second copy of a module that its package has imported."""
    started = {_package(p) for p in CODE if '__name__ == "__main__"' in p.read_text("utf-8")}
    assert len(started) > 3
    for init in (p for p in CODE if p.name == "__init__.py"):
        assert not started & set(lazy_exports(init, _package(init)).values()), _name(init)


def test_simulated_devices_are_exported_by_simulation_alone() -> None:
    for init in (p for p in CODE if p.name == "__init__.py"):
        package = _package(init)
        if not package.startswith("touchdown.backend.simulation"):
            defined = lazy_exports(init, package).values()
            assert not any(m.startswith("touchdown.backend.simulation") for m in defined), package


def test_modules_do_not_import_each_other_in_a_circle() -> None:
    graph = imports()
    within = {module: graph[module] & graph.keys() - {module} for module in graph}
    TopologicalSorter(within).prepare()  # an error names a circle


BARE = re.compile(r"\b(from|import)\b[^\n.]*\b(app|backend|widgets|resources)\b")


def test_no_folder_is_imported_by_its_bare_name() -> None:
    """A class that is imported by two names exists twice."""
    bare = [
        f"{_name(path)}:{node.lineno}"
        for path in CODE + TESTS
        if BARE.search(path.read_text("utf-8"))  # most files are not parsed for it
        for node in _nodes(path)
        for name in _imported(node)
        if name.split(".")[0] in {"app", "backend", "widgets", "resources"}
    ]
    assert bare == []


def _imported(node: ast.AST) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    return [node.module] if isinstance(node, ast.ImportFrom) and node.module else []


def test_the_packages_of_the_wheel_are_those_of_the_tree() -> None:
    setuptools = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["setuptools"]
    inits = [p for p in CODE if p.name == "__init__.py"] + [ROOT / "resources" / "__init__.py"]
    assert sorted(setuptools["packages"]) == sorted(_package(p) for p in inits)


def _package(path: Path) -> str:
    """Return the dotted name of a product module as it is imported."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    name = ".".join(parts if parts[0] == "touchdown" else ("touchdown", *parts))
    return name.removesuffix(".__init__")


def test_style_sheets_have_one_door():
    users = [_name(p) for p in CODE if _calls(p, "setStyleSheet")]
    assert [name for name in users if not name.startswith("widgets/base/theme")] == []


WIDGET_TEXTS = ("QPushButton", "QCheckBox", "QLabel", "setText", "setToolTip", "setPlaceholderText",
                "setWindowTitle", "setAccessibleName", "setAccessibleDescription")  # fmt: skip


def test_literals_reach_a_widget_through_the_translation():
    found = []
    # The splash is shown before a translation is loaded.
    for path in (p for p in CODE if _name(p).startswith(("app/", "widgets/"))):
        for call in _calls(path, *WIDGET_TEXTS) if path.name != "splash.py" else ():
            for given in call.args[:1]:
                texts = [given.body, given.orelse] if isinstance(given, ast.IfExp) else [given]
                parts = [
                    p for t in texts for p in (t.values if isinstance(t, ast.JoinedStr) else [t])
                ]
                words = "".join(str(p.value) for p in parts if isinstance(p, ast.Constant))
                if re.search("[A-Za-z]{3}", words):
                    found.append(f"{_name(path)}:{call.lineno} {words}")
    assert found == []


# f-strings of paths, settings, style sheets, logs and messages before a translation is loaded.
UNTRANSLATED = re.compile(r"^(touchdown: |--|thread|<|data:|icon )|times more in between|app-name")
UNITS = {"mm", "ms", "px", "Hz", "GB", "MB", "min", "IoU", "RX", "RY", "RZ", "rms", "Touchdown"}


def test_sentences_go_through_the_translation_as_a_whole():
    """A text with fields is ``tr("{} of {}", done, count)``, never an f-string."""
    found = []
    for path in (p for p in CODE if _name(p).startswith(("app/", "widgets/"))):
        texts = (n for n in _nodes(path) if isinstance(n, ast.JoinedStr))
        for text in texts if path.name not in ("splash.py", "__main__.py") else ():
            parts = [p.value if isinstance(p, ast.Constant) else "{}" for p in text.values]
            whole = re.sub(r"\S*(\.\w+|_|=)\S*", "", "".join(map(str, parts)))
            words = set(re.findall(r"[A-Za-z]{2,}", whole)) - UNITS
            if words and " " in whole.strip() and not UNTRANSLATED.search(whole):
                found.append(f"{_name(path)}:{text.lineno} {whole}")
    assert found == []


# Commands without an equal in the window.
ONLY_COMMANDS = r"(simulate|dataset|evaluate|experiment|collect --plan|stack' with --strategy)\b"


def test_messages_name_no_command_for_what_the_window_does():
    """The verbs, and the start without a display, may name commands."""
    found = []
    for path in (p for p in CODE if not _name(p).startswith(("backend/cli/", "app/__main__"))):
        docs = {id(n.value) for n in _nodes(path) if isinstance(n, ast.Expr)}
        for node in _nodes(path):
            if (
                isinstance(node, ast.Constant)
                and isinstance(node.value, str)
                and id(node) not in docs
            ):
                for said in re.findall(r"touchdown (?!app\b)[a-z-]+.*", node.value):
                    if not re.match("touchdown " + ONLY_COMMANDS, said):
                        found.append(f"{_name(path)}:{node.lineno} {said}")
    assert found == []


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
    assert [_name(path) for path in CODE if "QThread" in path.read_text("utf-8")] == []


def test_only_the_live_bench_and_writers_start_threads():
    starters = [_name(p) for p in CODE if _calls(p, "Thread", "ThreadPoolExecutor")]
    assert not [name for name in starters if name.startswith("widgets/")]


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
    "lazy-loader": {"lazy_loader"},
}


def test_what_is_imported_is_declared_and_nothing_else():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    extras = project["optional-dependencies"]
    wanted = [*project["dependencies"], *extras["app"], *extras["cad"]]
    names = [re.match(r"[A-Za-z0-9_-]+", each)[0] for each in wanted]
    declared = {module for name in names for module in IMPORTED_AS.get(name, {name})}
    imported = set()
    for path in CODE:
        for node in _nodes(path):
            if isinstance(node, ast.Import):
                imported |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                imported.add(node.module.split(".")[0])
    imported -= sys.stdlib_module_names | {"touchdown"}
    assert imported - declared == set()
    assert declared - imported - {"shiboken6"} == set()


def test_mujoco_has_one_door():
    """It is optional and imported by name, which the import contracts do not see."""
    imports = re.compile(
        r"""(import_module|require_package)\(["']mujoco|^\s*(import|from) mujoco""", re.MULTILINE
    )
    doors = [_name(path) for path in CODE if imports.search(path.read_text("utf-8"))]
    assert doors == ["backend/simulation/release_mujoco.py"]


# Who may read the truth of a press in the batch path, and what of it: to note outcomes and scores.
TRUTH_READERS = {
    "backend/experiments/trials.py note": {"offset_mm", "solved", "toppled"},
    "backend/experiments/statics.py _press_groups": {"offset_mm", "slip_mm", "solved", "toppled"},
    "backend/experiments/fusion.py simulate_sequences": {"offset_mm"},
}


def test_the_batch_path_reads_the_truth_of_a_press_for_outcomes_alone() -> None:
    """A name that holds ``press.truth`` counts as the truth."""
    readers: dict[str, set[str]] = {}
    for path in (ROOT / "backend" / "experiments").glob("*.py"):
        functions = [n for n in _nodes(path) if isinstance(n, ast.FunctionDef)]
        for function in functions:
            for node in ast.walk(function):
                if not isinstance(node, ast.Attribute):
                    continue
                owner = ast.unparse(node.value)
                if owner == "truth" or owner.endswith(".truth"):
                    readers.setdefault(f"{_name(path)} {function.name}", set()).add(node.attr)
    assert readers == TRUTH_READERS
    accepting = next(n for n in _nodes(ROOT / "backend/experiments/trials.py")
                     if isinstance(n, ast.FunctionDef) and n.name == "refused_presses")  # fmt: skip
    assert "truth" not in {n.attr for n in ast.walk(accepting) if isinstance(n, ast.Attribute)}
