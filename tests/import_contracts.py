"""Import contracts that know the packages' lazy exports.

A package exports names through its ``__init__``, from the modules that ``__init__.pyi`` lists.
``DoorsContract`` refuses an import past an ``__init__``. ``ReachContract`` is import-linter's
"forbidden" contract on the imports that really happen: a name taken from a package counts as an
import of the module that defines it, not of everything that the package exports.
"""

import ast
from collections import defaultdict, deque
from functools import cache
from pathlib import Path
from typing import Any

from importlinter import Contract, ContractCheck, output
from importlinter.domain import fields

from touchdown.backend.jobs import lazy_exports

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("app", "backend", "resources", "widgets")


def module_files(root: Path = ROOT) -> dict[str, Path]:
    files = {"touchdown": root / "touchdown" / "__init__.py"}
    paths = [p for folder in FOLDERS for p in (root / folder).rglob("*.py")]
    for path in paths:
        name = "touchdown." + ".".join(path.relative_to(root).with_suffix("").parts)
        files[name.removesuffix(".__init__")] = path
    return files


@cache
def imports(root: Path = ROOT) -> dict[str, frozenset[str]]:
    """Return the modules, inside and outside, that each product module imports by name."""
    files = module_files(root)
    tables = {m: lazy_exports(p, m) for m, p in files.items() if p.name == "__init__.py"}
    found: dict[str, set[str]] = defaultdict(set)
    for module, path in files.items():
        if path.name == "__init__.py" and tables[module]:
            continue
        nodes = list(ast.walk(ast.parse(path.read_text("utf-8"))))
        used = [(n.value.id, n.attr) for n in nodes
                if isinstance(n, ast.Attribute) and isinstance(n.value, ast.Name)]  # fmt: skip
        for node in nodes:
            if isinstance(node, ast.Import):
                found[module] |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                for alias in node.names:
                    name = tables.get(node.module, {}).get(alias.name, node.module)
                    full = f"{node.module}.{alias.name}"
                    found[module].add(full if full in files else name)
                    table, own = tables.get(full, {}), alias.asname or alias.name
                    found[module] |= {table[n] for of, n in used if of == own and n in table}
    return {module: frozenset(names) for module, names in found.items()}


def is_below(module: str, package: str) -> bool:
    return module == package or module.startswith(package + ".")


def path_to(start: str, forbidden: str, graph: dict[str, frozenset[str]]) -> list[str]:
    """Return the shortest chain of imports from ``start`` into ``forbidden``, [] if none."""
    came: dict[str, str] = {start: ""}
    queue = deque([start])
    while queue:
        module = queue.popleft()
        for other in sorted(graph.get(module, ())):
            if other in came:
                continue
            came[other] = module
            if is_below(other, forbidden):
                chain = [other]
                while came[chain[-1]]:
                    chain.append(came[chain[-1]])
                return chain[::-1]
            queue.append(other)
    return []


def is_allowed(importer: str, imported: str, packages: set[str]) -> bool:
    """Return True if ``importer`` may name the module ``imported``.

    Modules of one folder import each other. Modules of a sub-package import the modules of the
    packages around them, up to the second level (``touchdown.backend.devices``).
    """
    if imported in packages or imported.count(".") < 2:
        return True
    own = importer if importer in packages else importer.rpartition(".")[0]
    folder = imported.rpartition(".")[0]
    room = ".".join(imported.split(".")[:3])
    return folder == own or (is_below(own, folder) and is_below(own, room) and room != imported)


class DoorsContract(Contract):
    """No import of a module past the ``__init__`` of its package."""

    def check(self, graph: Any, verbose: bool) -> ContractCheck:
        files = module_files()
        packages = {module for module, path in files.items() if path.name == "__init__.py"}
        past = sorted(
            f"{importer} -> {imported}"
            for importer, names in imports().items()
            for imported in _named(importer, files)
            if imported in files and not is_allowed(importer, imported, packages)
        )
        return ContractCheck(kept=not past, metadata={"past": past})

    def render_broken_contract(self, check: ContractCheck) -> None:
        for line in check.metadata["past"]:
            output.print_error(line)


@cache
def _named_in(path: Path, known: frozenset[str]) -> frozenset[str]:
    named = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            named |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            named.add(node.module)
            named |= {f"{node.module}.{a.name}" for a in node.names} & known
    return frozenset(named)


def _named(module: str, files: dict[str, Path]) -> frozenset[str]:
    return _named_in(files[module], frozenset(files))


class ReachContract(Contract):
    """No chain of imports from the sources to the forbidden modules."""

    source_modules = fields.SetField(subfield=fields.StringField())
    forbidden_modules = fields.SetField(subfield=fields.StringField())

    def check(self, graph: Any, verbose: bool) -> ContractCheck:
        real = imports()
        sources = {m for m in module_files() for s in self.source_modules if is_below(m, s)}
        chains = [
            chain
            for source in sorted(sources)
            for forbidden in sorted(self.forbidden_modules)
            if (chain := path_to(source, forbidden, real))
        ]
        return ContractCheck(kept=not chains, metadata={"chains": chains})

    def render_broken_contract(self, check: ContractCheck) -> None:
        for chain in check.metadata["chains"]:
            output.print_error(" -> ".join(chain))
