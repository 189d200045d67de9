"""Coverage of the product's statements, measured by marks in the compiled modules.

A mark before each statement sets an entry of a list. CPython 3.11 takes twice as long under a trace
function, whose place the marks take; they cost a few per cent, in all threads. The results are data
of ``coverage``, which knows what counts as a statement and prints the share.
"""

import ast
import hashlib
import marshal
import os
import sys
from collections.abc import Iterable, Sequence
from importlib.machinery import ModuleSpec, SourceFileLoader
from pathlib import Path
from types import CodeType, ModuleType

from coverage import CoverageData

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = tuple(ROOT / name for name in ("app", "backend", "widgets"))
COMPILED = ROOT / ".pytest_cache" / "statements"
VERSION = Path(__file__).read_bytes() + sys.version.encode()
NAME = "__statements__"
_marks: dict[str, list[int]] = {}  # path -> entry of each line, 1 once a statement there ran


def begin() -> None:
    """Mark the modules that are imported from now on."""
    sys.meta_path.insert(0, MarkingFinder())


def write() -> None:
    """Write what ran in this process to a file of its own: ``coverage combine`` joins them."""
    data = CoverageData(str(ROOT / ".coverage"), suffix=str(os.getpid()))
    paths = [str(path) for folder in FOLDERS for path in folder.rglob("*.py")]
    data.add_lines({path: [n for n, m in enumerate(_marks.get(path, ())) if m] for path in paths})
    data.write()


class MarkingFinder:
    """Finds modules as the other finders do; those of the product get the loader below."""

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if not name.startswith("touchdown."):
            return None
        for finder in sys.meta_path:
            spec = None if finder is self else finder.find_spec(name, path, target)
            if spec is not None:
                path_of = Path(spec.origin or "").resolve()
                if any(path_of.is_relative_to(folder) for folder in FOLDERS):
                    spec.loader = MarkingLoader(name, str(spec.origin))
                return spec
        return None


class MarkingLoader(SourceFileLoader):
    """Loads a module with marks; keeps what it compiled."""

    def get_code(self, fullname: str) -> CodeType:
        source = self.get_data(self.path)
        digest = hashlib.sha256(VERSION + source).digest()
        kept = COMPILED / hashlib.sha256(self.path.encode()).hexdigest()
        held = kept.read_bytes() if kept.is_file() else b""
        if held.startswith(digest):
            code: CodeType = marshal.loads(held[len(digest) :])
            return code
        code = compile(marked(source), self.path, "exec", dont_inherit=True)
        COMPILED.mkdir(parents=True, exist_ok=True)
        new = kept.with_suffix(f".{os.getpid()}")
        new.write_bytes(digest + marshal.dumps(code))
        new.replace(kept)
        return code

    def exec_module(self, module: ModuleType) -> None:
        lines = self.get_data(self.path).count(b"\n") + 2
        module.__dict__[NAME] = _marks.setdefault(str(Path(self.path).resolve()), [0] * lines)
        super().exec_module(module)


def marked(source: bytes) -> ast.Module:
    """Return the module with a mark before each statement and in each handler and case."""
    tree = ast.parse(source)
    for node in reversed(list(ast.walk(tree))):  # what is inside first
        for field in ("body", "orelse", "finalbody"):
            block = getattr(node, field, None)
            if isinstance(block, list):
                setattr(node, field, _with_marks(block))
        if isinstance(node, ast.Try | ast.TryStar):
            _mark_choices(node.handlers, [handler.lineno for handler in node.handlers])
        elif isinstance(node, ast.Match):
            _mark_choices(node.cases, [case.pattern.lineno for case in node.cases])
    return tree


def _mark_choices(
    choices: Sequence[ast.ExceptHandler] | Sequence[ast.match_case], lines: list[int]
) -> None:
    """Mark a handler or case, and those before it, which were tried, where one begins."""
    for number, choice in enumerate(choices, 1):
        choice.body = [*_mark(lines[:number], choice.body[0]), *choice.body]


def _with_marks(block: list[ast.stmt]) -> list[ast.stmt]:
    result: list[ast.stmt] = []
    due: list[int] = []
    for statement in block:
        match statement:
            case ast.Expr(ast.Constant(str())):
                result.append(statement)  # a docstring stays first
                continue
            case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
                due += [decorator.lineno for decorator in statement.decorator_list]
        due.append(statement.lineno)
        if isinstance(statement, ast.ImportFrom) and statement.module == "__future__":
            result.append(statement)  # nothing may stand before it
            continue
        result += [*_mark(due, statement), statement]
        due.clear()
    return result + (_mark(due, block[-1]) if due else [])


def _mark(lines: Iterable[int], at: ast.stmt) -> list[ast.stmt]:
    marks: list[ast.stmt] = []
    for line in lines:
        (mark,) = ast.parse(f"{NAME}[{line}] = 1").body
        for node in ast.walk(mark):
            ast.copy_location(node, at)
        marks.append(mark)
    return marks
