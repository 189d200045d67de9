"""``touchdown emulate``: emulate a device over its real wire."""

from __future__ import annotations

import argparse
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path

from rich.table import Table
from rich.text import Text

from touchdown.backend import bench, core
from touchdown.backend.cli.output import VerbOutput, text_table
from touchdown.backend.config import read_toml
from touchdown.backend.devices import emulated_makes
from touchdown.backend.devices.gelsight import SERIAL
from touchdown.backend.emulation import (
    EVERY_ADDRESS,
    DeviceServer,
    Emulation,
    EmulationChoice,
    FaultPlan,
    WrenchFunction,
    add_noise,
    hanging_gripper,
    load_faults,
    own_address,
    replace_host,
)
from touchdown.backend.geometry import load_pieces
from touchdown.backend.runs import SceneChoice

STATUS_S = 0.5
BENCH = "bench"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add = parser.add_argument
    add("kind", choices=[*emulated_makes(), BENCH], help="device, or a whole bench")
    add("--host", default="127.0.0.1", help="address to listen on")
    add("--port", type=_port, help="port (default: a free one)")
    add("--tty", type=_absolute, metavar="LINK", help="link to the serial port of a wrist sensor")
    add("--faults", type=Path, metavar="FILE", help="fault plan (TOML)")
    add("--load", type=_wrench, metavar="Fx,Fy,Fz,Tx,Ty,Tz",
        help="wrench on a wrist sensor, N and N·m (default: a swaying gripper)")  # fmt: skip
    add("--part", type=float, default=20.0, metavar="MM", help="piece between the jaws; 0: none")
    add("--text", action="store_true", help="a gripper with its text protocol")
    add("--folder", type=_absolute, metavar="DIR", help="folder of the emulated camera")
    add("--finger", choices=core.FINGERS, default="left", help="which camera")
    add("--serial", default=SERIAL, help="number of the camera")
    add("--film", type=Path, metavar="FILE", help="video or picture that the camera sees")
    add("--lab-file", type=Path, metavar="FILE", help="of a bench: write the lab file that leads "
        "to it; see 'touchdown app --bench'")  # fmt: skip
    add("--piece", default="pot", help="of a bench: the grasped piece")
    add("--bottom", default="short", help="of a bench: the bottom")
    add("--preset", default="mixed", help="of a bench: noise preset")
    add("--seed", type=int, default=1, help="of a bench")
    add("--jig", action="store_true",
        help="of a bench: with an operator who hands the piece over from a jig")  # fmt: skip
    add(
        "--for", type=float, dest="for_s", metavar="S", help="end after this time (default: Ctrl-C)"
    )


def _absolute(text: str) -> Path:
    """Return an absolute path; a bench file may be read from another folder."""
    return Path(text).absolute()


def run(args: argparse.Namespace, screen: VerbOutput) -> int:
    """Serve until Ctrl-C or the end of the time; then print the statistics of the wires."""
    if args.for_s is not None and not 0 < args.for_s < float("inf"):
        raise core.InputError("The time must be positive.", "--for", "Give seconds.")
    of_bench, of_device = ("lab_file", "jig"), ("port", "tty", "load", "text", "film")
    for name in of_device if args.kind == BENCH else of_bench:
        if getattr(args, name):
            what = f"This is for {'single devices' if args.kind == BENCH else 'a bench'} only."
            raise core.InputError(what, f"--{name.replace('_', '-')}", "Leave it out.")
    with ExitStack() as rest:
        if args.kind == BENCH and args.folder is None and args.lab_file is not None:
            args.folder = Path(rest.enter_context(tempfile.TemporaryDirectory(prefix="bench-")))
        if args.kind == BENCH:
            # The threads share one interpreter lock, so none may be delayed by other programs.
            rest.enter_context(core.round_robin_priority(bench.EMULATOR_PRIORITY))
        world, emulation = _bench(args) if args.kind == BENCH else (None, _device(args))
        return _serve(args, screen, world, emulation)


def _serve(
    args: argparse.Namespace,
    screen: VerbOutput,
    world: bench.EmulatedScene | None,
    emulation: Emulation,
) -> int:
    end = threading.Event()
    begun_s = time.monotonic()
    if world is not None:
        bench.shorten_switch_interval()
        world.start()
    emulation.start()
    host = own_address() if args.host == EVERY_ADDRESS else args.host
    address = emulation.fronts[0].url.replace(EVERY_ADDRESS, host)
    tables = replace_host(emulation.bench, host)
    try:
        screen.say(f"The emulated {args.kind} answers at {address}.")
        if args.host == EVERY_ADDRESS:
            screen.say(
                "Warning: it listens on every network of this computer, without a password. Anyone "
                "there can command it. Give --host with one address to limit it."
            )
        if args.lab_file is None:
            screen.say(f"In a bench file:\n\n{bench.bench_toml(tables)}\n")
        else:
            screen.say(f"Open it with: touchdown app --bench {args.lab_file}")
        screen.say("Ctrl-C ends it.")
        with screen.ctrl_c_cancels(end.set):
            _watch(emulation, end, args.for_s, screen)
    finally:
        if world is not None:
            world.close()
        emulation.close()
    front = emulation.fronts[0]
    seen = None if world is None else world.monitor.observations()
    if seen is not None:
        screen.say(f"Recorded by the devices: {seen}.")
    screen.result({
        "kind": args.kind,
        "address": address,
        "bench": tables,
        "seconds": round(time.monotonic() - begun_s, 3),
        "clients": front.clients,
        "received_bytes": front.received,
        "sent_bytes": front.sent,
        "seen": None if seen is None else asdict(seen),
    })  # fmt: skip
    return 0


def _device(args: argparse.Namespace) -> Emulation:
    plan = load_faults(args.faults) if args.faults else FaultPlan()
    wrench: WrenchFunction = add_noise(args.load or hanging_gripper)
    part_mm = args.part if args.part > 0 else None
    wire = EmulationChoice(args.kind, args.host, args.port, args.tty, plan, wrench, part_mm)
    camera = {"finger": args.finger, "serial": args.serial, "folder": args.folder}
    return bench.emulate(replace(wire, **camera, text=args.text, film=args.film))


def _bench(args: argparse.Namespace) -> tuple[bench.EmulatedScene, Emulation]:
    if args.folder is None:
        fix = "Name a folder, or write its lab file with --lab-file."
        raise core.InputError("An emulated bench needs a folder or a lab file.", "--folder", fix)
    file = args.lab_file
    if file is not None and file.exists() and read_toml(file).get("kind") != "emulated":
        what = "This file is not of an emulated bench; it would be replaced."
        raise core.InputError(what, str(file), "Name a new file with --lab-file.")
    # Imported here: single devices do not need a scene.
    from touchdown.backend.bench import SimulatedBenchChoice, make_scene

    plan = load_faults(args.faults) if args.faults else FaultPlan()
    settings = SimulatedBenchChoice(preset=args.preset).settings()
    choice = SceneChoice(args.piece, (args.bottom,), args.seed, jig=args.jig)
    scene = make_scene(load_pieces(), choice, settings)
    where, fix = args.lab_file or args.folder, "Name another folder or --host."
    with core.disk_errors("The bench cannot be made", where, fix):
        world, emulation = bench.serve_bench(scene, args.folder, plan, args.host)
        if args.lab_file is not None:
            # The lab file is for this computer: its cameras are folders here.
            here = replace(emulation, bench=replace_host(emulation.bench, "127.0.0.1"))
            core.write_atomically(args.lab_file, bench.lab_toml(scene, here).encode())
    return world, emulation


def _watch(
    emulation: Emulation, end: threading.Event, for_s: float | None, screen: VerbOutput
) -> None:
    end_s = float("inf") if for_s is None else time.monotonic() + for_s
    with screen.status() as show:
        while not end.is_set() and (left_s := end_s - time.monotonic()) > 0:
            show(_table(emulation.fronts))
            end.wait(min(left_s, STATUS_S))


def _table(fronts: Sequence[DeviceServer]) -> Table:
    rows: list[tuple[str | Text, ...]] = []
    for front in fronts:
        name = front.faults.device or front.url.partition("://")[2]
        faults = ", ".join(front.faults.names(time.monotonic()))
        counts = (f"{count:,}" for count in (front.clients, front.received, front.sent))
        rows.append((name, *counts, Text(faults or "none", "bold red" if faults else "")))
    columns = ("clients", "bytes in", "bytes out")
    return text_table("", ("wire", *columns, "faults on"), *rows, right=columns)


def _port(text: str) -> int:
    if not text.isdigit() or not 1 <= int(text) <= 65535:
        raise argparse.ArgumentTypeError(f"'{text}' is no port (1 to 65535)")
    return int(text)


def _wrench(text: str) -> WrenchFunction:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != 6 or not all(abs(value) < float("inf") for value in values):
        raise argparse.ArgumentTypeError(f"'{text}' is not six finite numbers")
    return lambda now_s: values
