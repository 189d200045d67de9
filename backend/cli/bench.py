"""``touchdown bench``: check or write a lab file, connect its devices, recover from a fault."""

from __future__ import annotations

import argparse
import json
import re
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import asdict, astuple
from functools import partial
from importlib.resources import files
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, cast

from touchdown.backend.cli.output import VerbOutput, without_window, write_new
from touchdown.backend.config import PLACEHOLDERS, Lab, LabSettings, load_lab
from touchdown.backend.core import Event, FaultError, InputError, Refused, RefusedError

if TYPE_CHECKING:
    from touchdown.backend.bench import Session
    from touchdown.backend.devices import Arm, ForceTorqueSensor, Gripper
    from touchdown.backend.rig import BenchConnection, SensorTiming


WEIGH_S = 0.5  # the weight of the hand is averaged over this time
TIMING_S = 3.0  # duration of the timing report of the sensors
TEMPLATE = "lab.toml"
# keys of a new file without a usable default
REQUIRED_KEYS = ("ft.address", "gelsight.left.serial", "gelsight.right.serial")

ON = "This connects all devices and switches the arm on; it stands."
# Recovery without a window: help, and the question before it.
RECOVERY = {
    "status": ("connect all devices, show their state and what to do", ON),
    "reset": (
        "connect all devices and reset their faults; nothing moves",
        f"{ON} It resets their faults.",
    ),
    "acknowledge": (
        "acknowledge a fast stop or fault of the gripper",
        f"{ON} Then the gripper accepts motions again; it keeps a held piece.",
    ),
    "lift": ("lift the arm by 5 mm, out of contact", f"{ON} Then the arm rises by 5 mm."),
    "open-jaws": ("open the jaws, also on a held piece", ON),
}
LIFT_MM, LIFT_MM_S = 5.0, 5.0
RISEN_MM = 0.2  # largest part of the lift that may be missing
SETTLE_S = 0.5  # samples of all sensors have arrived


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("file", type=Path, help="lab file (TOML)")
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--new", action="store_true", help="write a new file to fill in")
    what.add_argument(
        "--connect",
        action="store_true",
        help="connect all devices, list the answers, disconnect; the arm is switched on and stands",
    )
    for name, (text, _) in RECOVERY.items():
        what.add_argument(f"--{name}", action="store_true", help=text)
    parser.add_argument("--yes", action="store_true", help="do not ask before a recovery")


def run(args: argparse.Namespace, screen: VerbOutput) -> int:
    """Check, write or connect; return 1 if a device does not answer."""
    if args.new:
        template = files("touchdown.resources").joinpath("benches", TEMPLATE)
        write_new(args.file, template.read_text("utf-8"))
        screen.say(f"Fill in {args.file}, then: touchdown bench {args.file}")
        screen.result({"written": str(args.file)})
        return 0
    lab = load_lab(args.file)
    if args.connect:
        return _connect(args.file, lab.settings.mounting.payload_kg, screen)
    # Imported here: not needed to write a new file.
    from touchdown.backend.devices import refuse_unknown_drivers

    refuse_unknown_drivers(lab.settings, str(args.file))
    for name in RECOVERY:
        if getattr(args, name.replace("-", "_")):
            return _recover(args, name, screen)
    _show(lab, screen)
    return 0


def _show(lab: Lab, screen: VerbOutput) -> None:
    settings = lab.settings
    rows = [
        (f"{group}.{key}", json.dumps(value))
        for group in ("limits", "mounting", "serials")
        for key, value in getattr(settings, group).model_dump(mode="json").items()
    ]
    title = f"{settings.name} ({settings.kind})"
    screen.table(title, ("setting", "value"), *rows, *_devices(settings).items())
    made_up = placeholders(settings)
    if made_up and settings.kind == "hardware":
        screen.say(f"Placeholders, enter the values of the lab: {', '.join(made_up)}.")
    screen.result({
        "name": settings.name,
        "kind": settings.kind,
        "piece": settings.piece,
        "bottom": settings.bottom,
        "limits": settings.limits.model_dump(mode="json"),
        "devices": _devices(settings),
        "placeholders": made_up,
        "calibrations": str(lab.calibrations),
    })  # fmt: skip


def _devices(settings: LabSettings) -> dict[str, str]:
    left, right = settings.gelsight.left, settings.gelsight.right
    return {
        "arm": f"{settings.melfa.driver} {settings.melfa.host}:{settings.melfa.r3.port}",
        "gripper": f"{settings.wsg.driver} {settings.wsg.host}:{settings.wsg.port}",
        "force_torque": f"{settings.ft.driver} {settings.ft.address}",
        "tactile_left": f"{settings.gelsight.driver} {left.file or left.serial}",
        "tactile_right": f"{settings.gelsight.driver} {right.file or right.serial}",
    }


def placeholders(settings: LabSettings) -> list[str]:
    """Return the keys with a default placeholder, and those that are still empty."""
    usual = LabSettings(version=1, name="usual", kind="hardware")
    made_up = [key for key in PLACEHOLDERS if attrgetter(key)(settings) == attrgetter(key)(usual)]
    blank = [key for key in REQUIRED_KEYS if re.search("FILL.IN", attrgetter(key)(settings))]
    return [*blank, *made_up]


def _connect(file: Path, payload_kg: float, screen: VerbOutput) -> int:
    from touchdown.backend.bench import LabChoice, lab_session
    from touchdown.backend.cli.connection import line_text, report_devices
    from touchdown.backend.rig import measure_timing
    from touchdown.backend.runs import RecordingOptions

    with lab_session(LabChoice(file), keep=RecordingOptions(None)) as session:
        connection = session.connection
        assert connection is not None
        connection.prove = partial(_prove, connection.prove, connection, payload_kg)
        connection.begin()
        report_devices(connection, screen.say)
        lines, away = connection.lines(), connection.missing()
        wait = threading.Event().wait
        timings = [] if away else measure_timing(session.raw, session.clock_s, wait, TIMING_S)
    if away:
        screen.say(f"Not connected: {', '.join(away)}.")
    if timings:
        _show_timing(timings, screen)
    screen.result({
        "devices": [
            {
                "name": line.name,
                "state": line.state,
                "steps": line.steps,
                "identity": None if line.identity is None else asdict(line.identity),
                "needs": line.needs,
                "text": line_text(line),
            }
            for line in lines
        ],
        "timing": [asdict(timing) for timing in timings],
    })  # fmt: skip
    return 1 if away else 0


def _prove(
    proved: Callable[[str, threading.Event], None],
    connection: BenchConnection,
    payload_kg: float,
    name: str,
    cancel: threading.Event,
) -> None:
    """Weigh the hand with the wrist sensor; raises ``FaultError``. Other devices: ``proved``."""
    from touchdown.backend.devices.force_torque import require_plausible

    proved(name, cancel)
    if name == "force_torque":
        sensor = cast("ForceTorqueSensor", connection.devices[name])
        begun = sensor.samples.count
        cancel.wait(WEIGH_S)
        require_plausible(sensor.samples.since(begun).values, sensor.rated, payload_kg)


def _recover(args: argparse.Namespace, action: str, screen: VerbOutput) -> int:
    """Do one step of the operator without a window; return 1 if it was declined or failed."""
    from touchdown.backend.bench import LabChoice, lab_session
    from touchdown.backend.cli.calibrate import show_day
    from touchdown.backend.cli.connection import line_text, report_devices
    from touchdown.backend.core import raised_priority
    from touchdown.backend.runs import check_connected

    if screen.json and not args.yes:
        raise InputError("With --json no question is asked.", f"--{action}", "Add --yes.")
    if not _agreed(args, RECOVERY[action][1], screen):
        return 1
    # Any gel is accepted: a recovery measures nothing.
    with raised_priority(), lab_session(LabChoice(args.file, any_gels=True)) as session:
        connection = session.connection
        assert connection is not None
        connection.begin()
        report_devices(connection, screen.say)
        if action == "reset" and connection.missing():
            # The next connection resets the error that the last one named.
            connection.begin()
            report_devices(connection, screen.say)
        if action == "acknowledge":
            needs = {line.name for line in connection.lines() if line.needs == action}
            screen.say("Acknowledging." if needs else "Nothing waits for an acknowledgement.")
            if needs:
                connection.acknowledge()
                report_devices(connection, screen.say, ("gripper",))
        done = True
        if action in ("lift", "open-jaws"):
            check_connected(connection, homes=True)
            done = _move(session, action, args, screen)
        state = _bench_state(session, screen)
        if action == "status" and session.calibrations is not None:
            state["daily_check"] = show_day(session.calibrations, session.day_checks, screen)
        lines, missing = connection.lines(), connection.missing()
    devices = [
        {"name": n.name, "state": n.state, "text": without_window(line_text(n), screen.lab)}
        for n in lines
    ]
    screen.result({"action": action, "done": done, "devices": devices, **state})
    return 0 if done and not missing else 1


def _agreed(args: argparse.Namespace, question: str, screen: VerbOutput) -> bool:
    if args.yes:
        return True
    screen.say(f"{question} Go on? Type y for yes; Enter: no.")
    if sys.stdin.readline().strip().lower() in ("y", "yes"):
        return True
    screen.say("Nothing was done.")
    return False


def _move(session: Session, action: str, args: argparse.Namespace, screen: VerbOutput) -> bool:
    """Lift the arm or open the jaws, and print the result; return False if it was not reached.

    Raises ``RefusedError`` where the window refuses it.
    """
    hand = session.hand
    assert hand is not None
    arm, gripper = cast("Arm", session.devices["arm"]), cast("Gripper", session.devices["gripper"])
    _advance(session, SETTLE_S)
    z_mm, width_mm = arm.pose(max_age_s=1.0).z_mm, gripper.status().width_mm
    if not hand.powered:
        raise RefusedError("SERVO-OFF", "The servo of the arm is off: switch it on first.")
    holding = hand.holding
    if action == "open-jaws":
        held = "A piece is held. Opening lets it go: hold it with your hand."
        if not _agreed(args, held if holding else "The jaws are empty; they open.", screen):
            return False
        hand.open(confirmed=holding)
    else:
        session.events.subscribe(partial(_say_refusal, screen))
        hand.jog.step("z", "XYZ", LIFT_MM, LIFT_MM_S)
    with screen.ctrl_c_cancels(session.stop):
        while hand.active and not session.interlock.latched:
            session.advance()
    if session.interlock.faults:
        raise FaultError(session.interlock.faults[0])
    session.interlock.refuse_latched()
    _advance(session, SETTLE_S)
    if action == "open-jaws":
        now_mm = gripper.status().width_mm
        screen.say(f"The jaws opened from {width_mm:.1f} to {now_mm:.1f} mm.")
        return not hand.holding
    now_mm = arm.pose(max_age_s=1.0).z_mm
    screen.say(f"The arm rose by {now_mm - z_mm:.1f} of {LIFT_MM:g} mm, to z = {now_mm:.1f} mm.")
    return now_mm > z_mm + LIFT_MM - RISEN_MM


def _say_refusal(screen: VerbOutput, event: Event) -> None:
    if isinstance(event, Refused):
        screen.say(f"The motion was ended: {event.text}")


def _bench_state(session: Session, screen: VerbOutput) -> dict[str, object]:
    """Print and return what arm, gripper and wrist report, as far as there is a scene."""
    hand = session.hand
    if hand is None:
        return {}
    _advance(session, SETTLE_S)
    hold = "a piece is held" if hand.holding else "no piece is held"
    screen.say(f"Gripper: {hold}.")
    screen.say(f"Arm: the servo is {'on' if hand.powered else 'off'}.")
    if hand.pressing_n:
        screen.say(f"The piece presses with {hand.pressing_n:.1f} N: lift first (jog +Z).")
    return {"holding": hand.holding, "powered": hand.powered, "pressing_n": hand.pressing_n}


def _advance(session: Session, seconds: float) -> None:
    end_s = session.clock_s() + seconds
    while session.clock_s() < end_s:
        session.advance()


def _show_timing(timings: Sequence[SensorTiming], screen: VerbOutput) -> None:
    # Short texts: a terminal with 80 columns would break the numbers.
    header = ("sensor", "samples", "Hz", "interval\n\N{PLUS-MINUS SIGN}ms, 99 %", "longest\nms",
              "age\nms", "age ms,\n99 %")  # fmt: skip
    rows = ((*map(str, astuple(t)[:2]), *(f"{n:.1f}" for n in astuple(t)[2:])) for t in timings)
    title = f"Time, {TIMING_S:.0f} s at rest, all on this computer's clock"
    screen.table(title, header, *rows, right=header[1:])
