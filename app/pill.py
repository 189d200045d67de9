"""The pill's word for the state that the backend reports; the window infers nothing."""

from __future__ import annotations

import math

from app.link import Link
from backend.devices.jog_axes import signed_name, turns
from backend.runs.requests import RunState, RunStatus
from widgets.state_pill import Colour, PillState, Shape

_WORDS: dict[RunState, tuple[str, Shape, Colour]] = {
    RunState.IDLE: ("READY", "disc", "green"),
    RunState.PREPARING: ("PREPARING", "play", "green"),
    RunState.RUNNING: ("RUNNING", "play", "green"),
    RunState.PAUSING: ("PAUSING", "bars", "yellow"),
    RunState.PAUSED: ("PAUSED", "bars", "yellow"),
    RunState.CANCELLING: ("CANCELLING", "diamond", "yellow"),
    RunState.FINISHING: ("FINISHING", "diamond", "yellow"),
}


def pill_of(link: Link) -> PillState:
    """Return what the pill shows for this bench now."""
    note = "simulated" if link.simulated else ""
    if not link.devices:
        return PillState("NO DEVICES", "ring", "grey", note)
    if link.interlock.latched:
        if link.interlock.faults:
            return PillState("FAULT", "square", "red", "press Reset")
        return PillState("STOPPED", "square", "blue", "press Reset")
    by_hand = _by_hand(link)
    if by_hand:
        return PillState("JOG", "play", "green", by_hand)
    if link.hand is not None and link.interlock.recovering:
        return PillState("RECOVERY", "diamond", "yellow", "jog away from contact")
    status = link.status()
    if status.state is RunState.IDLE and link.hand is not None and link.hand.pressing_n:
        note = f"{link.hand.pressing_n:.0f} N: lift, jog +Z"
        return PillState("IN CONTACT", "diamond", "yellow", note)
    if status.awaiting is not None:
        return PillState("YOUR TURN", "triangle", "blue", "approve or decline")
    word, shape, colour = _WORDS[status.state]
    return PillState(word, shape, colour, _with(note, status))


def _by_hand(link: Link) -> str:
    """Return what moves by hand, "" if nothing does."""
    if link.hand is None or not link.hand.jog.active:
        return ""
    state = link.hand.jog.state
    if state.order is None:
        return "one step"
    order, speed = state.order, f"{state.speed:.0f} mm/s"
    if turns(order.axis):
        speed = f"{math.degrees(state.speed):.0f}\N{DEGREE SIGN}/s"
    return f"{signed_name(order.axis, order.speed)} {order.frame}, {speed}"


def _with(note: str, status: RunStatus) -> str:
    if status.state is RunState.RUNNING and status.phase:
        return f"{note}, {status.phase}".lstrip(", ")
    return note
