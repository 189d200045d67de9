"""Output of a verb: tables and progress bars for people, one JSON object for scripts.

Also shared by verbs: the first Ctrl-C cancels a run before the second interrupts it, and
``write_new`` never overwrites a file.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import shlex
import signal
import sys
import threading
import time
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TextIO

from rich.console import Console, JustifyMethod, RenderableType
from rich.live import Live
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

from touchdown.backend.core import InputError, account_name, write_atomically

AdvanceFunction = Callable[..., None]
JSON_VERSION = 1  # of the objects of all verbs


class VerbOutput:
    """The command line's output.

    For people everything goes to standard output. With ``json`` on, standard output holds exactly
    one JSON object (from ``result``) and nothing else; ``say``, ``show`` and bars are silent.
    """

    def __init__(self, *, json: bool = False, stream: TextIO | None = None, lab: str = "") -> None:
        self.json, self.lab = json, lab
        self._stream = sys.stdout if stream is None else stream
        # No mark-up: "[CAMERA-STALE]" in a message or a table cell is text.
        self._console = Console(
            file=self._stream, quiet=json, highlight=False, markup=False, soft_wrap=True
        )
        self._answered = False
        self.interrupted = False  # by a Ctrl-C that ``ctrl_c_cancels`` took

    def say(self, text: str) -> None:
        """Print a sentence for people; steps in the window become commands for ``lab``."""
        self._console.print(without_window(text, self.lab))

    def show(self, renderable: RenderableType) -> None:
        """Print a rich table or other renderable for people (colours by ``rich.text.Text``)."""
        self._console.print(renderable, soft_wrap=False)

    def table(
        self,
        title: str,
        header: Sequence[str],
        *rows: Iterable[str | Text],
        right: Container[str] = (),
    ) -> None:
        """Print a table of plain texts for people; the columns of ``right`` hold numbers."""
        self.show(text_table(title, header, *rows, right=right))

    @contextmanager
    def progress(self, title: str, total: int | None) -> Iterator[AdvanceFunction]:
        """Show a bar with count, elapsed time and ETA; yield ``advance(done, text, total)``.

        ``done``: absolute number of completed steps; ``total``: None if unknown until a later call.
        """
        bar = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("ETA"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[text]}", markup=False),
            console=self._console,
            disable=self.json or not self._console.is_terminal,
        )
        task = bar.add_task(title, total=total, text="")

        def advance(done: int, text: str = "", total: int | None = None) -> None:
            bar.update(task, completed=done, text=text, total=total)

        if not self._console.is_terminal:
            self.say(f"{title} ...")
        with bar:
            yield advance

    @contextmanager
    def status(self) -> Iterator[Callable[[RenderableType], None]]:
        """Show changing content; yield its setter. Silent unless on a terminal."""
        if self.json or not self._console.is_terminal:
            yield lambda shown: None
            return
        with Live(console=self._console, refresh_per_second=4) as live:
            yield live.update

    @contextmanager
    def ctrl_c_cancels(self, cancel: Callable[[], object]) -> Iterator[None]:
        """Call ``cancel`` at the first Ctrl-C; the second one interrupts.

        The first one interrupts as well if ``cancel`` returns False: nothing to cancel yet.
        """

        def once(_signal: int, _frame: FrameType | None) -> None:
            signal.signal(signal.SIGINT, before)
            self.interrupted = True
            if cancel() is False:
                raise KeyboardInterrupt

        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = signal.signal(signal.SIGINT, once)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, before)

    def result(self, mapping: Mapping[str, object]) -> None:
        """With ``json``: print ``mapping`` as the one JSON object; RuntimeError the second time.

        NaN and infinities become null.
        """
        if not self.json:
            return
        if self._answered:
            raise RuntimeError("a verb gives exactly one result")
        self._answered = True
        self._stream.write(
            json.dumps(_to_json({"version": JSON_VERSION, **mapping}), allow_nan=False) + "\n"
        )
        self._stream.flush()


def progress_lines(every_s: float = 2.0) -> Callable[[str, int, int], None]:
    """Return a function that reports progress and the time left on standard error.

    It takes what is done, and numbers of finished and of all steps; it writes at most every
    ``every_s``.
    """
    last_s = time.monotonic()
    begun = 0, 0, last_s  # total, done and time of its first report

    def advance(what: str, done: int, total: int) -> None:
        nonlocal last_s, begun
        now_s = time.monotonic()
        if total != begun[0]:
            begun = total, done, now_s
        if now_s - last_s >= every_s:
            last_s, gained = now_s, done - begun[1]
            left_min = (now_s - begun[2]) * (total - done) / max(gained, 1) / 60.0
            left = f" about {left_min:.1f} min left" if gained > 0 else ""
            sys.stderr.write(f"{what}: {done:,} of {total:,} ...{left}\n")
            sys.stderr.flush()

    return advance


def text_table(
    title: str,
    header: Sequence[str],
    *rows: Iterable[str | Text],
    right: Container[str] = (),
    lab: str = "",
) -> Table:
    """Return a table of plain texts; the columns of ``right`` are aligned to the right.

    Steps in the window become commands for ``lab``.
    """
    table = Table(title=title)
    for column in header:
        side: JustifyMethod = "right" if column in right else "left"
        table.add_column(column, justify=side, overflow="fold", no_wrap=column == header[0])
    for row in rows:
        table.add_row(*(without_window(c, lab) if isinstance(c, str) else c for c in row))
    return table


def _to_json(value: object) -> object:
    """Return ``value`` for JSON: non-finite floats None, tuples lists, numpy scalars numbers."""
    if hasattr(value, "item"):
        value = value.item()
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): _to_json(item) for key, item in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [_to_json(item) for item in value]
    return value


# Steps in the window, and their commands: with a lab file, and on a bench that ends with its run.
_WINDOW_STEPS = (
    (r"[Pp]ress Reset, then connect [^.]*again", "run '{bench} --reset'", "start again"),
    (r"press Reset, then connect [^.]*\.", "run '{bench} --reset'.", "start again."),
    (r"[Pp]ress Reset", "run '{bench} --reset'", "start again"),
    (r"Look at the device chips", "Run '{bench} --status'", "Look at the devices"),
    (r"see the Connect panel", "run '{bench} --acknowledge'", "acknowledge it"),
    (r"acknowledge (it|the fast stop)\b", "run '{bench} --acknowledge'", r"acknowledge \1"),
    (
        r"open the jaws in the window \(Operate, Shift\+G\)",
        "run '{bench} --open-jaws'",
        "open them",
    ),
    (r"Connect first \(Ctrl\+L\)", "Run '{bench} --status'", "Connect first"),
    (r" \(jog \+Z\)", " ('{bench} --lift')", ""),
    (r"jog away from contact first", "run '{bench} --lift' first", "lift first"),
    (r" Connecting once more in the same window resets this error; from [^.]*\.", "", ""),
    (r",? or set a new simulated scene \(Ctrl\+N in Operate\)", "", ""),
)


def without_window(text: str, lab: str = "") -> str:
    """Return ``text`` with the commands that do what it says of the window.

    ``lab`` is the lab file of the bench, empty for a simulated or emulated one.
    """
    bench = f"touchdown bench {shlex.quote(lab)}"
    for step, command, otherwise in _WINDOW_STEPS:

        def replaced(found: re.Match[str], words: str = command if lab else otherwise) -> str:
            words = found.expand(words).replace("{bench}", bench)
            return words[:1].upper() + words[1:] if found[0][0].isupper() else words

        text = re.sub(step, replaced, text)
    return text


def person_of(args: argparse.Namespace) -> str:
    """Return ``--person`` or the account's name; raises ``InputError`` if there is neither."""
    if not (person := args.person or account_name()):
        raise InputError("This account has no name.", "--person", "Name the person.")
    return str(person)


def check_output(path: Path, suffix: str, *inputs: Path | None) -> None:
    """Raise ``InputError`` unless ``path`` ends with ``suffix`` and is none of ``inputs``."""
    if path.suffix != suffix:
        fix = f"Name a file that ends with {suffix}."
        raise InputError("This file is of another kind than the output.", str(path), fix)
    if path.resolve() in [file.resolve() for file in inputs if file is not None]:
        raise InputError("The output would replace an input.", str(path), "Name another file.")


def check_new(path: Path) -> None:
    """Raise ``InputError`` if ``path`` exists."""
    if path.exists():
        raise InputError("The file exists already.", str(path), "Name a new file.")


def write_new(path: Path, text: str) -> None:
    """Write a new file; raises ``InputError`` if ``path`` exists, ``OSError`` of the disk."""
    check_new(path)
    write_atomically(path, text.encode("utf-8"))


def require_positive(args: argparse.Namespace, *names: str, least: int = 1) -> None:
    """Raise ``InputError`` for the first given argument of ``names`` below ``least``."""
    for name in names:
        value = getattr(args, name)
        if value is not None and value < least:
            flag = "--" + name.replace("_", "-")
            raise InputError(f"{flag} must be at least {least}.", flag, f"Give {least} or more.")
