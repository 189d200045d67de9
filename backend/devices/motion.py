"""Commands in progress: what every driver answers an order with, and how it may end."""

from __future__ import annotations

from collections.abc import Mapping

from backend.core.faults import Fault, FaultError

VOID_PRESS = "PRESS-VOID"
"""Code of a press during which the arm stood still for a moment: what was felt does not count."""


class CommandedMotion:
    """Ends once, well or with a fault; ``sent`` is what really went out."""

    def __init__(self, sent: Mapping[str, float]) -> None:
        self._sent = dict(sent)
        self._done = False
        self._fault: Fault | None = None

    @property
    def done(self) -> bool:
        """Whether it ended."""
        return self._done

    @property
    def sent(self) -> Mapping[str, float]:
        """What was sent, after limits."""
        return self._sent

    def result(self) -> None:
        """Return if it ended well; raise the fault if not; ValueError while under way."""
        if not self._done:
            raise ValueError("the motion is still under way")
        if self._fault is not None:
            raise FaultError(self._fault)

    def end(self, fault: Fault | None = None) -> None:
        """End; only the first ending counts."""
        if not self._done:
            self._fault = fault
            self._done = True


def stopped_fault(device: str) -> Fault:
    """Return the fault of a motion that was stopped."""
    return Fault(
        "STOPPED",
        "The motion was stopped.",
        "The device stands still; the gripper was not opened.",
        "Look at the bench, then press Reset.",
        device,
    )


def replaced_fault(device: str) -> Fault:
    """Return the fault of a motion that another command took the place of."""
    return Fault(
        "REPLACED",
        "Another command took the place of this motion.",
        "The device follows the newer command.",
        "Wait for a motion to end before the next command.",
        device,
    )


def servo_off_fault(device: str) -> Fault:
    """Return the fault of an order to an arm whose motors are off."""
    return Fault(
        "SERVO-OFF",
        "The servo of the arm is off.",
        "Nothing was moved.",
        "Hold Servo in the top bar for 1 s.",
        device,
    )
