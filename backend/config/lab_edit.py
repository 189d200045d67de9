"""Changes where the devices of a lab file answer; everything else in it stays as it was written.

Comments and order stay. What was written is read back before it takes the place of the old file.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from backend.config.lab import parse_lab
from backend.config.lab_places import refuse_wrong_places
from backend.config.load import read_toml
from backend.core.faults import InputError
from backend.core.files import write_atomically

Value = str | int
_KEY = r"\s*{}\s*="
_SECTION = re.compile(r"\s*\[\s*([^\[\]]+?)\s*\]\s*(#.*)?$")


def save_lab(path: Path, values: Mapping[str, Value]) -> bool:
    """Set ``values`` by dotted key in the lab file ``path``; returns whether anything changed.

    Raises ``InputError``, and changes nothing, if the file could not be used with them.
    """
    before = path.read_text("utf-8") if read_toml(path) else ""
    after = with_values(before, values, str(path))
    if after == before:
        return False
    settings = parse_lab(tomllib.loads(after), path)
    refuse_wrong_places(settings, settings.kind, str(path))
    write_atomically(path, after.encode())
    return True


def with_values(text: str, values: Mapping[str, Value], where: str) -> str:
    """Return the TOML ``text`` with ``values`` set; raises ``InputError`` where it cannot be."""
    content = tomllib.loads(text)
    lines = text.splitlines()
    for key, value in values.items():
        if _get(content, key) == value:
            continue
        _set(content, key, value)
        lines = _with_value(lines, key, content)
    after = "\n".join(lines) + "\n"
    try:
        same = tomllib.loads(after) == content
    except tomllib.TOMLDecodeError:
        same = False
    if not same:
        raise InputError(
            "The file is written in a way that is not understood well enough to change it.",
            where,
            f"Set {', '.join(values)} there by hand.",
        )
    return after if after.strip() != text.strip() else text


def _with_value(lines: list[str], key: str, content: dict[str, Any]) -> list[str]:
    """Return the lines with ``key`` as ``content`` has it: in its place, or in a new one."""
    table, _, name = key.rpartition(".")
    while table:
        begin, end = _section(lines, table)
        for at in range(begin, end):
            if re.match(_KEY.format(re.escape(name)), lines[at]):
                written = f"{name} = {_toml(_get(content, f'{table}.{name}'))}"
                return [*lines[:at], written + _comment(lines[at]), *lines[at + 1 :]]
        outer, _, inner = table.rpartition(".")
        begin, end = _section(lines, outer)
        if not any(re.match(_KEY.format(re.escape(inner)), line) for line in lines[begin:end]):
            break
        # The table is written on one line: all of it is written again.
        table, name = outer, inner
    table, _, name = key.rpartition(".")
    written = f"{name} = {_toml(_get(content, key))}"
    begin, end = _section(lines, table)
    if begin == end == 0:
        return [*lines, "", f"[{table}]", written]
    while end > begin and not lines[end - 1].strip():
        end -= 1
    return [*lines[:end], written, *lines[end:]]


def _section(lines: list[str], table: str) -> tuple[int, int]:
    """Return where the lines of ``table`` begin and end; (0, 0) where it has no head."""
    heads = [(at, match[1]) for at, line in enumerate(lines) if (match := _SECTION.match(line))]
    ends = [at for at, _ in heads[1:]] + [len(lines)]
    for (at, name), end in zip(heads, ends, strict=False):
        if re.sub(r"\s", "", name) == table:
            return at + 1, end
    return 0, 0


def _comment(line: str) -> str:
    """Return the comment behind a value, with the space before it; "" where there is none."""
    quoted = re.sub(r'"(?:[^"\\]|\\.)*"|\'[^\']*\'', lambda m: "_" * len(m[0]), line)
    at = quoted.find("#")
    return "" if at < 0 else line[len(quoted[:at].rstrip()) :]


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {_toml(v)}" for k, v in value.items()) + " }"
    return json.dumps(value, ensure_ascii=False)


def _get(content: dict[str, Any], key: str) -> Any:
    found: Any = content
    for part in key.split("."):
        found = found.get(part) if isinstance(found, dict) else None
    return found


def _set(content: dict[str, Any], key: str, value: Value) -> None:
    *tables, name = key.split(".")
    for part in tables:
        content = content.setdefault(part, {})
    content[name] = value
