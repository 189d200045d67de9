"""``touchdown calibrate``: measure the parts of a bench, accept the results.

Parts: payload, board, tool, wrist, cameras. ``risk`` bounds the unsafe releases of a laboratory
from its own trials; nothing moves. ``touchdown check-day`` is the daily check.
"""

from __future__ import annotations

import argparse
import json
import math
import shlex
from contextlib import ExitStack
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from touchdown.backend.bench import Session
from touchdown.backend.calibration import (
    CALIBRATION_KINDS,
    CALIBRATION_NAMES,
    CalibrationName,
    CalibrationStore,
    DayChecks,
    format_residual,
    format_value,
    quantity_name,
)
from touchdown.backend.cli import connection
from touchdown.backend.cli.output import VerbOutput, person_of, without_window
from touchdown.backend.config import BenchIdentity, load_lab
from touchdown.backend.core import (
    CalibrationMeasured,
    Event,
    InputError,
    Progress,
    RefusedError,
    data_folder,
)
from touchdown.backend.runs import (
    CalibrateRequest,
    RecordingOptions,
    accept_calibration,
    calibrations_folder,
)

RISK = "risk"
BOTTOM = "square15"
PITCH_MM = 1.9
REPORTED = ("residual", "limit", "unit", "acceptable", "note", "obstacle")
TITLES: dict[str, str] = {kind.what: kind.title for kind in CALIBRATION_KINDS.values()}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    connection.add_scene_arguments(parser, BOTTOM, "board or bottom")
    connection.add_hand_over_arguments(parser)
    add = parser.add_argument
    add("--pitch", type=float, default=PITCH_MM, metavar="MM", help="pitch of the dots")
    add("--person", help="who accepts (default: the account's name)")
    add("--seed", type=int, default=0, help="of the simulated bench")
    add("--calibrations", metavar="DIR", help="folder (default: the bench's)")
    connection.add_bench_arguments(parser)
    if parser.prog.endswith("check-day"):
        parser.add_argument("--last", action="store_true", help="only show the last check")
        parser.set_defaults(what="day", runs=None, limit=None, accept=False)
        return
    add("what", choices=(*CALIBRATION_NAMES, "status", RISK), help="what to measure; 'status'; or "
        "'risk': bound the unsafe releases of a laboratory from its trials")  # fmt: skip
    add("runs", nargs="?", type=Path, metavar="DATASET",
        help="of 'risk': folder of recorded runs (default: the data folder's)")  # fmt: skip
    add("--limit", type=float, metavar="SHARE",
        help="of 'risk': largest bound of a certificate (default: 0.05)")  # fmt: skip
    add("--accept", action="store_true", help="store the result if it is acceptable")


def run(args: argparse.Namespace, screen: VerbOutput) -> int:
    """Measure; return 0 if the result is acceptable (and stored, with --accept), else 1.

    Status: return 0 if all calibrations are valid.
    """
    if not 0 < args.pitch < math.inf:
        raise InputError("The pitch must be positive.", "--pitch", "Give it in mm, such as 1.9.")
    connection.refuse_misplaced_arguments(args)
    if args.what == RISK:
        return _risk(args, screen)
    if args.runs is not None or args.limit is not None:
        raise InputError("This applies to 'risk' only.", "DATASET, --limit", "Leave it out.")
    if args.what == "status":
        return _status(_store_of(args), screen)
    what: CalibrationName = args.what
    if what == "day" and args.last:
        at_lab, store = connection.at_lab(args), _store_of(args)
        identity = load_lab(Path(args.bench)).identity if at_lab else BenchIdentity()
        return _report_day(store, store.day_checks(identity), screen)
    connection.fill_in_scene(args, BOTTOM)
    connection.refuse_hidden_prompt(args, screen)
    request = CalibrateRequest(
        what, args.piece, args.bottom, args.seed, (args.origin[0], args.origin[1]),
        args.hand_over, args.pitch,
    )  # fmt: skip
    store = _store_of(args)
    if what == "day" or args.accept:
        store.check_writable()  # before the robot measures for minutes
    if args.accept:
        person_of(args)
    # A new gel must be connected to be calibrated.
    keep, any_gels = RecordingOptions(None), args.what == "camera"
    bench = connection.open_bench(args, screen, keep, prepare=lambda _: request, any_gels=any_gels)
    with bench as session, ExitStack() as bars:
        session.calibrations = store
        told = _CalibrationProgress("Calibrating", screen, bars, session)
        session.events.subscribe(told.take)
        with (
            screen.ctrl_c_cancels(session.engine.cancel),
            connection.held_piece_reported(session, screen),
        ):
            session.run(request)
        if what != "day":
            return _report(args, session, told, screen)
        if told.measured is None:
            reason = "" if told.ended is None else told.ended.reason
            raise RefusedError("NO-CHECK", reason, "Run the check again.")
        return _report_day(store, session.day_checks, screen)


class _CalibrationProgress(connection.RunProgress):
    measured: CalibrationMeasured | None = None

    def take(self, fact: Event) -> None:
        super().take(fact)
        if isinstance(fact, Progress):
            self.move(fact.done, fact.total, fact.text)
        elif isinstance(fact, CalibrationMeasured):
            self.measured = fact


def _report(
    args: argparse.Namespace, session: Session, told: _CalibrationProgress, screen: VerbOutput
) -> int:
    found, path = told.measured, None
    if found is not None:
        measured = zip(found.names, found.values, found.sigmas, found.units, strict=True)
        rows = [(quantity_name(n), format_value(n, v, s, u)) for n, v, s, u in measured]
        residual = format_residual(found.residual, found.limit, found.unit)
        header = ("quantity", "value")
        screen.table(TITLES[found.what], header, *rows, ("Residual", residual), right=("value",))
        for text in (found.note, found.obstacle):
            if text:
                screen.say(text)
    elif told.ended is not None:
        screen.say(told.ended.reason)
    if found is not None and args.accept and found.acceptable:
        assert session.calibrations is not None
        path = accept_calibration(session.calibrations, found, session.devices, person_of(args))
        screen.say(f"Accepted: {path}")
    elif found is not None:
        screen.say(_verdict(found))
    screen.result({
        "what": args.what,
        "ending": None if told.ended is None else told.ended.ending,
        "reason": None if told.ended is None else without_window(told.ended.reason, screen.lab),
        "measured": None if found is None else _as_json(found),
        "accepted": None if path is None else str(path),
        "faults": told.faults,
    })  # fmt: skip
    return 0 if found is not None and found.acceptable else 1


def _report_day(store: CalibrationStore, checks: DayChecks, screen: VerbOutput) -> int:
    shown = show_day(store, checks, screen)
    screen.result(shown)
    return 1 if shown["withheld"] else 0


def show_day(store: CalibrationStore, checks: DayChecks, screen: VerbOutput) -> dict[str, object]:
    """Print and return the last daily check, the gels, and why releases are withheld."""
    history, withheld = checks.read()[0], checks.obstacle()
    for check in history[-1:]:
        header = ("quantity", "value", "limits")
        screen.table(f"Daily check of {check.day}", header, *check.rows(), right=header[1:])
    findings = list(history[-1].findings.values()) if history else []
    gels, camera = [f"{text}." for text in store.gels.texts().values()], store.status("camera", {})
    if camera.condition == "gel replaced":
        gels.append(f"Cameras: {camera.why}. {camera.fix}")
    for text in (*findings, *gels, withheld or "The daily check withholds no release."):
        screen.say(text)
    last = json.loads(history[-1].model_dump_json()) if history else None
    return {"last": last, "findings": findings, "gels": gels, "withheld": withheld}


def _verdict(found: CalibrationMeasured) -> str:
    if found.acceptable:
        return "Acceptable; not stored without --accept."
    if found.obstacle:
        return "Not acceptable with the present settings of the bench."
    said = format_residual(found.residual, found.limit, found.unit)
    return f"Not acceptable: the residual is {said}."


def _as_json(found: CalibrationMeasured) -> dict[str, object]:
    rows = zip(found.names, found.values, found.sigmas, found.units, strict=True)
    return {
        "values": {n: {"value": v, "sigma": s, "unit": u} for n, v, s, u in rows},
        **{name: getattr(found, name) for name in REPORTED},
    }


def _status(store: CalibrationStore, screen: VerbOutput) -> int:
    now = datetime.now(UTC)
    standings = store.statuses({}, now)
    listed, rows = [], []
    for standing in standings:
        record = standing.record
        file = None if record is None else record.file
        left = None if record is None else record.days_left(now)
        listed.append(
            (
                CALIBRATION_KINDS[standing.what].title,
                standing.condition,
                "" if file is None else f"{file.residual:.3f} of {file.limit:g} {file.unit}",
                "" if file is None else f"{file.date:%Y-%m-%d %H:%M}",
                "" if left is None else f"{max(left, 0.0):.0f}",
            )
        )
        rows.append({
            "what": standing.what,
            "condition": standing.condition,
            "why": standing.why,
            "notice": standing.notice,
            "sha256": None if record is None else record.sha256,
            "days_left": left,
        })  # fmt: skip
    header = ("what", "condition", "residual", "date", "days left")
    screen.table(f"Calibrations in {store.folder}", header, *listed)
    for standing in standings:
        title = CALIBRATION_KINDS[standing.what].title
        if standing.fix:
            screen.say(f"{title}: {standing.why}. {standing.fix}")
        elif standing.notice:
            screen.say(f"{title}: {standing.notice}.")
    screen.result({"folder": str(store.folder), "calibrations": rows})
    return 0 if all(standing.condition == "valid" for standing in standings) else 1


def _risk(args: argparse.Namespace, screen: VerbOutput) -> int:
    """Bound the unsafe releases of a laboratory; return 0 if the certificate was written."""
    if not connection.at_lab(args):
        fix = "Name its lab file."
        raise InputError("'risk' needs the trials of a laboratory.", "--bench", fix)
    # Imported here: measuring needs no torch.
    from touchdown.backend.experiments import LABORATORY_LIMIT, certify_laboratory, labelled_trials

    limit = LABORATORY_LIMIT if args.limit is None else args.limit
    if not 0.0 < limit < 1.0:
        raise InputError("The limit is no share.", "--limit", "Give it between 0 and 1.")
    store = _store_of(args)
    store.check_writable()  # before an attempt is spent
    bench = replace(load_lab(Path(args.bench)).identity, calibrations=store.folder)
    folder = args.runs or data_folder() / "runs"
    if not folder.is_dir():
        raise InputError("There is no such folder.", str(folder), "Name the folder of the runs.")
    found = certify_laboratory(list(labelled_trials(folder)), bench, limit)
    (counts,) = found.attempt.counts
    screen.say(
        f"Attempt {found.attempt.number}: {counts.unsafe} of {counts.releases} releases unsafe, "
        f"at most {100 * counts.bound:.1f} %."
    )
    for why, number in found.left_out.items():
        screen.say(f"Left out: {number} trials {why}.")
    if found.certificate is None:
        screen.say(f"That exceeds {100 * limit:g} %: no certificate. The trials are used up.")
    else:
        screen.say(f"Certificate: {found.certificate.summary()}. It is in {found.path}.")
    screen.result({
        "what": RISK,
        "attempt": json.loads(found.attempt.model_dump_json(exclude={"trials"})),
        "left_out": dict(found.left_out),
        "certificate": None if found.path is None else str(found.path),
    })  # fmt: skip
    return 0 if found.certificate is not None else 1


def _store_of(args: argparse.Namespace) -> CalibrationStore:
    folder = Path(args.calibrations) if args.calibrations else calibrations_folder()
    where = _bench_arguments(args)
    if connection.at_lab(args):
        lab = load_lab(Path(args.bench))
        own = folder if args.calibrations else lab.calibrations
        return CalibrationStore(own, lab.settings.kind, where, lab.facts.gels)
    return CalibrationStore(folder, "emulated" if args.emulated else "simulated", where)


def _bench_arguments(args: argparse.Namespace) -> str:
    """Return the arguments that a command for the same bench needs, quoted for a shell.

    On a real bench the gripper must be homed after power-on. The gripper is empty at the start of
    every calibration, so ``--home`` is always safe.
    """
    words = ["--bench", args.bench] if args.bench is not None else []
    words += ["--home"] if connection.at_lab(args) else []
    words += ["--emulated"] if args.emulated else []
    words += ["--hand-over"] if args.hand_over else []
    for flag in ("preset", "pieces", "piece", "bottom", "override", "person", "calibrations"):
        given = getattr(args, flag)
        words += [] if given is None else [f"--{flag}", str(given)]
    if any(args.origin):
        words += ["--origin", *(f"{value:g}" for value in args.origin)]
    for flag, usual in (("pitch", PITCH_MM), ("seed", 0)):
        given = getattr(args, flag)
        words += [] if given == usual else [f"--{flag}", str(given)]
    return shlex.join(words)
