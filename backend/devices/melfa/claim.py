"""One program per controller: whoever drives it holds a lock named after its address.

The lock is of this computer; another computer is refused by the controller's operation right.
"""

from __future__ import annotations

import os
import re
import tempfile
from pathlib import Path

from backend.core.faults import Fault, FaultError
from backend.core.locks import lock_file
from backend.devices.streamed.motion import ARM, NOTHING_MOVED


def claim(host: str, port: int) -> int:
    """Return a descriptor that holds the claim until it is closed; raises ``FaultError``."""
    name = re.sub(r"[^A-Za-z0-9.-]", "_", host)
    path = Path(tempfile.gettempdir()) / f"touchdown-arm-{name}-{port}.lock"
    try:
        return lock_file(path)
    except OSError as error:
        raise FaultError(taken_fault(f"{host}:{port}")) from error


def let_go(descriptor: int) -> None:
    """Give the claim back; the file stays, or two could hold it."""
    os.close(descriptor)


def taken_fault(address: str) -> Fault:
    """Return the fault of a controller that another program of this computer drives."""
    return Fault(
        "ARM-TAKEN",
        f"Another program on this computer drives the controller at {address}.",
        NOTHING_MOVED,
        "Close the arm there first.",
        ARM,
    )
