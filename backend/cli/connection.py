"""Bench of a verb: its arguments, its session, progress of each device, operator prompts."""

from __future__ import annotations

import argparse
import shlex
import sys
import threading
from collections.abc import Callable, Container, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from touchdown.backend import core, runs
from touchdown.backend.cli.output import AdvanceFunction, VerbOutput
from touchdown.backend.config import is_lab_file, load_lab
from touchdown.backend.emulation import FaultPlan, load_faults, parse_fault

if TYPE_CHECKING:
    from touchdown.backend.bench import Session
    from touchdown.backend.config import StackSettings
    from touchdown.backend.rig import BenchConnection, DeviceStatus
    from touchdown.backend.runs import RecordingOptions, Request


POLL_S = 0.05
ARM = "arm"
PIECE = "pot"  # default for a lab file without a piece
START_OVERRIDE = 10  # default of --override: percent of every speed in air


def add_bench_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that choose a bench: simulated, emulated or of a lab file."""
    add = parser.add_argument
    add("--bench", metavar="FILE", help="lab file, or settings of the simulated bench (TOML)")
    add("--home", action="store_true", help="with a lab file: home the empty gripper first")
    add(
        "--override",
        type=int,
        choices=range(10, 101, 10),
        metavar="PERCENT",
        help=f"with a lab file: share of every speed in air (default: {START_OVERRIDE})",
    )
    add("--emulated", action="store_true",
        help="through real drivers and wires to emulated devices, in real time")  # fmt: skip
    add("--preset", help="noise preset: mixed, quiet, hard, off, realistic, bench-v1, bench-v2")
    add("--inject", action="append", default=[], metavar="FAULT", help="scripted fault such as "
        "tactile_left:freeze@3.0 (may be given several times)")  # fmt: skip
    add("--faults", type=Path, metavar="FILE", help="with --emulated: fault plan (TOML)")
    add("--pieces", metavar="DIR", help="folder with further piece files")
    add("--notify", metavar="COMMAND",
        help="call a person on a fault, on a question and at the end: the command gets a title and "
        "a text as its last arguments (for example notify-send)")  # fmt: skip


def add_scene_arguments(parser: argparse.ArgumentParser, bottom: str, of_bottom: str) -> None:
    """Add the arguments of the scene; ``fill_in_scene`` sets the defaults."""
    at_lab = "with a lab file what it names"
    parser.add_argument("--piece", help=f"grasped piece (default: {PIECE}; {at_lab})")
    parser.add_argument("--bottom", help=f"{of_bottom} (default: {bottom}; {at_lab})")


def add_hand_over_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments for a bottom set and a piece handed over by the operator."""
    parser.add_argument(
        "--origin", type=float, nargs=2, default=(0.0, 0.0), metavar=("X", "Y"),
        help="centre of the bottom in the frame of the arm, mm (default: 0 0)",
    )  # fmt: skip
    parser.add_argument(
        "--hand-over", action="store_true",
        help="the operator hands the piece over, without a jig; Enter confirms",
    )  # fmt: skip


def refuse_hidden_prompt(args: argparse.Namespace, screen: VerbOutput) -> None:
    """Raise ``InputError`` for a hand-over whose prompt would not be shown."""
    if args.hand_over and screen.json:
        what, fix = "With --json the prompt for the piece is not shown.", "Leave out --json."
        raise core.InputError(what, "--hand-over", fix)


def at_lab(args: argparse.Namespace) -> bool:
    """Return True if ``--bench`` names a lab file."""
    return args.bench is not None and is_lab_file(Path(args.bench))


def fill_in_scene(args: argparse.Namespace, bottom: str) -> None:
    """Set missing piece and bottom from the lab file.

    Raises ``InputError`` for a lab file that cannot be read.
    """
    lab = load_lab(Path(args.bench)).settings if at_lab(args) else None
    if args.piece is None:
        args.piece = PIECE if lab is None else lab.piece
    if args.bottom is None:
        args.bottom = bottom if lab is None else lab.bottom


def refuse_misplaced_arguments(args: argparse.Namespace) -> None:
    """Raise ``InputError`` for arguments that the bench of ``args`` has no use for."""
    lab = at_lab(args)
    for name in ("preset", "inject", "emulated", "faults") if lab else ("home", "override"):
        if getattr(args, name):
            bench = "simulated and emulated benches" if lab else "benches with a lab file"
            fix = "Leave it out." if lab else "Name a lab file with --bench."
            raise core.InputError(f"This argument is for {bench} only.", f"--{name}", fix)
    if args.faults and not args.emulated:
        fix = "Add --emulated."
        raise core.InputError("A fault plan is for emulated devices.", "--faults", fix)


@contextmanager
def open_bench(
    args: argparse.Namespace,
    screen: VerbOutput,
    keep: RecordingOptions,
    *,
    method: StackSettings | None = None,
    prepare: Callable[[Session], Request],
    **lab: bool,
) -> Iterator[Session]:
    """Open a session on the bench of ``args``, connect a lab's devices, close it at the end.

    ``prepare`` returns the request of the run. At a lab it is checked before anything is connected,
    moves or is switched on. ``lab`` are options of ``LabChoice``. Raises the errors of
    ``lab_session``, and ``FaultError`` for the first device that failed.
    """
    from touchdown.backend.bench import (
        EmulatedBench,
        LabChoice,
        SimulatedBenchChoice,
        lab_session,
        simulated_session,
    )
    from touchdown.backend.calibration import CalibrationStore
    from touchdown.backend.learning import ModelRegistry

    registry = ModelRegistry(runs.models_folder())
    file = None if args.bench is None else Path(args.bench)
    pieces = Path(args.pieces) if args.pieces else None
    with ExitStack() as rest:
        notifier = _notifier(args, screen, rest)
        if file is not None and at_lab(args):
            # Before the first thread, so that all threads inherit it.
            rest.enter_context(core.raised_priority())
            session = lab_session(
                LabChoice(file, pieces, **lab), keep=keep, method=method, registry=registry
            )
            rest.enter_context(session)
            request = prepare(session)
            session.check(request)
            _connect(session, request, args, screen)
            session.events.subscribe(notifier)
            yield session
            return
        if args.emulated:
            # Before the first thread, as above.
            rest.enter_context(core.raised_priority())
            plan = load_faults(args.faults) if args.faults else FaultPlan()
            faults = (*plan.fault, *map(parse_fault, args.inject))
            plan = plan.model_copy(update={"fault": faults})
            scene = SimulatedBenchChoice(file, args.preset, (), pieces)
            bench = EmulatedBench(scene, keep=keep, method=method, registry=registry, plan=plan)
            session = rest.enter_context(bench).session
            if notice := bench.measure_real_time():
                screen.say(notice)
            store = CalibrationStore(runs.calibrations_folder(), "emulated", "--emulated")
        else:
            scene = SimulatedBenchChoice(file, args.preset, tuple(args.inject), pieces)
            session = simulated_session(
                scene, keep=keep, method=method, animate=True, registry=registry
            )
            rest.enter_context(session)
            store = CalibrationStore(runs.calibrations_folder(), "simulated")
        session.calibrations = store
        session.events.subscribe(notifier)
        yield session


def _notifier(
    args: argparse.Namespace, screen: VerbOutput, rest: ExitStack
) -> Callable[[core.Event], None]:
    """Return what calls a person; raises ``InputError`` for a command that cannot be run."""
    if not args.notify:
        return lambda event: None
    notifier = core.CommandNotifier(args.notify, screen.say)
    rest.callback(notifier.close)
    return notifier.take


def _connect(
    session: Session, request: Request, args: argparse.Namespace, screen: VerbOutput
) -> None:
    """Connect the devices of a lab and home the gripper if required; raises the first fault.

    The arm is switched on last, once nothing is known to prevent the run.
    """
    connection = session.connection
    assert connection is not None
    session.interlock.override_speed((args.override or START_OVERRIDE) / 100)
    others = [name for name in connection.devices if name != ARM]
    connection.begin(others)
    report_devices(connection, screen.say, others)
    runs.check_connected(connection, others, homes=args.home)
    session.check(request, connected=True)
    if args.home:
        screen.say("  gripper: homing, the jaws move")
        session.home_gripper()
        report_devices(connection, screen.say, ("gripper",))
    runs.check_connected(connection, others)
    connection.begin()
    report_devices(connection, screen.say, (ARM,))
    runs.check_connected(connection)


@contextmanager
def held_piece_reported(session: Session, screen: VerbOutput) -> Iterator[None]:
    """After a run on devices, also an interrupted one, say how to take a held piece."""
    try:
        yield
    finally:
        if screen.lab and session.hand is not None and session.hand.holding:
            screen.say(
                "The gripper still holds a piece. Hold it with your hand, then run "
                f"'touchdown bench {shlex.quote(screen.lab)} --open-jaws'."
            )


def report_devices(
    connection: BenchConnection, say: Callable[[str], None], names: Container[str] | None = None
) -> None:
    """Print each device (of ``names``) as it becomes ready or fails, until the task is done."""
    said: dict[str, str] = {}
    working = True
    while working:
        working = not connection.wait(POLL_S)
        for line in connection.lines():
            if names is not None and line.name not in names:
                continue
            text = line_text(line)
            if line.state in ("ready", "failed") and said.get(line.name) != text:
                said[line.name] = text
                say(f"  {text}")


def line_text(line: DeviceStatus) -> str:
    """Return the line of a device for people."""
    from touchdown.backend.devices import CONNECTION_STEPS

    if line.fault is not None:
        at = CONNECTION_STEPS[min(line.steps, len(CONNECTION_STEPS) - 1)]
        return f"{line.name}: {line.fault.what} ({at}) {line.fault.next_step}".rstrip()
    who = line.identity
    named = "" if who is None else f", {who.maker} {who.model}, {who.serial}".replace(",  ", ", ")
    needs = f", needs: {line.needs}" if line.needs else ""
    notice = f". {line.notice}" if line.notice else ""
    return f"{line.name}: {line.state}{named}{needs}{notice}"


def ask_yes_no_in_thread(answer: Callable[[bool], None]) -> None:
    """Answer by a line of standard input without blocking the bench; end of file means no."""
    _read_line_in_thread(
        lambda line: answer(line != "" and line.strip().lower() in ("", "y", "yes"))
    )


class RunProgress:
    """Messages, questions, faults, ending and bar of a run; a verb adds events of its own."""

    def __init__(self, title: str, screen: VerbOutput, bars: ExitStack, session: Session) -> None:
        self._title, self.screen, self._bars, self.session = title, screen, bars, session
        self._advance: AdvanceFunction | None = None
        self.ended: core.RunFinished | None = None
        self.faults: list[str] = []

    def take(self, fact: core.Event) -> None:
        """Handle one event."""
        if isinstance(fact, core.Said | core.Noticed):
            self.screen.say(f"  {fact.text}")
        elif isinstance(fact, core.HandOverAwaited | core.MountingAwaited):
            answer_prompt(fact, self.session, self.screen)
        elif isinstance(fact, core.FaultRaised):
            self.faults.append(fact.fault.code)
        elif isinstance(fact, core.RunFinished):
            self.ended = fact

    def move(self, done: int, total: int, text: str) -> None:
        """Move the bar, which starts with the first step."""
        if self._advance is None:
            self._advance = self._bars.enter_context(self.screen.progress(self._title, total))
        self._advance(done, text)


OUTCOME_KEYS = {
    "s": core.Outcome.PLACED,
    "f": core.Outcome.FELL,
    "d": core.Outcome.KNOCKED_OVER,
    "v": core.Outcome.ABORTED,
}
OUTCOME_HELP = "s: stands, f: fell, d: disturbed, v and reason: void. Enter: as proposed."


def answer_prompt(fact: core.Event, session: Session, screen: VerbOutput) -> None:
    """Print the question of an event and answer it; bench and STOP stay responsive."""
    if isinstance(fact, core.SetUpAwaited):
        screen.say(f"  {runs.scene_to_set_message(fact)} Enter: ready. Ctrl-D: end the run.")
        _read_line_in_thread(lambda line: session.answer(line != ""))
    elif isinstance(fact, core.HandOverAwaited):
        screen.say(f"  {runs.hand_over_message(fact)} Enter confirms.")
        ask_yes_no_in_thread(session.answer)
    elif isinstance(fact, core.MountingAwaited):
        screen.say(f"  {runs.mounting_question(fact)} Type y for yes; Enter: no.")
        _read_line_in_thread(lambda line: session.answer(line.strip().lower() in ("y", "yes")))
    elif isinstance(fact, core.OutcomeAwaited):
        screen.say(f"  {runs.outcome_question(fact)} {OUTCOME_HELP}")
        _read_line_in_thread(lambda line: _judge(line, fact, session, screen))
    # Real devices are not left unattended: the run ends.
    elif isinstance(fact, core.Paused) and wait_for_disk_space(
        fact.fault, screen, "run", waits=session.simulated
    ):
        session.engine.resume()


def wait_for_disk_space(
    fault: core.Fault, screen: VerbOutput, what: str, *, waits: bool = True
) -> bool:
    """Print the reason of a pause and wait for the operator; False without one."""
    screen.say(f"  {fault.what} {fault.consequence}")
    if screen.json or not waits:
        return False
    screen.say(f"  Free space on this disk, then press Enter. Ctrl-D ends the {what}.")
    return sys.stdin.readline() != ""


def parse_outcome(line: str, proposed: core.OutcomeAwaited) -> tuple[core.Outcome, str] | None:
    """Return the outcome in a line, None if there is none; a void trial needs a reason."""
    word, _, reason = line.strip().partition(" ")
    if not word:
        reason = proposed.why if proposed.proposed is core.Outcome.ABORTED else ""
        return proposed.proposed, reason
    outcome = OUTCOME_KEYS.get(word.lower())
    if outcome is None or (outcome is core.Outcome.ABORTED and not reason.strip()):
        return None
    return outcome, reason.strip()


def _judge(line: str, fact: core.OutcomeAwaited, session: Session, screen: VerbOutput) -> None:
    while line:
        said = parse_outcome(line, fact)
        if said is not None:
            session.prompt.see(*said)
            return
        screen.say(f"  {OUTCOME_HELP}")
        line = sys.stdin.readline()
    session.prompt.see(core.Outcome.ABORTED, "no outcome was entered")


def _read_line_in_thread(take: Callable[[str], None]) -> None:
    """Pass the next line of standard input to ``take``; "" at end of file."""
    threading.Thread(target=lambda: take(sys.stdin.readline()), name="answer", daemon=True).start()
