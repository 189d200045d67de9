"""What some grippers need of the operator: to be homed, and a fast stop acknowledged."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from backend.core.faults import Fault
from backend.devices.protocols import Gripper, Motion


@runtime_checkable
class Homing(Gripper, Protocol):
    """A gripper that finds its origin on the operator's word.

    ``lost_holding``: a piece was held when the connection was lost, so that a fast stop waits for
    the operator, also in the next connection.
    """

    lost_holding: bool

    @property
    def homed(self) -> bool:
        """Whether it knows where its jaws are."""

    @property
    def fault(self) -> Fault | None:
        """What has to be acknowledged, or why the connection was lost."""

    def home(self) -> Motion:
        """Find the origin, with empty jaws only."""

    def acknowledge(self) -> None:
        """Take a fast stop or fault as seen."""
