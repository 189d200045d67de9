"""The pill's word for the state that the backend reports; the window infers nothing."""

from __future__ import annotations

import math

from app.connect.banner import words_of
from app.link import Link
from backend.devices.degraded import Degraded
from backend.devices.jog_axes import signed_name, turns
from backend.rig.connection import Connection
from backend.runs.requests import RunState, RunStatus
from widgets.state_pill import Colour, PillState, Shape
from widgets.top_bar import CHIPS

_WORDS: dict[RunState, tuple[str, Shape, Colour]] = {
    RunState.IDLE: ("READY", "disc", "green"),
    RunState.PREPARING: ("PREPARING", "play", "green"),
    RunState.RUNNING: ("RUNNING", "play", "green"),
    RunState.PAUSING: ("PAUSING", "bars", "yellow"),
    RunState.PAUSED: ("PAUSED", "bars", "yellow"),
    RunState.CANCELLING: ("CANCELLING", "diamond", "yellow"),
    RunState.FINISHING: ("FINISHING", "diamond", "yellow"),
}
STILL_S = 1.0
"""A bench that has made no step for so long stands still, whatever else is known of it; setting a
scene takes longer."""
SHOWS_DEGRADED = (RunState.IDLE, RunState.PREPARING, RunState.RUNNING)
"""A run that pauses or ends says so; by then its card names the sensor."""


def pill_of(link: Link) -> PillState:
    """Return what the pill shows for this bench now."""
    note = words_of(link).note
    if not link.devices:
        return PillState("NO DEVICES", "ring", "grey", note)
    if link.still_s >= STILL_S and link.status().state is not RunState.PREPARING:
        return PillState("STILL", "bang", "yellow", f"no step for {link.still_s:.0f} s")
    if link.interlock.latched:
        if link.interlock.faults:
            return PillState("FAULT", "square", "red", "press Reset")
        return PillState("STOPPED", "square", "blue", "press Reset")
    if link.connection is not None and (standing := _standing(link.connection)):
        return standing
    if link.hand is not None and not link.hand.powered:
        return PillState("NOT READY", "triangle", "blue", "switch the servo on")
    by_hand = _by_hand(link)
    if by_hand:
        return PillState("JOG", "play", "green", by_hand)
    if link.hand is not None and link.interlock.recovering:
        return PillState("RECOVERY", "diamond", "yellow", "jog away from contact")
    status = link.status()
    asks = status.asks if status.state is RunState.RUNNING else ""
    if status.awaiting is not None or asks:
        return PillState("YOUR TURN", "triangle", "blue", asks or "approve or decline")
    return _sensed(link, status) or _of_run(note, status)


def _sensed(link: Link, status: RunStatus) -> PillState | None:
    """Return what the sensors say of the bench, None if there is nothing to say."""
    degraded = link.degraded
    if status.state in SHOWS_DEGRADED and degraded:
        return PillState("DEGRADED", "bang", "yellow", _which(degraded, link.clock_s()))
    if status.state is RunState.IDLE and link.hand is not None and link.hand.pressing_n:
        note = f"{link.hand.pressing_n:.0f} N: lift, jog +Z"
        return PillState("IN CONTACT", "diamond", "yellow", note)
    return None


def _of_run(note: str, status: RunStatus) -> PillState:
    word, shape, colour = _WORDS[status.state]
    return PillState(word, shape, colour, _with(note, status))


def _which(degraded: tuple[Degraded, ...], now_s: float) -> str:
    """Return which sensor is late or slow, and for how long."""
    first, *others = degraded
    for_s, more = now_s - first.since_s, f" +{len(others)}" if others else ""
    lasted = f"{for_s:.1f} s" if for_s < 1.0 else f"{for_s:.0f} s"
    return f"{dict(CHIPS)[first.device]} {first.how} {lasted}{more}"


def _standing(connection: Connection) -> PillState | None:
    """Return how far the devices of a lab are connected, None if all are."""
    missing, count = connection.missing(), len(connection.devices)
    if connection.busy:
        return PillState("CONNECTING", "ring", "blue", f"{count - len(missing)} of {count}")
    if len(missing) == count:
        return PillState("NO DEVICES", "ring", "grey", "connect: Ctrl+L")
    if missing:
        return PillState("NOT READY", "triangle", "blue", f"{len(missing)} not connected")
    return None


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
