"""What the verbs do alike with a lab file: open the session, connect while telling each step."""

from __future__ import annotations

import argparse
import sys
import threading
from collections.abc import Callable, Container, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from backend.config.lab import is_lab_file, load_lab
from backend.core.faults import FaultError, InputError, RefusedError
from backend.core.niceness import stepping_forward
from backend.runs.store import models_folder
from backend.verbs.screen import Screen

if TYPE_CHECKING:
    from backend.config.method import StackSettings
    from backend.lab import LabChoice
    from backend.rig.connection import Connection, DeviceLine
    from backend.session import Keep, Session

LOOK_S = 0.05
PIECE = "pot"
"""Held on a bench whose file names none."""
START_OVERRIDE = 10
"""Percent of every speed in air, unless --override says otherwise."""


def add_lab_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what only a lab's devices need."""
    parser.add_argument(
        "--home", action="store_true", help="with a lab file: home the empty gripper first"
    )
    parser.add_argument(
        "--override",
        type=int,
        choices=range(10, 101, 10),
        metavar="PERCENT",
        help=f"with a lab file: share of every speed in air (default: {START_OVERRIDE})",
    )


def add_scene_arguments(parser: argparse.ArgumentParser, bottom: str, of_bottom: str) -> None:
    """Declare what stands on the bench; ``name_scene`` fills in what was left out."""
    at_lab = "with a lab file what it names"
    parser.add_argument("--piece", help=f"grasped piece (default: {PIECE}; {at_lab})")
    parser.add_argument("--bottom", help=f"{of_bottom} (default: {bottom}; {at_lab})")


def name_scene(args: argparse.Namespace, bottom: str) -> None:
    """Fill in piece and bottom where they were left out: a lab file says what stands there.

    Raises ``InputError`` for a lab file that cannot be read.
    """
    at_lab = args.bench is not None and is_lab_file(Path(args.bench))
    lab = load_lab(Path(args.bench)).settings if at_lab else None
    if args.piece is None:
        args.piece = PIECE if lab is None else lab.piece
    if args.bottom is None:
        args.bottom = bottom if lab is None else lab.bottom


def refuse_lab_arguments(args: argparse.Namespace) -> None:
    """Raise ``InputError`` where they are given without a lab file."""
    for flag, given in (("--home", args.home), ("--override", args.override)):
        if given:
            raise InputError("Only devices need that.", flag, "Name a lab file with --bench.")


def refuse_simulated_arguments(args: argparse.Namespace) -> None:
    """Raise ``InputError`` where they are given with a lab file."""
    for name in ("preset", "inject", "emulated"):
        if getattr(args, name, None):
            raise InputError("That is of the simulated bench.", f"--{name}", "Leave it out here.")


def lab_choice(args: argparse.Namespace) -> LabChoice:
    """Return the lab of ``--bench``, for a campaign.

    Raises ``InputError`` for what only simulations have.
    """
    from backend.lab import LabChoice

    refuse_simulated_arguments(args)
    pieces = Path(args.pieces) if args.pieces else None
    return LabChoice(Path(args.bench), pieces, campaign=True)


@contextmanager
def lab_bench(
    choice: LabChoice,
    keep: Keep,
    method: StackSettings | None,
    screen: Screen,
    *,
    home: bool,
    override: int | None = None,
) -> Iterator[Session]:
    """Open a session on the devices of a lab file and connect all; closed in the end.

    Raises what ``lab_session`` does, and ``FaultError`` naming the first device that failed.
    """
    from backend.lab import lab_session
    from backend.learning.registry import Registry

    registry = Registry(models_folder())
    with ExitStack() as rest:
        # Before there are threads: all of them inherit it.
        rest.enter_context(stepping_forward())
        session = lab_session(choice, keep=keep, method=method, registry=registry)
        rest.callback(session.close)
        connection = session.connection
        assert connection is not None
        session.interlock.override_speed((override or START_OVERRIDE) / 100)
        connection.begin()
        follow(connection, screen.say)
        if home:
            screen.say("  gripper: homing, the jaws move")
            session.home_gripper()
            follow(connection, screen.say, ("gripper",))
        require_usable(connection)
        yield session


def follow(
    connection: Connection, say: Callable[[str], None], names: Container[str] | None = None
) -> None:
    """Say each device (of ``names``) as it becomes ready or fails, until the work is done."""
    said: dict[str, str] = {}
    working = True
    while working:
        working = not connection.wait(LOOK_S)
        for line in connection.lines():
            if names is not None and line.name not in names:
                continue
            text = line_text(line)
            if line.state in ("ready", "failed") and said.get(line.name) != text:
                said[line.name] = text
                say(f"  {text}")


def line_text(line: DeviceLine) -> str:
    """Return one line of a device for people."""
    from backend.devices.steps import STEPS

    if line.fault is not None:
        at = STEPS[min(line.steps, len(STEPS) - 1)]
        return f"{line.name}: {line.fault.what} ({at}) {line.fault.next_step}".rstrip()
    who = line.identity
    named = "" if who is None else f", {who.maker} {who.model}, {who.serial}".replace(",  ", ", ")
    needs = f", needs: {line.needs}" if line.needs else ""
    notice = f". {line.notice}" if line.notice else ""
    return f"{line.name}: {line.state}{named}{needs}{notice}"


def require_usable(connection: Connection) -> None:
    """Raise the first fault of a device, or what the operator has to do first."""
    for line in connection.lines():
        if line.fault is not None:
            raise FaultError(line.fault)
        if line.needs == "home":
            raise RefusedError(
                "NOT-HOMED",
                "The gripper does not know where its jaws are: empty them, then add --home.",
            )
        if line.needs == "acknowledge":
            raise RefusedError(
                "FAST-STOP", "The gripper waits for an acknowledgement: see the Connect panel."
            )
    if connection.trouble is not None:
        raise connection.trouble
    if connection.missing():
        raise RefusedError("NOT-CONNECTED", f"Not connected: {', '.join(connection.missing())}.")


def ask_on_a_thread(answer: Callable[[bool], None]) -> None:
    """Answer by a line of standard input, while the bench goes on; its end is a no."""

    def read() -> None:
        line = sys.stdin.readline()
        answer(line != "" and line.strip().lower() in ("", "y", "yes"))

    threading.Thread(target=read, name="answer", daemon=True).start()
