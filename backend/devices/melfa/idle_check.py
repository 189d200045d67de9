"""Whether this computer keeps the time of a stream: its cycles are watched before one opens.

The ladder of lost replies would hold the arm anyway; here it is known before anything moves.
"""

from __future__ import annotations

from collections.abc import Callable

from backend.config.hardware import MelfaSettings
from backend.config.lab_places import is_loopback
from backend.core.faults import FaultError
from backend.devices.melfa.ladder import FAULT_CYCLES, HOLD_CYCLES
from backend.devices.melfa.link_faults import starved_fault
from backend.devices.melfa.wires import Wires
from backend.wire.melfa_joints import CYCLE_S

WARN_S, REFUSE_S = HOLD_CYCLES * CYCLE_S, FAULT_CYCLES * CYCLE_S
"""A gap in which the ladder would hold the arm; one in which it would end the stream."""
LOOK_S = 0.1


def notice_of_idle_check(wires: Wires, settings: MelfaSettings, go_on: Callable[[], None]) -> str:
    """Watch for ``settings.idle_check_s``; return what the operator should know, "" for nothing.

    Raises ``FaultError`` RIG-STARVED for a gap that would end the stream of an arm that is not
    emulated on this computer; ``go_on`` raises where connecting is cancelled meanwhile.
    """
    if not settings.idle_check_s:
        return ""
    wires.watch_anew()
    watched_s = 0.0
    while watched_s < settings.idle_check_s:
        go_on()
        wires.pause(LOOK_S)
        watched_s += LOOK_S
    times = wires.times
    gap_s = CYCLE_S + times.latest_s if times.wakes else watched_s
    if gap_s <= WARN_S:
        return ""
    if gap_s > REFUSE_S and not is_loopback(settings.host):
        raise FaultError(starved_fault(gap_s, settings.idle_check_s))
    return (
        f"This computer left the arm without a cycle for {1e3 * gap_s:.0f} ms while it stood: "
        "end what else keeps it busy, or allow real-time priority."
    )
