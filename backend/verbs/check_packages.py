"""Doctor's look at the interpreter and the installed packages (nothing heavy is imported)."""

from __future__ import annotations

import importlib.util
import json
import os
import platform
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version

from backend.verbs.check import Check
from backend.verbs.qt_libraries import missing_libraries, packages_for

QT_INSTALL = 'pip install --force-reinstall "PySide6-Essentials>=6.8,!=6.9.1,<6.12"'
CHILD_LIMIT_S = 60
BUSY = "Nothing may be wrong: this computer was too busy to tell. Close what else runs, ask again."


def installed(name: str) -> str | None:
    """Return the installed version of distribution ``name``, or None."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def check_python() -> Check:
    """Look for CPython 3.11 or newer."""
    found = f"{platform.python_implementation()} {platform.python_version()}"
    ok = sys.version_info >= (3, 11) and platform.python_implementation() == "CPython"
    return Check("python", ok, found, "" if ok else "Install CPython 3.11, 3.12 or 3.13.")


def qt_pair_fault(qt: str, python: tuple[int, int]) -> str:
    """Return what is wrong with this PySide6 version on this CPython, or an empty text.

    6.9.1 draws no pyqtgraph curves (pyqtgraph issue 3326); 6.12.0 loses references to True, False
    and None on CPython below 3.12 and aborts; below 6.8 nothing was tried.
    """
    numbers = tuple(int(part) for part in qt.split(".")[:3] if part.isdigit())
    if numbers == (6, 9, 1):
        return "PySide6 6.9.1 draws no curves."
    if numbers >= (6, 12) and python < (3, 12):
        return f"PySide6 {qt} aborts on CPython {python[0]}.{python[1]}."
    if not (6, 8) <= numbers < (6, 12):
        return f"PySide6 {qt} is outside the tested window 6.8 to 6.11."
    return ""


def check_qt_versions() -> Check:
    """Look for PySide6-Essentials alone, in a version that works with this interpreter."""
    qt = installed("PySide6-Essentials")
    if qt is None:
        return Check("qt", False, "PySide6-Essentials is not installed", QT_INSTALL)
    shiboken = installed("shiboken6")
    if shiboken != qt:
        return Check("qt", False, f"PySide6-Essentials {qt} with shiboken6 {shiboken}", QT_INSTALL)
    spec = importlib.util.find_spec("PySide6")
    if spec is None or spec.origin is None:
        # Uninstalling PySide6-Addons removes the shared PySide6/__init__.py.
        return Check("qt", False, "the package PySide6 is damaged", QT_INSTALL)
    fault = qt_pair_fault(qt, sys.version_info[:2])
    full = installed("PySide6")
    if full is not None and not fault:
        fault = f"PySide6 {full} and PySide6-Essentials {qt} are mixed."
    return Check("qt", not fault, fault or f"PySide6-Essentials {qt}", QT_INSTALL if fault else "")


def check_qt_libraries() -> Check:
    """Look for the system libraries of Qt's platform plugins."""
    missing = missing_libraries()
    if not missing:
        return Check("qt libraries", True, "complete")
    packages = packages_for(missing)
    fix = f"sudo apt-get install {' '.join(packages)}" if packages else "Install these libraries."
    return Check("qt libraries", False, f"missing: {', '.join(missing)}", fix)


def check_qt_platform() -> Check:
    """Start Qt without a display (offscreen), in a child process because a failure aborts."""
    code = (
        "from PySide6.QtWidgets import QApplication\n"
        "import sys\n"
        "sys.stdout.write(QApplication([]).platformName())\n"
    )
    done = _child(code, {"QT_QPA_PLATFORM": "offscreen"})
    if done is None:
        return _unanswered("qt platform")
    if done.returncode == 0:
        return Check("qt platform", True, f"{done.stdout.strip()} plugin starts")
    tail = (done.stderr.strip().splitlines() or ["aborted"])[-1]
    return Check("qt platform", False, tail, "See 'qt' and 'qt libraries' above.")


def check_opencv() -> Check:
    """Look for the headless OpenCV alone: others bring a second Qt into the process."""
    name = "opencv-contrib-python-headless"
    others = [
        other
        for other in ("opencv-python", "opencv-contrib-python", "opencv-python-headless")
        if installed(other) is not None
    ]
    if others:
        fix = f"pip uninstall -y {' '.join(others)} && pip install --force-reinstall {name}"
        return Check("opencv", False, f"also installed: {', '.join(others)}", fix)
    found = installed(name)
    fix = "" if found else f"pip install {name}"
    return Check("opencv", found is not None, found or "not installed", fix)


def check_torch() -> Check:
    """Ask torch for version, threads and device, in a child process (its import is slow)."""
    if installed("torch") is None:
        return Check("torch", False, "not installed", "pip install torch (the CPU build will do)")
    code = (
        "import json, sys, torch\n"
        "gpu = torch.cuda.get_device_name(0) if torch.cuda.is_available() else ''\n"
        "json.dump([torch.__version__, torch.get_num_threads(), gpu], sys.stdout)\n"
    )
    done = _child(code, {})
    if done is None:
        return _unanswered("torch")
    if done.returncode != 0:
        return Check("torch", False, "cannot be imported", "pip install --force-reinstall torch")
    release, threads, gpu = json.loads(done.stdout)
    where = f"GPU: {gpu}" if gpu else f"CPU, {threads} threads"
    return Check("torch", True, f"{release} on {where}")


def check_others() -> Check:
    """Look for the other required packages, and the optional judge."""
    required = (
        "pyqtgraph",
        "numpy",
        "scipy",
        "pydantic",
        "rich",
        "safetensors",
        "zstandard",
        "pyserial",
    )
    absent = [name for name in required if installed(name) is None]
    if absent:
        detail = f"missing: {', '.join(absent)}"
        return Check("packages", False, detail, f"pip install {' '.join(absent)}")
    listed = ", ".join(f"{name} {installed(name)}" for name in required)
    return Check("packages", True, listed)


def check_mujoco() -> Check:
    """Look for MuJoCo (second judge and fall animation, optional)."""
    found = installed("mujoco-core") or installed("mujoco")
    if found:
        return Check("mujoco", True, found)
    return Check("mujoco", True, "not installed (optional)", 'pip install "touchdown[mujoco]"')


def _unanswered(name: str) -> Check:
    return Check(name, False, f"no answer within {CHILD_LIMIT_S} s", BUSY)


def _child(code: str, extra: dict[str, str]) -> subprocess.CompletedProcess[str] | None:
    """Run ``code`` in an interpreter of its own; None if it has not ended within the limit."""
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
