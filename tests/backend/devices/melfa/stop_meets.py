"""Pressing STOP right after one request of an order was answered."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tests.backend.devices.melfa.emulated_arm import Rig
from touchdown.backend.core.faults import FaultError
from touchdown.backend.devices.melfa.command_channel import PendingRequest
from touchdown.backend.devices.melfa.r3_protocol import R3Request


def interrupted(rig: Rig, order: Callable[[], object], wanted: str | int) -> str | None:
    """Give an order and press STOP as ``wanted`` was answered; the code of its fault, "" if none.

    ``wanted``: a request by its text, or by its number; None if the order asks no such request.
    """
    wires = rig.wires
    ask, finish = wires.ask, wires.finish
    tickets: list[tuple[PendingRequest, str]] = []
    pressed = False

    def asked(request: R3Request, timeout_s: float) -> PendingRequest:
        ticket = ask(request, timeout_s)
        tickets.append((ticket, f"{request.command} {request.argument}".strip()))
        return ticket

    def finished(ticket: PendingRequest) -> None:
        nonlocal pressed
        finish(ticket)
        number = next(k for k, (one, _) in enumerate(tickets) if one is ticket)
        if not pressed and wanted in (number, tickets[number][1]):
            pressed = True
            rig.arm.stop()

    wires.ask, wires.finish = asked, finished
    code = ""
    try:
        order()
    except FaultError as error:
        code = error.fault.code
    finally:
        wires.ask, wires.finish = ask, finish
    return code if pressed else None


def still(rig: Rig, for_s: float = 0.2) -> bool:
    """True if the arm stands, after it has had time to brake."""
    rig.rest(0.2)
    before = rig.true_mm
    rig.rest(for_s)
    return bool(np.abs(rig.true_mm - before).max() < 0.01)
