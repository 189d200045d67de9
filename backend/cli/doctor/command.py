"""``touchdown doctor``: check this computer, the devices of a lab file or a dataset, with a fix for
each finding.

Heavy packages are not imported in this process; they are examined by their metadata or in a child
process.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import TYPE_CHECKING

from rich.text import Text

from touchdown.backend.cli.doctor.qt_libraries import missing_libraries, packages_for
from touchdown.backend.cli.output import VerbOutput, check_new
from touchdown.backend.core import InputError, check_writable, data_folder, package_version

if TYPE_CHECKING:
    from touchdown.backend.config import Lab, LabSettings


@dataclass(frozen=True, slots=True)
class DoctorCheck:
    """Result of one check.

    ``ok`` is False only for a finding that stops Touchdown from working. A missing optional part is
    ``ok`` with a ``fix`` that says how to get it. ``fix`` is empty if nothing is to be done.
    """

    name: str
    ok: bool
    detail: str
    fix: str = ""

    @property
    def word(self) -> str:
        """OK, NOTE (optional part missing) or FAIL."""
        if not self.ok:
            return "FAIL"
        return "NOTE" if self.fix else "OK"


CheckFunction = Callable[[], DoctorCheck]


LEAST_FREE_GB = 2.0
CAMERAS = Path("/dev/v4l/by-id")
PIECES = ("pot", "mushroom", "barrel")


def check_display() -> DoctorCheck:
    """Check for a display server."""
    if not sys.platform.startswith("linux"):
        return DoctorCheck("display", True, "native")
    wayland, x11 = os.environ.get("WAYLAND_DISPLAY"), os.environ.get("DISPLAY")
    if wayland or x11:
        return DoctorCheck("display", True, f"Wayland {wayland}" if wayland else f"X11 {x11}")
    fix = "Work without one ('make demo', 'touchdown stack'), or log in to a desktop."
    return DoctorCheck("display", True, "none: no window can be opened", fix)


def check_cameras(folder: Path = CAMERAS) -> DoctorCheck:
    """Check for tactile cameras by their stable names (index 0; index 1 is metadata)."""
    found = [path.name for path in folder.glob("*-index0")] if folder.is_dir() else []
    fix = "Connect both tactile sensors by USB; add your account to the group 'video'."
    return _optional_devices("cameras", found, "none connected", fix)


def check_serial_ports() -> DoctorCheck:
    """Check for serial ports of a force/torque sensor."""
    from serial.tools import list_ports

    found = [f"{port.device} ({port.description})" for port in list_ports.comports()]
    fix = "Connect the sensor; add your account to the group 'dialout'."
    return _optional_devices("serial ports", found, "none", fix)


def _optional_devices(name: str, found: list[str], absent: str, fix: str) -> DoctorCheck:
    if found:
        return DoctorCheck(name, True, ", ".join(sorted(found)))
    return DoctorCheck(name, True, f"{absent} (the simulated bench needs none)", fix)


def check_processors() -> DoctorCheck:
    """Count the processors available to this process."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    if usable is not None and usable >= 2:
        return DoctorCheck("processors", True, f"{usable} usable")
    return DoctorCheck("processors", True, f"{usable} usable", "Use at least 2 for live runs.")


def check_data_folder(folder: Path | None = None) -> DoctorCheck:
    """Check that the data folder can be written."""
    folder = folder or data_folder()
    try:
        check_writable(folder)
    except OSError as error:
        reason = error.strerror or "not writable"
        fix = "Name another folder in TOUCHDOWN_DATA, or change its permissions."
        return DoctorCheck("data folder", False, f"{folder}: {reason}", fix)
    return DoctorCheck("data folder", True, str(folder))


def check_disk(folder: Path | None = None) -> DoctorCheck:
    """Check the free space of the data folder."""
    place = folder or data_folder()
    while not place.exists():
        place = place.parent
    free_gb = shutil.disk_usage(place).free / 1e9
    ok = free_gb >= LEAST_FREE_GB
    fix = "" if ok else f"Free space: at least {LEAST_FREE_GB:.0f} GB, or set TOUCHDOWN_DATA."
    return DoctorCheck("disk", ok, f"{free_gb:.1f} GB free at {place}", fix)


def check_models(folder: Traversable | None = None) -> DoctorCheck:
    """Check the shipped models, one per piece."""
    models = files("touchdown.resources").joinpath("models") if folder is None else folder
    entries = models.iterdir() if models.is_dir() else ()
    shipped = sorted(entry.name for entry in entries if entry.name.endswith(".safetensors"))
    absent = [piece for piece in PIECES if not any(name.startswith(piece) for name in shipped)]
    if absent:
        return DoctorCheck("models", False, f"missing for {', '.join(absent)}", "make models")
    return DoctorCheck("models", True, ", ".join(shipped))


def check_catalogue(folder: Path | None = None) -> DoctorCheck:
    """Read the shipped pieces (and those of ``folder``) and name the first broken file."""
    from touchdown.backend.geometry import load_pieces

    try:
        catalogue = load_pieces(folder)
    except InputError as error:
        fix = f"{error.fix} A shipped file: install Touchdown again."
        return DoctorCheck("catalogue", False, f"{error.where}: {error.what}", fix)
    absent = [piece for piece in PIECES if piece not in catalogue.pieces]
    if absent:
        detail = f"no piece file for {', '.join(absent)}"
        return DoctorCheck("catalogue", False, detail, "Install Touchdown again.")
    return DoctorCheck("catalogue", True, ", ".join(sorted(catalogue.pieces)))


QT_INSTALL = (
    'pip install --force-reinstall "PySide6-Essentials>=6.8,!=6.9.1,<6.12" "pyqtgraph>=0.13.7"'
)
CHILD_LIMIT_S = 60
BUSY = "The computer was too busy for this check. Close other programs and repeat."


def check_python() -> DoctorCheck:
    """Check for CPython 3.11 or newer."""
    found = f"{platform.python_implementation()} {platform.python_version()}"
    ok = sys.version_info >= (3, 11) and platform.python_implementation() == "CPython"
    return DoctorCheck("python", ok, found, "" if ok else "Install CPython 3.11, 3.12 or 3.13.")


def qt_pair_fault(qt: str, python: tuple[int, int]) -> str:
    """Return the defect of this PySide6 version on this CPython, or "".

    6.9.1 draws no pyqtgraph curves (pyqtgraph issue 3326); 6.12.0 loses references to True, False
    and None on CPython below 3.12 and aborts; versions below 6.8 are untested.
    """
    numbers = tuple(int(part) for part in qt.split(".")[:3] if part.isdigit())
    if numbers == (6, 9, 1):
        return "PySide6 6.9.1 draws no curves."
    if numbers >= (6, 12) and python < (3, 12):
        return f"PySide6 {qt} aborts on CPython {python[0]}.{python[1]}."
    if not (6, 8) <= numbers < (6, 12):
        return f"PySide6 {qt} is outside the tested window 6.8 to 6.11."
    return ""


def check_qt_versions() -> DoctorCheck:
    """Check for PySide6-Essentials without Addons, in a working version, and for pyqtgraph."""
    qt = package_version("PySide6-Essentials")
    if not qt:
        absent = "not installed (optional, for the window)"
        return DoctorCheck("qt", True, absent, 'pip install "touchdown[app]"')
    shiboken = package_version("shiboken6")
    if shiboken != qt:
        pair = f"PySide6-Essentials {qt} with shiboken6 {shiboken}"
        return DoctorCheck("qt", False, pair, QT_INSTALL)
    spec = importlib.util.find_spec("PySide6")
    if spec is None or spec.origin is None:
        # Uninstalling PySide6-Addons removes the shared PySide6/__init__.py.
        return DoctorCheck("qt", False, "the package PySide6 is damaged", QT_INSTALL)
    fault = qt_pair_fault(qt, sys.version_info[:2])
    if not fault and not package_version("pyqtgraph"):
        fault = "pyqtgraph is not installed."
    full = package_version("PySide6")
    if full and not fault:
        fault = f"PySide6 {full} and PySide6-Essentials {qt} are mixed."
    fix = QT_INSTALL if fault else ""
    return DoctorCheck("qt", not fault, fault or f"PySide6-Essentials {qt}", fix)


def check_qt_libraries() -> DoctorCheck:
    """Check the system libraries of Qt's platform plugins."""
    missing = missing_libraries()
    if not missing:
        return DoctorCheck("qt libraries", True, "complete")
    packages = packages_for(missing)
    fix = f"sudo apt-get install {' '.join(packages)}" if packages else "Install these libraries."
    return DoctorCheck("qt libraries", False, f"missing: {', '.join(missing)}", fix)


def check_qt_platform() -> DoctorCheck:
    """Start Qt offscreen in a child process, because a failure aborts."""
    if not package_version("PySide6-Essentials"):
        return DoctorCheck("qt platform", True, "no Qt")
    code = (
        "import sys; from PySide6.QtWidgets import QApplication; "
        "sys.stdout.write(QApplication([]).platformName())"
    )
    done = _child(code, {"QT_QPA_PLATFORM": "offscreen"})
    if done is None:
        return _unanswered("qt platform")
    if done.returncode == 0:
        return DoctorCheck("qt platform", True, f"{done.stdout.strip()} plugin starts")
    tail = (done.stderr.strip().splitlines() or ["aborted"])[-1]
    return DoctorCheck("qt platform", False, tail, "See 'qt' and 'qt libraries' above.")


def check_opencv() -> DoctorCheck:
    """Check for headless OpenCV only; other builds bring a second Qt into the process."""
    name = "opencv-contrib-python-headless"
    unwanted = ("opencv-python", "opencv-contrib-python", "opencv-python-headless")
    others = [other for other in unwanted if package_version(other)]
    if others:
        fix = f"pip uninstall -y {' '.join(others)} && pip install --force-reinstall {name}"
        return DoctorCheck("opencv", False, f"also installed: {', '.join(others)}", fix)
    found = package_version(name)
    fix = "" if found else f"pip install {name}"
    return DoctorCheck("opencv", bool(found), found or "not installed", fix)


def check_torch() -> DoctorCheck:
    """Read version, threads and device of torch in a child process; its import is slow."""
    if not package_version("torch"):
        fix = "pip install torch (the CPU build will do)"
        return DoctorCheck("torch", False, "not installed", fix)
    code = (
        "import json, sys, torch\n"
        "gpu = torch.cuda.get_device_name(0) if torch.cuda.is_available() else ''\n"
        "json.dump([torch.__version__, torch.get_num_threads(), gpu], sys.stdout)\n"
    )
    done = _child(code, {})
    if done is None:
        return _unanswered("torch")
    if done.returncode != 0:
        fix = "pip install --force-reinstall torch"
        return DoctorCheck("torch", False, "cannot be imported", fix)
    release, threads, gpu = json.loads(done.stdout)
    where = f"GPU: {gpu}" if gpu else f"CPU, {threads} threads"
    return DoctorCheck("torch", True, f"{release} on {where}")


def check_others() -> DoctorCheck:
    """Check the other required packages."""
    required = ["numpy", "scipy", "pydantic", "rich", "safetensors", "zstandard", "pyserial"]
    if absent := [name for name in required if not package_version(name)]:
        fix = f"pip install {' '.join(absent)}"
        return DoctorCheck("packages", False, f"missing: {', '.join(absent)}", fix)
    listed = ", ".join(f"{name} {package_version(name)}" for name in required)
    return DoctorCheck("packages", True, listed)


def check_mujoco() -> DoctorCheck:
    """Check for MuJoCo (optional second judge and fall animation)."""
    found = package_version("mujoco-core") or package_version("mujoco")
    fix = "" if found else 'pip install "touchdown[mujoco]"'
    return DoctorCheck("mujoco", True, found or "not installed (optional)", fix)


def _unanswered(name: str) -> DoctorCheck:
    return DoctorCheck(name, False, f"no answer within {CHILD_LIMIT_S} s", BUSY)


def _child(code: str, extra: dict[str, str]) -> subprocess.CompletedProcess[str] | None:
    """Run ``code`` in another interpreter; None if it exceeds the time limit."""
    try:
        return subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True,
            text=True,
            timeout=CHILD_LIMIT_S,
            check=False,
            env={**os.environ, **extra},
        )
    except subprocess.TimeoutExpired:
        return None


LAB_CHECKS = 8  # the lab file, its placeholders, its cameras, and five devices


def lab_checks(path: Path) -> Iterator[DoctorCheck]:
    """Check a lab file and its devices; raises ``InputError`` if it cannot be read."""
    from touchdown.backend.config import load_lab
    from touchdown.backend.rig import examine_devices

    lab = load_lab(path)
    settings = lab.settings
    yield DoctorCheck("lab file", True, f"{settings.name} ({settings.kind}), {path}")
    yield _check_placeholders(settings)
    yield _check_fingers(lab)
    for found in examine_devices(settings):
        yield DoctorCheck(found.device, found.ok, found.detail, found.fix)


def _check_placeholders(settings: LabSettings) -> DoctorCheck:
    from touchdown.backend.cli.bench import placeholders

    names = placeholders(settings) if settings.kind == "hardware" else []
    if not names:
        return DoctorCheck("made up", True, "nothing")
    return DoctorCheck("made up", True, ", ".join(names), "Enter the values of the lab.")


def _check_fingers(lab: Lab) -> DoctorCheck:
    from touchdown.backend.bench import find_camera_conflicts

    told = find_camera_conflicts(lab)
    if not told:
        return DoctorCheck("cameras", True, "at the fingers of the lab file, as far as known")
    what, _, fix = next(iter(told.values())).partition(". ")
    return DoctorCheck("cameras", True, what, f"{fix}.")


EXAMINATIONS: tuple[CheckFunction, ...] = (
    check_python,
    check_qt_versions,
    check_qt_libraries,
    check_qt_platform,
    check_display,
    check_opencv,
    check_torch,
    check_others,
    check_mujoco,
    check_processors,
    check_cameras,
    check_serial_ports,
    check_data_folder,
    check_disk,
    check_catalogue,
    check_models,
)

COLOURS = {"OK": "green", "NOTE": "yellow", "FAIL": "bold red"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "--bench", type=Path, metavar="FILE", help="check the devices of a lab file instead"
    )
    group = parser.add_mutually_exclusive_group()
    group.add_argument(
        "--dataset",
        nargs="?",
        const="",
        metavar="DIR",
        help="check a dataset instead, without changes (default: the one in the data folder)",
    )
    group.add_argument(
        "--bundle", type=Path, metavar="FILE.zip",
        help="write a problem report: findings, versions, settings, logs and the last run",
    )  # fmt: skip
    kept = "names of persons, account, computer and home folder"
    for what, told in (("pictures", "pictures of the last run"), ("names", kept)):
        parser.add_argument(
            f"--with-{what}", action="store_true", help=f"with --bundle: also {told}"
        )


def run(args: argparse.Namespace, screen: VerbOutput) -> int:
    """Print all findings; return 1 if one of them stops Touchdown from working."""
    # Imported here so that the check does not load what it checks (OpenCV).
    from touchdown.backend.cli.dataset import examine_only
    from touchdown.backend.runs import dataset_folder

    if args.bench is not None and args.dataset is not None:
        fix = "Check them one after the other."
        raise InputError("A bench and a dataset are separate checks.", "--bench, --dataset", fix)
    if (args.with_pictures or args.with_names) and args.bundle is None:
        what, where = "These belong to a problem report.", "--with-pictures, --with-names"
        raise InputError(what, where, "Add --bundle FILE.zip.")
    if args.bundle is not None:
        check_new(args.bundle)
    if args.dataset is not None:
        folder = Path(args.dataset) if args.dataset else dataset_folder()
        return examine_only(folder, screen)
    found: Iterator[DoctorCheck]
    found, total = map(_run_check, EXAMINATIONS), len(EXAMINATIONS)
    if args.bench is not None:
        found, total = lab_checks(args.bench), LAB_CHECKS
    checks = []
    with screen.progress("Examining", total) as advance:
        for check in found:
            checks.append(check)
            advance(len(checks), check.name)
    rows = ((Text(c.word, COLOURS[c.word]), c.name, c.detail, c.fix) for c in checks)
    screen.table("touchdown doctor", ("", "check", "found", "what to do"), *rows)
    failed = [check for check in checks if not check.ok]
    screen.say("Everything required is present." if not failed else f"{len(failed)} to fix.")
    answer: dict[str, object] = {"checks": [asdict(check) for check in checks]}
    if args.bundle is not None:
        from touchdown.backend.cli.doctor.problem_report import write_report

        kept = {"pictures": args.with_pictures, "names": args.with_names}
        written = write_report(args.bundle, answer, lab=args.bench, **kept)
        screen.say(
            f"Problem report of {len(written)} files: {args.bundle}. Read them before you send it."
        )
        answer["bundle"] = {"file": str(args.bundle), "files": written}
    screen.result(answer)
    return 1 if failed else 0


def _run_check(look: CheckFunction) -> DoctorCheck:
    name = look.__name__.removeprefix("check_").replace("_", " ")
    try:
        return look()
    except (ImportError, OSError) as error:
        # Doctor must run on a damaged installation.
        return DoctorCheck(name, False, f"cannot be examined: {error}", "make setup")
