"""Which trials a rate of success leaves out: those that a device ended before the release.

Every other trial that was not placed counts as a failure, whoever ended it.
"""

from __future__ import annotations

from backend.core.facts import TrialFinished
from backend.core.flow import Outcome

DEVICE_FAULTS = frozenset({
    "ARM-LINK", "ARM-STALE", "CAMERA-DARK", "CAMERA-FROZEN", "CAMERA-LINK", "CAMERA-STALE",
    "CONTROLLER", "FT-LINK", "FT-SENSOR", "FT-STALE", "MXT-ENDED", "MXT-LOST", "MXT-START",
    "PRESS-VOID", "WSG-DEVICE", "WSG-FAST-STOP", "WSG-FRAME", "WSG-LINK", "WSG-TIMEOUT",
})  # fmt: skip
"""Codes of faults that say that a device was silent, lost or broken. What a press, a grip or an
estimate came to (too much force, no contact, no piece, a stop) is a failure and not among them.
"""

AFTER = ("release", "rise")
"""Phases in which the piece is let go: what fails here no longer excuses the trial."""


def excused_by(finished: TrialFinished, last_phase: str) -> str:
    """Return the code of the device fault that keeps a trial out of the rate, "" if it counts.

    ``last_phase``: that in which the trial ended; once ``release`` has begun nothing excuses.
    """
    if finished.outcome is not Outcome.ABORTED or last_phase in AFTER:
        return ""
    # A trial that a fault ended gives the fault's own words, which end with its code.
    code = finished.reason.rpartition("[")[2].rstrip("]")
    return code if finished.reason.endswith(f"[{code}]") and code in DEVICE_FAULTS else ""
