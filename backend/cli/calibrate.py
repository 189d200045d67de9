"""``touchdown calibrate``: measure the parts of a bench, accept the results.

Parts: payload, board, tool, wrist, cameras.
"""

from __future__ import annotations

import argparse
import getpass
import shlex
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Table

from touchdown.backend.calibration import (
    CALIBRATION_KINDS,
    CALIBRATION_NAMES,
    CalibrationName,
    format_residual,
    format_value,
    quantity_name,
)
from touchdown.backend.cli.connection import (
    add_lab_arguments,
    add_scene_arguments,
    ask_yes_no_in_thread,
    fill_in_scene,
    open_lab_bench,
    refuse_lab_arguments,
    refuse_simulated_arguments,
)
from touchdown.backend.cli.output import AdvanceFunction, VerbOutput, ctrl_c_cancels
from touchdown.backend.config import is_lab_file
from touchdown.backend.core import (
    CalibrationMeasured,
    Event,
    FaultRaised,
    HandOverAwaited,
    InputError,
    Noticed,
    Progress,
    RunFinished,
    Said,
)
from touchdown.backend.runs import CalibrateRequest, calibrations_folder, hand_over_message

if TYPE_CHECKING:
    from touchdown.backend.bench import Session
    from touchdown.backend.calibration import CalibrationStore


NAME = "calibrate"
HELP = "measure and accept calibrations, or show their status"
JSON_VERSION = 1
BOTTOM = "square15"
ORIGIN, PITCH_MM = (0.0, 0.0), 1.9
TITLES: dict[str, str] = {kind.what: kind.title for kind in CALIBRATION_KINDS.values()}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "what", choices=(*CALIBRATION_NAMES, "status"), help="what to measure, or 'status'"
    )
    parser.add_argument(
        "--accept", action="store_true", help="store the result if it is acceptable"
    )
    add_scene_arguments(parser, BOTTOM, "board or bottom")
    parser.add_argument(
        "--origin", type=float, nargs=2, default=ORIGIN, metavar=("X", "Y"),
        help="centre of the bottom in the frame of the arm, mm (default: 0 0)",
    )  # fmt: skip
    parser.add_argument(
        "--pitch",
        type=float,
        default=PITCH_MM,
        metavar="MM",
        help="pitch of the dots (default: 1.9)",
    )
    parser.add_argument(
        "--hand-over", action="store_true",
        help="hand the piece to the gripper if there is no jig; Enter confirms",
    )  # fmt: skip
    parser.add_argument("--person", help="who accepts (default: the account's name)")
    parser.add_argument("--seed", type=int, default=0, help="of the simulated bench")
    parser.add_argument("--preset", help="noise preset of the simulated bench")
    parser.add_argument(
        "--bench", metavar="FILE", help="lab file, or settings of the simulated bench (TOML)"
    )
    parser.add_argument(
        "--emulated", action="store_true",
        help="through real drivers and wires to emulated devices, in real time",
    )  # fmt: skip
    parser.add_argument("--calibrations", metavar="DIR", help="their folder (default: the bench's)")
    add_lab_arguments(parser)


def run(args: argparse.Namespace, screen: VerbOutput) -> int:
    """Measure; return 0 if the result is acceptable (and stored, with --accept), else 1.

    Status: return 0 if all calibrations are valid.
    """
    if not args.pitch > 0:
        raise InputError("The pitch must be positive.", "--pitch", "Give it in mm, such as 1.9.")
    if args.bench is not None and is_lab_file(Path(args.bench)):
        refuse_simulated_arguments(args)
    else:
        refuse_lab_arguments(args)
    if args.what == "status":
        return _status(_store_of(args), screen)
    what: CalibrationName = args.what
    fill_in_scene(args, BOTTOM)
    if args.hand_over and screen.json:
        raise InputError(
            "With --json the prompt for the piece is not shown.", "--hand-over", "Leave out --json."
        )
    request = CalibrateRequest(
        what, args.piece, args.bottom, args.seed, (args.origin[0], args.origin[1]),
        args.hand_over, args.pitch,
    )  # fmt: skip
    with _session(args, screen) as session, ExitStack() as bars:
        told = _CalibrationProgress(screen, bars, session)
        session.events.subscribe(told.take)
        with ctrl_c_cancels(session.engine.cancel):
            session.run(request)
        return _report(args, session, told, screen)


class _CalibrationProgress:
    """Events of the run so far, and its progress bar."""

    def __init__(self, screen: VerbOutput, bars: ExitStack, session: Session) -> None:
        self._screen, self._bars, self._session = screen, bars, session
        self._advance: AdvanceFunction | None = None
        self.measured: CalibrationMeasured | None = None
        self.ended: RunFinished | None = None
        self.faults: list[str] = []

    def take(self, fact: Event) -> None:
        """Handle one event."""
        if isinstance(fact, Progress):
            if self._advance is None:
                bar = self._screen.progress("Calibrating", fact.total)
                self._advance = self._bars.enter_context(bar)
            self._advance(fact.done, fact.text)
        elif isinstance(fact, HandOverAwaited):
            self._screen.say(f"  {hand_over_message(fact)} Enter confirms.")
            ask_yes_no_in_thread(self._session.answer)
        elif isinstance(fact, Said | Noticed):
            self._screen.say(f"  {fact.text}")
        elif isinstance(fact, FaultRaised):
            self.faults.append(fact.fault.code)
        elif isinstance(fact, CalibrationMeasured):
            self.measured = fact
        elif isinstance(fact, RunFinished):
            self.ended = fact


def _report(
    args: argparse.Namespace, session: Session, told: _CalibrationProgress, screen: VerbOutput
) -> int:
    from touchdown.backend.runs import accept_calibration

    found, path = told.measured, None
    if found is not None:
        screen.show(_table(found))
        for text in (found.note, found.obstacle):
            if text:
                screen.say(text)
    elif told.ended is not None:
        screen.say(told.ended.reason)
    if found is not None and args.accept and found.acceptable:
        assert session.calibrations is not None
        person = args.person or getpass.getuser()
        path = accept_calibration(session.calibrations, found, session.devices, person)
        screen.say(f"Accepted: {path}")
    elif found is not None:
        screen.say(_verdict(found))
    screen.result({
        "version": JSON_VERSION,
        "what": args.what,
        "ending": None if told.ended is None else told.ended.ending,
        "reason": None if told.ended is None else told.ended.reason,
        "measured": None if found is None else _as_json(found),
        "accepted": None if path is None else str(path),
        "faults": told.faults,
    })  # fmt: skip
    return 0 if found is not None and found.acceptable else 1


def _verdict(found: CalibrationMeasured) -> str:
    if found.acceptable:
        return "Acceptable; not stored without --accept."
    if found.obstacle:
        return "Not acceptable with the present settings of the bench."
    said = format_residual(found.residual, found.limit, found.unit)
    return f"Not acceptable: the residual is {said}."


def _table(found: CalibrationMeasured) -> Table:
    table = Table(title=TITLES[found.what])
    table.add_column("quantity")
    table.add_column("value", justify="right")
    rows = zip(found.names, found.values, found.sigmas, found.units, strict=True)
    for name, value, sigma, unit in rows:
        table.add_row(quantity_name(name), format_value(name, value, sigma, unit))
    table.add_row("Residual", format_residual(found.residual, found.limit, found.unit))
    return table


def _as_json(found: CalibrationMeasured) -> dict[str, object]:
    rows = zip(found.names, found.values, found.sigmas, found.units, strict=True)
    return {
        "values": {n: {"value": v, "sigma": s, "unit": u} for n, v, s, u in rows},
        "residual": found.residual,
        "limit": found.limit,
        "unit": found.unit,
        "acceptable": found.acceptable,
        "note": found.note,
        "obstacle": found.obstacle,
    }


def _status(store: CalibrationStore, screen: VerbOutput) -> int:
    from datetime import UTC, datetime

    now = datetime.now(UTC)
    standings = store.statuses({}, now)
    table = Table(title=f"Calibrations in {store.folder}")
    for column in ("what", "condition", "residual", "date", "days left"):
        table.add_column(column)
    rows = []
    for standing in standings:
        record = standing.record
        file = None if record is None else record.file
        left = None if record is None else record.days_left(now)
        table.add_row(
            CALIBRATION_KINDS[standing.what].title,
            standing.condition,
            "" if file is None else f"{file.residual:.3f} of {file.limit:g} {file.unit}",
            "" if file is None else f"{file.date:%Y-%m-%d %H:%M}",
            "" if left is None else f"{max(left, 0.0):.0f}",
        )
        rows.append({
            "what": standing.what,
            "condition": standing.condition,
            "why": standing.why,
            "notice": standing.notice,
            "sha256": None if record is None else record.sha256,
            "days_left": left,
        })  # fmt: skip
    screen.show(table)
    for standing in standings:
        if standing.fix:
            screen.say(f"{CALIBRATION_KINDS[standing.what].title}: {standing.why}. {standing.fix}")
        elif standing.notice:
            screen.say(f"{CALIBRATION_KINDS[standing.what].title}: {standing.notice}.")
    screen.result({"version": JSON_VERSION, "folder": str(store.folder), "calibrations": rows})
    return 0 if all(standing.condition == "valid" for standing in standings) else 1


def _store_of(args: argparse.Namespace) -> CalibrationStore:
    from touchdown.backend.calibration import CalibrationStore
    from touchdown.backend.config import load_lab

    folder = Path(args.calibrations) if args.calibrations else calibrations_folder()
    at_lab = args.bench is not None and is_lab_file(Path(args.bench))
    where = _bench_arguments(args, at_lab=at_lab)
    if at_lab:
        lab = load_lab(Path(args.bench))
        own = folder if args.calibrations else lab.calibrations
        return CalibrationStore(own, lab.settings.kind, where)
    return CalibrationStore(folder, "emulated" if args.emulated else "simulated", where)


def _bench_arguments(args: argparse.Namespace, *, at_lab: bool) -> str:
    """Return the arguments that a command for the same bench needs, quoted for a shell.

    On a real bench the gripper must be homed after power-on. The gripper is empty at the start of
    every calibration, so ``--home`` is always safe.
    """
    words = ["--bench", args.bench] if args.bench is not None else []
    words += ["--home"] if at_lab else []
    words += ["--emulated"] if args.emulated else []
    words += ["--hand-over"] if args.hand_over else []
    for flag in ("preset", "piece", "bottom", "override", "person", "calibrations"):
        given = getattr(args, flag)
        words += [] if given is None else [f"--{flag}", str(given)]
    if tuple(args.origin) != ORIGIN:
        words += ["--origin", *(f"{value:g}" for value in args.origin)]
    for flag, usual in (("pitch", PITCH_MM), ("seed", 0)):
        given = getattr(args, flag)
        words += [] if given == usual else [f"--{flag}", str(given)]
    return shlex.join(words)


@contextmanager
def _session(args: argparse.Namespace, screen: VerbOutput) -> Iterator[Session]:
    """Open a session on the selected bench; close it at the end."""
    from touchdown.backend.bench import SimulatedBenchChoice, simulated_session
    from touchdown.backend.runs import RecordingOptions

    keep, store = RecordingOptions(None), _store_of(args)
    if args.bench is not None and is_lab_file(Path(args.bench)):
        from touchdown.backend.bench import LabChoice

        # A new gel must be connected to be calibrated.
        choice = LabChoice(Path(args.bench), any_gels=args.what == "camera")
        home, override = args.home, args.override
        with open_lab_bench(choice, keep, None, screen, home=home, override=override) as session:
            session.calibrations = store
            yield session
        return
    bench = SimulatedBenchChoice(
        file=None if args.bench is None else Path(args.bench), preset=args.preset
    )
    if args.emulated:
        from touchdown.backend.bench import EmulatedBench

        with EmulatedBench(bench, keep=keep) as emulated:
            emulated.session.calibrations = store
            yield emulated.session
        return
    session = simulated_session(bench, keep=keep)
    session.calibrations = store
    try:
        yield session
    finally:
        session.close()
