"""Command line: ``touchdown <verb>``.

Exit codes: 0 done, 1 the run failed or the piece fell, 2 bad input, 130 interrupted.
"""

from __future__ import annotations

import argparse
import difflib
import importlib
import json
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NoReturn

from touchdown.backend import core
from touchdown.backend.cli.output import VerbOutput, without_window
from touchdown.backend.config import is_lab_file

# Help line of each verb. Its module is imported on use: ``add_arguments(parser)`` and
# ``run(args, screen)``, which returns the exit code.
VERBS = {
    "app": "open the window",
    "stack": "place a piece by touch on the simulated bench or on a lab's devices",
    "demo": "stack three pieces without a window and write a report",
    "calibrate": "calibrate payload, board, tool, wrist and cameras, or show the status",
    "check-day": "check sensors and gels against their limits and their history",
    "collect": "collect labelled probes into a dataset",
    "identify": "identify a bench from recordings, and write it as a bench file with a report",
    "dataset": "show, check, back up, rebuild and merge datasets",
    "piece": "add a piece from a CAD file, list the known pieces, or show one",
    "export": "export episodes and labels to the format of another program",
    "import": "import episodes or labels from the format of another program",
    "replay": "replay a recorded run",
    "simulate": "write labelled episodes of the simulated bench",
    "train": "train a contact-patch model",
    "models": "simulate, train and evaluate the shipped models",
    "evaluate": "evaluate a contact-patch model",
    "experiment": "measure the paper's tables, and strategies beyond them, on the simulated bench",
    "track": "track the gel's markers in an image, video or folder",
    "bench": "write or check a lab file, connect its devices, or recover them from a fault",
    "emulate": "emulate a device over its real wire: arm, gripper, wrist sensor, camera",
    "settings": "show the settings of the method, or write them to a file",
    "doctor": "check this computer, with a fix for each finding",
}

# Verbs whose module has another name.
_MODULES = {
    "import": "import_", "doctor": "doctor.command", "experiment": "experiment.command",
    "models": "experiment.models", "identify": "experiment.identify", "check-day": "calibrate",
}  # fmt: skip

DONE, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130


class Parser(argparse.ArgumentParser):
    """Argument parser that reports bad input as ``InputError``."""

    def error(self, message: str) -> NoReturn:
        """Raise ``InputError`` instead of printing the usage and exiting."""
        fix = f"See '{self.prog} --help'."
        raise core.InputError(f"{message[:1].upper()}{message[1:]}.", self.prog, fix)


class DefaultsFormatter(argparse.HelpFormatter):
    """Appends the default to the help of each option whose text names none."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        text, usual = action.help or "", action.default
        shown = isinstance(usual, str | int | float | Path) and usual not in ("", argparse.SUPPRESS)
        if shown and usual is not False and action.option_strings and "default" not in text:
            text += " (default: %(default)s)"
        return text


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb; ``argv`` without the name of the program (default: ``sys.argv``)."""
    words = list(sys.argv[1:] if argv is None else argv)
    screen = VerbOutput(json="--json" in words, lab=_lab_of(words[1:]))
    status = _run(words, screen)
    return INTERRUPTED if screen.interrupted and status == FAILED else status


def _run(words: list[str], screen: VerbOutput) -> int:
    try:
        return _dispatch(words, screen)
    except core.InputError as error:
        _complain(screen, error.what, error.where, error.fix)
        return BAD_INPUT
    except core.FaultError as error:
        fault = error.fault
        _complain(screen, f"{fault.what} {fault.consequence}", fault.code, fault.next_step)
        return FAILED
    except core.RefusedError as error:
        fix = error.next_step or "Correct this and run the command again."
        _complain(screen, error.what, error.reason, fix)
        return FAILED
    except core.TouchdownError as error:
        _complain(screen, str(error), type(error).__name__, "")
        return FAILED
    except KeyboardInterrupt:
        sys.stderr.write("Interrupted.\n")
        return INTERRUPTED
    except BrokenPipeError:
        # The reader of the pipe (head, less) has closed it.
        sys.stderr.close()
        return DONE
    except OSError as error:
        if error.filename is None:
            raise
        what, fix = f"{error.strerror}.", "Check the path, its permissions and the free space."
        _complain(screen, what, str(error.filename), fix)
        return BAD_INPUT
    except ValueError as error:
        if "surrogates not allowed" not in str(error):
            raise
        named = next((word for word in words if not word.isprintable()), "the working folder")
        _complain(screen, "A name is not UTF-8.", repr(named), "Rename the file or folder.")
        return BAD_INPUT


def _dispatch(words: list[str], screen: VerbOutput) -> int:
    if not words or words[0].startswith("-"):
        front = _front()
        front.parse_args(words)
        front.print_help()
        return BAD_INPUT
    name, rest = words[0], words[1:]
    if name not in VERBS:
        near = ", ".join(difflib.get_close_matches(name, VERBS) or VERBS)
        raise core.InputError(f"There is no verb '{name}'.", "touchdown", f"Use one of: {near}.")
    parser = parser_of(name)
    args, unknown = parser.parse_known_args(rest)
    if hasattr(args, "handed_on"):
        args.handed_on = unknown
    elif unknown:
        parser.error(f"unknown argument: {' '.join(unknown)}")
    run = importlib.import_module(module_of(name)).run
    return int(run(args, screen))


def parser_of(verb: str) -> Parser:
    """Return the parser of a verb, with all its arguments."""
    parser = Parser(
        prog=f"touchdown {verb}", description=VERBS[verb], allow_abbrev=False,
        formatter_class=DefaultsFormatter,
    )  # fmt: skip
    parser.add_argument(
        "--json", action="store_true", help="print one JSON object and nothing else"
    )
    importlib.import_module(module_of(verb)).add_arguments(parser)
    return parser


def _lab_of(words: list[str]) -> str:
    """Return the lab file that the words of a verb name, empty without one."""
    for option, value in zip(["", *words], words, strict=False):
        file = value.removeprefix("--bench=")
        if option in ("", "--bench") or file != value:
            # A file that cannot be read is reported by the verb itself.
            with suppress(core.InputError, OSError):
                if file.endswith(".toml") and Path(file).is_file() and is_lab_file(Path(file)):
                    return file
    return ""


def module_of(verb: str) -> str:
    """Return the module of a verb."""
    name = _MODULES.get(verb, verb)
    return f"touchdown.backend.cli.{name}"


def _front() -> Parser:
    width = max(map(len, VERBS)) + 2
    lines = "\n".join(f"  {name:<{width}}{text}" for name, text in VERBS.items())
    front = Parser(
        prog="touchdown",
        usage="touchdown [-h] [--version] <verb> [arguments]",
        description="Probe how a grasped piece rests before it is released.",
        epilog=f"verbs:\n{lines}\n\n'touchdown <verb> --help' lists the arguments.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    front.add_argument("--version", action="version", version=core.program_stamp())
    return front


def _complain(screen: VerbOutput, what: str, where: str, fix: str) -> None:
    what, fix = without_window(what, screen.lab), without_window(fix, screen.lab)
    if screen.json:
        body = {"error": {"what": what, "where": where, "fix": fix}}
        sys.stderr.write(json.dumps(body) + "\n")
        return
    sys.stderr.write(f"touchdown: {what}\n  where: {where}\n")
    if fix:
        sys.stderr.write(f"  fix:   {fix}\n")
