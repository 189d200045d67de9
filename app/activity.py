"""Whether something goes on at the bench: asked by the frame, not by one workspace."""

from __future__ import annotations

from app.link import Link
from backend.devices.degraded import NAMES
from backend.devices.protocols import RobotMode
from backend.runs.requests import RunState

LASTING_S = 1.0
"""A sensor that is degraded for so long keeps the start of a run disabled."""
ACTIVE = frozenset(
    {RunState.PREPARING, RunState.RUNNING, RunState.PAUSING, RunState.PAUSED, RunState.CANCELLING,
     RunState.FINISHING}
)  # fmt: skip
MOVING = ACTIVE - {RunState.PAUSED}


def busy(link: Link) -> bool:
    """Whether a run is active."""
    return link.status().state in ACTIVE


def moving(link: Link) -> bool:
    """Whether something may be moving (Space then means STOP)."""
    status = link.status()
    if status.state in MOVING and status.awaiting is None and not status.asks:
        return True
    arm = link.devices.get("arm")
    mode = getattr(arm, "status", None)
    return mode is not None and mode().robot_mode is RobotMode.MOVING


def not_set(link: Link) -> str:
    """Return why there is no scene to move in, "" where that does not matter."""
    if link.connection is not None:
        if link.connection.busy:
            return "The devices are being connected"
        return "Connect the bench first (Ctrl+L)"
    return "" if link.devices else "The bench is being prepared"


def why_no_run(link: Link) -> str:
    """Return why no run may start although none is active, "" if one may."""
    if link.interlock.latched:
        return "Press Reset first"
    if link.hand is None and not_set(link):
        return not_set(link)
    if link.hand is not None and not link.hand.powered:
        return "The servo is off: hold Servo in the top bar for 1 s"
    if link.hand is not None and link.hand.pressing_n:
        return "In contact: lift first (jog +Z in Operate)"
    for degraded in link.degraded:
        # What is over sooner would only make the buttons flicker: an order is refused in words.
        if link.clock_s() - degraded.since_s > LASTING_S:
            return f"The {NAMES[degraded.device]} is {degraded.how}: check it first"
    return ""
