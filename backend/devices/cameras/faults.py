"""What can be wrong with a tactile camera, in the operator's words."""

from __future__ import annotations

from backend.core.faults import Fault


def link_fault(name: str, what: str) -> Fault:
    """Return the fault of a camera that is not, or no longer, there."""
    return Fault(
        "CAMERA-LINK",
        what,
        "This finger feels nothing.",
        "Check the USB cable; the camera is taken again by its number as soon as it is back.",
        name,
    )


def frozen_fault(name: str) -> Fault:
    """Return the fault of a camera that sends the same picture again and again."""
    return Fault(
        "CAMERA-FROZEN",
        "The camera sends the same picture again and again.",
        "Its pictures are not used.",
        "Unplug the camera and plug it in again.",
        name,
    )


def dark_fault(name: str) -> Fault:
    """Return the fault of a camera whose pictures stay dark."""
    return Fault(
        "CAMERA-DARK",
        "The pictures stay dark.",
        "No marker can be seen.",
        "Check the lamps of the sensor and its exposure.",
        name,
    )
