"""``touchdown settings``: print the settings of the method, or write them to a TOML file."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from touchdown.backend.cli.output import VerbOutput, write_new
from touchdown.backend.config import StackSettings, parse_settings, read_toml, refuse_other_kind
from touchdown.backend.core import InputError

# Tables that 0.1.0 wrote for strategies that are gone.
REMOVED_TABLES = {"looking", "outlines", "pressure"}
RUN_ARGUMENTS = {"strategy", "mode", "weigh"}  # arguments of each run, not stored in the file
HEAD = """\
# Settings of the method for `touchdown stack --method`; what is left out keeps its default.
# Reasons: docs/method-choices.md.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "--method", type=Path, metavar="FILE", help="show these settings instead of the defaults"
    )
    parser.add_argument("--write", type=Path, metavar="FILE", help="write them (TOML), a new file")


def run(args: argparse.Namespace, screen: VerbOutput) -> int:
    """Print the settings and write them if required; return 0."""
    settings = load_method(args.method) if args.method else StackSettings()
    groups = settings.model_dump(mode="json", exclude=RUN_ARGUMENTS)
    if args.write:
        write_new(args.write, as_toml(settings))
    rows = [
        (f"{group}.{key}", json.dumps(value))
        for group, values in groups.items()
        for key, value in values.items()
    ]
    screen.table("Settings of the method", ("setting", "value"), *rows, right=("value",))
    written = None if args.write is None else str(args.write)
    screen.result({"method": groups, "written": written})
    return 0


def load_method(path: Path) -> StackSettings:
    """Return the settings of the file ``path``; ``InputError`` names file and key."""
    content = read_toml(path)
    refuse_other_kind(content, path, "file with settings of the method")
    content = {key: value for key, value in content.items() if key not in REMOVED_TABLES}
    for key in sorted(RUN_ARGUMENTS & content.keys()):
        fix = "Leave it out: it is chosen with each run."
        raise InputError(f"'{key}' is no setting of the method.", str(path), fix)
    return parse_settings(StackSettings, content, str(path))


def as_toml(settings: StackSettings) -> str:
    """Return the text of a settings file."""
    text = HEAD
    for group, values in settings.model_dump(mode="json", exclude=RUN_ARGUMENTS).items():
        # Numbers, strings, booleans and lists have the same syntax in JSON and TOML.
        lines = (f"{key} = {json.dumps(value)}\n" for key, value in values.items())
        text += f"\n[{group}]\n" + "".join(lines)
    return text
