"""``touchdown bench``: read a lab file, write a new one, or connect its devices once."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path

from rich.table import Table

from backend.config.hardware import PLACEHOLDERS
from backend.config.lab import Lab, LabSettings, load_lab
from backend.config.method import Settings
from backend.verbs.new_file import write_new
from backend.verbs.screen import Screen

NAME = "bench"
HELP = "check a lab file, write a new one, or connect its devices once"
JSON_VERSION = 1
TEMPLATE = "lab.toml"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("file", type=Path, help="lab file (TOML)")
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--new", action="store_true", help="write a new one to fill in")
    what.add_argument(
        "--connect",
        action="store_true",
        help="connect all devices, tell who answers, disconnect; the arm is switched on and stands",
    )


def run(args: argparse.Namespace, screen: Screen) -> int:
    """Check, write or connect; 1 if a device does not answer."""
    if args.new:
        _write_template(args.file)
        screen.say(f"Fill in {args.file}, then: touchdown bench {args.file}")
        screen.result({"version": JSON_VERSION, "written": str(args.file)})
        return 0
    lab = load_lab(args.file)
    if args.connect:
        return _connect(args.file, screen)
    _show(lab, screen)
    return 0


def _show(lab: Lab, screen: Screen) -> None:
    settings = lab.settings
    table = Table(title=f"{settings.name} ({settings.kind})")
    table.add_column("setting")
    table.add_column("value")
    for group in ("limits", "mounting", "serials"):
        for key, value in getattr(settings, group).model_dump(mode="json").items():
            table.add_row(f"{group}.{key}", json.dumps(value))
    for key, text in _devices(settings).items():
        table.add_row(key, text)
    screen.show(table)
    made_up = placeholders(settings)
    if made_up and settings.kind == "hardware":
        screen.say(f"Still made up, put in the lab's own numbers: {', '.join(made_up)}.")
    screen.result(
        {
            "version": JSON_VERSION,
            "name": settings.name,
            "kind": settings.kind,
            "piece": settings.piece,
            "bottom": settings.bottom,
            "limits": settings.limits.model_dump(mode="json"),
            "devices": _devices(settings),
            "placeholders": made_up,
            "calibrations": str(lab.calibrations),
        }
    )


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
    """Return the keys whose made-up default still stands."""
    usual = LabSettings(version=1, name="usual", kind="hardware")
    return [key for key in PLACEHOLDERS if _at(settings, key) == _at(usual, key)]


def _at(settings: Settings, key: str) -> object:
    value: object = settings
    for part in key.split("."):
        value = getattr(value, part)
    return value


def _connect(file: Path, screen: Screen) -> int:
    from backend.lab import LabChoice, lab_session
    from backend.session import Keep
    from backend.verbs.connecting import follow, line_text

    session = lab_session(LabChoice(file), keep=Keep(None))
    try:
        connection = session.connection
        assert connection is not None
        connection.begin()
        follow(connection, screen.say)
        lines, away = connection.lines(), connection.missing()
    finally:
        session.close()
    if away:
        screen.say(f"Not connected: {', '.join(away)}.")
    screen.result(
        {
            "version": JSON_VERSION,
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
        }
    )
    return 1 if away else 0


def _write_template(path: Path) -> None:
    text = files("resources").joinpath("benches", TEMPLATE).read_text("utf-8")
    write_new(path, text)
