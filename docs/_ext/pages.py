"""Sphinx extension: the pages of the site that are made from other sources.

- The front page and the page of each section, from the lists of ``docs/README.md``.
- Arguments of every verb, from the parsers of the command line.
- Settings, from the pydantic models and the comments beside their fields.
- Contributing, changelog and glossary, which lie outside ``docs``.

Links of Markdown pages are written for a code host. They are adapted to the site when read.
"""

from __future__ import annotations

import argparse
import ast
import inspect
import os
import re
import textwrap
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

from pydantic import BaseModel

import touchdown
from touchdown.backend.cli.command_line import VERBS, parser_of
from touchdown.backend.config import HardwareSettings, Limits, SimulationSettings
from touchdown.backend.config import StackSettings as Method

DOCS = Path(__file__).resolve().parents[1]
ROOT = DOCS.parent
MADE = DOCS / "generated"
# Files outside `docs` that are pages of the site.
OUTSIDE = {"CONTRIBUTING.md": "contributing", "CHANGELOG.md": "changelog", "CONTEXT.md": "glossary",
           "SECURITY.md": "security"}  # fmt: skip
# Pages of a section that exist on the site alone, before those that README.md lists.
SITE_ONLY = {
    "Reference": {
        "api": "Public names of `touchdown`, with shapes, units and examples.",
        "generated/arguments": "Every argument of every verb, from the parsers.",
        "generated/settings": "Every setting with its default and range, from the models.",
    }
}
SETTINGS = {
    "Method": (Method, "``touchdown settings --write FILE`` writes them, ``touchdown stack "
               "--method FILE`` reads them. [P]: stated in the paper. [U]: left open there."),
    "Simulated bench": (SimulationSettings, "A bench file (``--bench FILE``) sets them. Defaults "
                        "are those of preset ``mixed``. [U]: not confirmed on hardware."),
    "Lab file, devices": (HardwareSettings, "One table a device; see :doc:`../hardware`."),
    "Lab file, limits": (Limits, "Table ``limits`` of a lab file."),
}  # fmt: skip
LINK = re.compile(r"(!?\[[^\]]*\])\(([^)#\s]+)(#[^)\s]+)?\)")


# -- Command line ---------------------------------------------------------------------------------


def escaped(text: str) -> str:
    """Return plain ``text`` as reStructuredText."""
    return re.sub(r"([\\`*_|])", r"\\\1", text)


def heading(text: str, line: str) -> str:
    """Return a heading."""
    return f"{text}\n{line * len(text)}\n\n"


def arguments_page() -> str:
    """Return the page of the arguments of all verbs."""
    page = heading("Arguments of every verb", "=")
    page += "Made from the parsers of the program. :doc:`../command-line` explains the verbs, "
    page += "their exit codes and their JSON output.\n\n"
    for verb, purpose in VERBS.items():
        parser = parser_of(verb)
        formatter = parser.formatter_class(parser.prog)
        usage = " ".join(parser.format_usage().removeprefix("usage: ").split())
        page += heading(f"touchdown {verb}", "-")
        page += f"{escaped(purpose[:1].upper() + purpose[1:])}.\n\n"
        page += f".. code-block:: text\n\n{textwrap.indent(textwrap.fill(usage, 96), '   ')}\n\n"
        page += f".. program:: touchdown {verb}\n\n"
        for group in parser._action_groups:
            actions = [a for a in group._group_actions if a.dest != "help"]
            if actions and group not in parser._action_groups[:2]:
                page += f".. rubric:: {escaped(group.title or '')}\n\n"
            page += "".join(_option(action, formatter) for action in actions)
        if parser.epilog:
            page += f".. code-block:: text\n\n{textwrap.indent(parser.epilog.strip(), '   ')}\n\n"
    return page


def _option(action: argparse.Action, formatter: argparse.HelpFormatter) -> str:
    words = formatter._format_args(action, (action.dest or "").upper())
    names = action.option_strings or [words]
    if action.option_strings and action.nargs != 0:
        names = [f"{name} {words}" for name in names]
    text = formatter._expand_help(action) if action.help else ""
    if action.choices is not None and action.metavar is not None:
        text += f" One of {', '.join(map(str, action.choices))}."
    return f".. option:: {', '.join(names)}\n\n   {escaped(' '.join(text.split()))}\n\n"


# -- Settings -------------------------------------------------------------------------------------


def comments_of(model: type[BaseModel]) -> dict[str, str]:
    """Return the comment behind or above each field of ``model``."""
    source = textwrap.dedent(inspect.getsource(model))
    lines = source.splitlines()
    found = {}
    for node in ast.parse(source).body[0].body:  # type: ignore[attr-defined]
        if not isinstance(node, ast.AnnAssign):
            continue
        behind = lines[node.end_lineno - 1][node.end_col_offset :].partition("#")[2].strip()
        above: list[str] = []
        at = node.lineno - 2
        while not behind and lines[at].strip().startswith("#"):
            above.insert(0, lines[at].strip().lstrip("# "))
            at -= 1
        found[node.target.id] = behind or " ".join(above)
    return found


def settings_page() -> str:
    """Return the page of the settings."""
    page = heading("Settings", "=")
    page += "Made from the models that check them. Units are part of the names.\n\n"
    for title, (model, text) in SETTINGS.items():
        page += heading(title, "-") + text + "\n\n"
        page += "".join(_tables(model, ""))
    return page


def _tables(model: type[BaseModel], prefix: str) -> Iterator[str]:
    plain, groups = {}, {}
    for name, field in model.model_fields.items():
        inner = field.annotation
        is_group = inspect.isclass(inner) and issubclass(inner, BaseModel)
        (groups if is_group else plain)[name] = field
    comments = comments_of(model)
    if plain:
        first = (inspect.getdoc(model) or "").splitlines()[0]
        if prefix:
            yield f".. rubric:: {escaped(prefix)}: {escaped(first)}\n\n"
        yield ".. list-table::\n   :header-rows: 1\n   :widths: 25 20 20 35\n\n"
        yield "   * - setting\n     - default\n     - range\n     - meaning\n"
        for name, field in plain.items():
            default = "required" if field.is_required() else repr(field.default)
            yield f"   * - ``{name}``\n     - ``{default}``\n     - {_range(field)}\n"
            yield f"     - {escaped(comments.get(name, ''))}\n"
        yield "\n"
    for name, field in groups.items():
        yield from _tables(field.annotation, f"{prefix}.{name}" if prefix else name)


def _range(field: Any) -> str:
    signs = {"gt": "> {}", "ge": "≥ {}", "lt": "< {}", "le": "≤ {}"}
    limits = [
        form.format(f"{value:g}")
        for rule in field.metadata
        for name, form in signs.items()
        if (value := getattr(rule, name, None)) is not None
    ]
    kind = field.annotation
    choices = kind.__args__ if "Literal" in str(kind) else ()
    limits += [f"``{choice!r}``" for choice in choices if isinstance(choice, str | int)]
    return ", ".join(limits)


# -- Pages of lists, links ------------------------------------------------------------------------


def sections() -> dict[str, str]:
    """Return the text of each section of ``docs/README.md``."""
    parts = re.split(r"^## (.+)\n", (DOCS / "README.md").read_text("utf-8"), flags=re.MULTILINE)
    return {"": parts[0], **dict(zip(parts[1::2], parts[2::2], strict=True))}


def slug(title: str) -> str:
    """Return the name of the page of a section."""
    return title.lower().replace(" ", "-")


def toctree(*names: str) -> str:
    """Return a hidden list of the pages below."""
    return "\n```{toctree}\n:hidden:\n\n" + "\n".join(names) + "\n```\n"


def section_page(title: str, text: str) -> str:
    """Return the page of one section."""
    mine = SITE_ONLY.get(title, {})
    listed = "".join(f"- [](../{name}.rst): {about}\n" for name, about in mine.items())
    text = adapted(text, DOCS / "README.md", MADE / f"{slug(title)}.myst")
    pages = [f"/{name}" for name in mine]
    for _, link, anchor in LINK.findall(text):
        target = os.path.relpath(MADE / link, DOCS)
        if not anchor and Path(link).suffix in (".md", ".myst") and f"/{target}" not in pages:
            pages.append(f"/{target}")
    pages = [str(Path(page).with_suffix("")) for page in pages]
    return f"# {title}\n\n{listed}{text}{toctree(*pages)}"


def adapted(text: str, source: Path, page: Path) -> str:
    """Return ``text`` of ``source`` with links that lead on from ``page`` of the site."""

    def link(found: re.Match[str]) -> str:
        label, target, anchor = found[1], found[2], found[3] or ""
        if "://" in target or target.startswith("mailto:"):
            return found[0]
        path = Path(os.path.normpath(source.parent / target))
        if path.parent == ROOT and path.name in OUTSIDE:
            path = MADE / f"{OUTSIDE[path.name]}.myst"
        elif path in (ROOT / "README.md", DOCS / "README.md"):
            path = DOCS / "index.myst"
        elif path == ROOT / "examples":
            path = DOCS / "gallery" / "index.rst"
        elif path.is_dir():
            if not (path / "README.md").is_file():
                return f"{label[1:-1]} (`{path.relative_to(ROOT)}`)"
            path /= "README.md"
        return f"{label}({os.path.relpath(path, page.parent)}{anchor})"

    return LINK.sub(link, text)


def made_pages() -> dict[Path, str]:
    """Return the text of every page that this module makes."""
    found = sections()
    pages = {MADE / f"{slug(title)}.myst": section_page(title, text)
             for title, text in found.items() if title}  # fmt: skip
    tops = [f"generated/{slug(title)}" for title in found if title]
    tops.insert(4, "gallery/index")
    front = adapted(found[""], DOCS / "README.md", DOCS / "index.myst")
    front = front.replace("# Documents", "# Touchdown", 1)
    listed = "".join(f"- [](generated/{slug(t)}.myst)\n" for t in found if t)
    pages[DOCS / "index.myst"] = f"{front}\n{listed}- [](gallery/index.rst)\n{toctree(*tops)}"
    for name, page in OUTSIDE.items():
        path = MADE / f"{page}.myst"
        pages[path] = adapted((ROOT / name).read_text("utf-8"), ROOT / name, path)
    pages[MADE / "arguments.rst"] = arguments_page()
    pages[MADE / "settings.rst"] = settings_page()
    return pages


def members() -> dict[str, list[str]]:
    """Return methods and properties that each public class defines itself."""
    classes = {n: c for n in touchdown.__all__ if inspect.isclass(c := getattr(touchdown, n))}
    return {
        name: [
            member
            for member, value in vars(item).items()
            if not member.startswith(("_", "model_"))
            and (isinstance(value, classmethod | property) or inspect.isfunction(value))
        ]
        for name, item in classes.items()
    }


# -- Sphinx ---------------------------------------------------------------------------------------


def _write(app: Any) -> None:
    for path, text in made_pages().items():
        path.parent.mkdir(exist_ok=True)
        if not path.is_file() or path.read_text("utf-8") != text:
            path.write_text(text, "utf-8")


def _adapt(app: Any, name: str, text: list[str]) -> None:
    path = Path(app.env.doc2path(name))
    if path.suffix == ".md":
        text[0] = adapted(text[0], path, path)
    if path.name == "README.md":
        beside = [link for _, link, _ in LINK.findall(text[0]) if "/" not in link]
        text[0] += toctree(*(Path(link).stem for link in beside if link.endswith(".md")))


def _short_signature(*event: Any) -> tuple[str, str] | None:
    """Shorten the signature of a group of settings, which takes its fields as keywords."""
    is_model = inspect.isclass(event[3]) and issubclass(event[3], BaseModel)
    return ("(**settings)", "") if is_model else None


def setup(app: Any) -> dict[str, bool]:
    """Connect the handlers."""
    import_module("matplotlib").use("Agg")
    app.connect("config-inited", lambda app, config: _write(app))
    app.connect("source-read", _adapt)
    app.connect("autodoc-process-signature", _short_signature)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
