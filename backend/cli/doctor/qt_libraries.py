"""Missing system libraries of Qt on Linux and the Debian packages that provide them.

Run as a module (``python -m touchdown.backend.cli.doctor.qt_libraries``) it prints the missing
packages in one line for the set-up script.
"""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

PLUGINS = ("libqoffscreen.so", "libqxcb.so")
LIBRARIES = ("libQt6Gui.so.6", "libQt6Widgets.so.6", "libQt6OpenGL.so.6", "libQt6Svg.so.6")

# Shared-object name to Debian 12 / Ubuntu 22.04 package; newer releases provide the old names
# (libglib2.0-0 is provided by libglib2.0-0t64). Read with ldd from Qt 6.11.3.
PACKAGES = {
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
    "libgthread-2.0.so.0": "libglib2.0-0",
    "libglib-2.0.so.0": "libglib2.0-0",
    "libfontconfig.so.1": "libfontconfig1",
    "libfreetype.so.6": "libfreetype6",
    "libdbus-1.so.3": "libdbus-1-3",
    "libxkbcommon.so.0": "libxkbcommon0",
    "libxkbcommon-x11.so.0": "libxkbcommon-x11-0",
    "libX11.so.6": "libx11-6",
    "libX11-xcb.so.1": "libx11-xcb1",
    "libxcb.so.1": "libxcb1",
}

XCB = (
    "cursor.so.0 icccm.so.4 image.so.0 keysyms.so.1 randr.so.0 render.so.0 "
    "render-util.so.0 shape.so.0 shm.so.0 sync.so.1 util.so.1 xfixes.so.0 xkb.so.1"
)
PACKAGES |= {f"libxcb-{name}": f"libxcb-{name.replace('.so.', '')}" for name in XCB.split()}


def missing_in(report: str) -> list[str]:
    """Return the shared objects that ``ldd`` reports as "not found", without duplicates."""
    names = (line.split("=>")[0].strip() for line in report.splitlines() if "not found" in line)
    # "version `GLIBC_2.34' not found" is about an installed library.
    return list(dict.fromkeys(name for name in names if ".so" in name and ":" not in name))


def packages_for(libraries: Iterable[str]) -> list[str]:
    """Return the Debian packages of ``libraries``; unknown libraries are left out."""
    return list(dict.fromkeys(PACKAGES[name] for name in libraries if name in PACKAGES))


def qt_files() -> list[Path]:
    """Return the installed Qt files whose dependencies are checked; empty without Qt."""
    spec = importlib.util.find_spec("PySide6")
    if spec is None or not spec.submodule_search_locations:
        return []
    qt = Path(spec.submodule_search_locations[0]) / "Qt"
    wanted = [qt / "plugins" / "platforms" / name for name in PLUGINS]
    wanted += [qt / "lib" / name for name in LIBRARIES]
    return [path for path in wanted if path.is_file()]


def missing_libraries() -> list[str]:
    """Return the missing shared objects on Linux; empty elsewhere and without ``ldd``."""
    files = qt_files()
    if not sys.platform.startswith("linux") or not files:
        return []
    try:
        done = subprocess.run(
            ["ldd", *map(str, files)],  # noqa: S607 (ldd lies in different folders)
            capture_output=True,
            text=True,
            timeout=20,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return []
    return missing_in(done.stdout)


if __name__ == "__main__":
    sys.stdout.write(" ".join(packages_for(missing_libraries())))
