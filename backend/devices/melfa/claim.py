"""One program per controller: whoever drives it holds a lock named after its address.

The lock is of this computer; another computer is refused by the controller's operation right. Its
file is taken away by who gives it back, and what a killed program left, by the next claim.
"""

from __future__ import annotations

import os
import re
import tempfile
import threading
from pathlib import Path

from backend.core.faults import Fault, FaultError
from backend.core.locks import lock_file
from backend.devices.streamed.motion import ARM, NOTHING_MOVED

PREFIX, SUFFIX = "touchdown-arm-", ".lock"
TRIES, AGAIN_S = 5, 0.02
"""Who takes old files away holds each for an instant: that is no other program at the arm."""


class Claim:
    """Holds a controller until ``close``; raises ``FaultError`` if another program holds it."""

    def __init__(self, host: str, port: int) -> None:
        name = re.sub(r"[^A-Za-z0-9.-]", "_", host)
        folder = Path(tempfile.gettempdir())
        self._path = folder / f"{PREFIX}{name}-{port}{SUFFIX}"
        _sweep(folder, self._path)
        try:
            self._descriptor = _lock_patiently(self._path)
        except OSError as error:
            raise FaultError(taken_fault(f"{host}:{port}")) from error

    def close(self) -> None:
        """Give the controller back."""
        _take_away(self._descriptor, self._path)


def _lock_patiently(path: Path) -> int:
    for _ in range(TRIES - 1):
        try:
            return _lock(path)
        except BlockingIOError:
            threading.Event().wait(AGAIN_S)
    return _lock(path)


def _lock(path: Path) -> int:
    """Lock ``path`` itself: not a file that was taken away while its lock was waited for."""
    while True:
        descriptor = lock_file(path)
        if os.name != "posix" or _is_there(descriptor, path):
            return descriptor
        os.close(descriptor)


def _is_there(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


def _take_away(descriptor: int, path: Path) -> None:
    if os.name == "posix":
        # Still locked: whoever waits for it finds that it is gone and makes a new one.
        path.unlink(missing_ok=True)
    os.close(descriptor)


def _sweep(folder: Path, wanted: Path) -> None:
    """Take away the files that nobody holds any more."""
    if os.name != "posix":
        return
    for found in folder.glob(f"{PREFIX}*{SUFFIX}"):
        if found == wanted:
            continue
        try:
            descriptor = _lock(found)
        except OSError:
            continue
        _take_away(descriptor, found)


def taken_fault(address: str) -> Fault:
    """Return the fault of a controller that another program of this computer drives."""
    return Fault(
        "ARM-TAKEN",
        f"Another program on this computer drives the controller at {address}.",
        NOTHING_MOVED,
        "Close the arm there first.",
        ARM,
    )
