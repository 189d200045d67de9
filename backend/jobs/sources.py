"""Hash of the sources on which the function of a job depends.

The sources are found without running them: the module of the function, the modules of the package
that it imports by the names which the function uses, and everything these import. A name taken from
a package counts as an import of the module that its ``__init__.pyi`` lists.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

from touchdown.backend.core import hash_files

PACKAGE = "touchdown.backend"
ROOT = Path(__file__).resolve().parents[1]
DATA = "resources/objects/*.toml"  # pieces, read by name


@cache
def source_hash(module: str, function: str, root: Path = ROOT) -> str:
    """Return 16 hex digits of the sources of ``function`` in ``module`` and of the pieces.

    ``root``: folder of the package ``touchdown.backend``.
    """
    paths = [*source_files(module, function, root).values(), *root.parent.glob(DATA)]
    return hash_files(paths, root.parent)


def source_files(module: str, function: str, root: Path = ROOT) -> dict[str, Path]:
    """Return the files of all modules that ``function`` reaches, by the name of the module."""
    first = _tree(_file(root, module))
    found = {module: _file(root, module)}
    waiting = list(_imported(_used_nodes(first, function), root))
    while waiting:
        name = waiting.pop()
        path = _file(root, name)
        if name in found or not path.is_file():
            continue
        found[name] = path
        waiting += _imports_of(path, root)
    return found


def lazy_exports(init: Path, package: str) -> dict[str, str]:
    """Return the defining module of each name that a package exports lazily."""
    stub = init.with_suffix(".pyi")
    if not stub.is_file():
        return {}
    return {
        alias.asname or alias.name: f"{package}.{node.module}"
        for node in _tree(stub).body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


@cache
def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def _file(root: Path, module: str) -> Path:
    path = root.joinpath(*module.removeprefix(PACKAGE).strip(".").split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


@cache
def _imports_of(path: Path, root: Path) -> tuple[str, ...]:
    if path.name == "__init__.py" and path.with_suffix(".pyi").is_file():
        return ()  # each name is resolved by the stub
    return tuple(_imported(ast.walk(_tree(path)), root))


@cache
def _exports_of(root: Path, package: str) -> dict[str, str]:
    return lazy_exports(_file(root, package), package)


def _imported(nodes: Iterable[ast.AST], root: Path) -> Iterator[str]:
    """Yield the modules of the package that the import statements among ``nodes`` name.

    Of a package imported by its own name these are the modules of the attributes that are used.
    """
    nodes = list(nodes)
    used = [(n.value.id, n.attr) for n in nodes
            if isinstance(n, ast.Attribute) and isinstance(n.value, ast.Name)]  # fmt: skip
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (a.name for a in node.names if a.name.startswith(PACKAGE))
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith(PACKAGE):
            assert node.module is not None
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                exported = _exports_of(root, node.module).get(alias.name, node.module)
                yield whole if _file(root, whole).is_file() else exported
                defined, own = _exports_of(root, whole), alias.asname or alias.name
                yield from (defined[name] for of, name in used if of == own and name in defined)


def _used_nodes(tree: ast.Module, function: str) -> Iterator[ast.AST]:
    """Yield the parts of a module that ``function`` uses, its imports cut to the names used."""
    own: dict[str, list[ast.stmt]] = {}
    for node in tree.body:
        for name in _defined(node):
            own.setdefault(name, []).append(node)
    names, waiting = set[str](), [function]
    while waiting:
        name = waiting.pop()
        if name in names:
            continue
        names.add(name)
        for node in own.get(name, ()):
            yield from ast.walk(node)
            waiting += [n.id for n in ast.walk(node) if isinstance(n, ast.Name)]
    for node in tree.body:
        if isinstance(node, ast.ImportFrom):
            used = [a for a in node.names if (a.asname or a.name) in names]
            yield ast.ImportFrom(node.module, used, node.level)


def _defined(node: ast.stmt) -> list[str]:
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return [node.name]
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", node)]
    return [n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name)]
