"""A sample that was needed and is too old, as a fault of the device that should have sent it."""

from __future__ import annotations

from backend.core.faults import Fault, StaleSampleError

CODES = {"arm": "ARM-STALE", "force_torque": "FT-STALE"}
SAYS = {"arm": "The arm does not tell where it is"}


def stale_fault(error: StaleSampleError) -> Fault:
    """Return the fault of ``error``, which begins with the name of the stream."""
    name, _, detail = str(error).partition(": ")
    says = SAYS.get(name, f"No fresh sample of '{name}'")
    return Fault(
        CODES.get(name, "SAMPLE-STALE"),
        f"{says}: {detail or name}.",
        "Nothing was moved on it; the gripper was not opened.",
        "Check the device and its cable, press Reset, then connect it again.",
        name if name in CODES else "",
    )
