"""``touchdown app``: open the window."""

from __future__ import annotations

import argparse
import importlib
from importlib.util import find_spec
from types import ModuleType

from touchdown.backend.cli.output import VerbOutput
from touchdown.backend.core import InputError

NAME = "app"
HELP = "open the window"


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
    """Start the window; return its exit code. Raises ``InputError`` if Qt is not installed."""
    if find_spec("PySide6") is None:
        raise InputError(
            "The window needs Qt, which is not installed.",
            "PySide6",
            "Run 'make setup', or work without a window: 'touchdown stack'.",
        )
    _check_arguments(arguments)
    return int(_window().main(arguments))


def _check_arguments(arguments: list[str]) -> None:
    """Raise ``InputError`` for arguments that the window's parser refuses."""
    parser = _window().parser()
    parser.exit_on_error = False
    try:
        _, unknown = parser.parse_known_args(arguments)
    except argparse.ArgumentError as error:
        raise InputError(
            f"{str(error).capitalize()}.", "touchdown app", "See 'touchdown app --help'."
        ) from error
    if unknown:
        raise InputError(
            f"Unknown argument: {' '.join(unknown)}.",
            "touchdown app",
            "See 'touchdown app --help'.",
        )


def _window() -> ModuleType:
    # By name, because the import contract forbids an import of the window.
    return importlib.import_module("touchdown.app.__main__")
