"""What can be wrong with a wrist sensor, in the operator's words."""

from __future__ import annotations

from backend.core.faults import Fault

NAME = "force_torque"

OVERLOAD = Fault(
    "FT-OVERLOAD",
    "The force/torque sensor is at the end of its range.",
    "Forces beyond are not measured; the arm draws back by 2 mm. The gripper was not opened.",
    "Relieve the sensor, check its zero, then connect it again.",
    NAME,
)


def link_fault(what: str) -> Fault:
    """Return the fault of a connection that is not, or no longer, there."""
    return Fault(
        "FT-LINK",
        what,
        "No wrench is measured.",
        "Check cable and power of the force/torque sensor, and that no other program reads it; "
        "then connect it again.",
        NAME,
    )


def driver_fault(error: Exception) -> Fault:
    """Return the fault of a language that failed on something it did not expect."""
    return Fault(
        "FT-DRIVER",
        f"The driver of the force/torque sensor failed: {type(error).__name__}: {error}.",
        "No wrench is measured.",
        "Report the text of the log to who wrote the driver; then connect the sensor again.",
        NAME,
    )


def sensor_fault(what: str) -> Fault:
    """Return the fault that the sensor itself reports."""
    return Fault(
        "FT-SENSOR",
        f"{what}.",
        "No wrench is measured.",
        "Switch the force/torque sensor off and on, then connect it again.",
        NAME,
    )
