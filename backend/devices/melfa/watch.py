"""Keeps asking the controller how it is: its state ten times a second, its place while no stream
tells it, and the reason of an error.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from backend.core.faults import Fault, FaultError
from backend.core.flow import FloatArray
from backend.devices.melfa.kinematics import Placing, hand_of
from backend.devices.melfa.link_faults import controller_fault, link_fault
from backend.devices.melfa.r3_client import TIMEOUT_S, Ticket
from backend.wire.framing import WireError
from backend.wire.melfa_r3 import Request
from backend.wire.melfa_r3_answers import Run, State, read_state
from backend.wire.melfa_r3_positions import Reading, read_axes

STATE_S = 0.1
PLACE_S = 0.04
"""Only while no program runs: the controller asks for 100 ms between exchanges then."""
PROBING_STATE_S = 0.35
STATE, PLACE = Request("STATE"), Request("PPOS", "F")

Ask = Callable[[Request, float], Ticket]


class Watch:
    """``step`` once per cycle; it never waits."""

    def __init__(self, ask: Ask, placing: Placing, euler: str) -> None:
        self._ask, self._placing, self._euler = ask, placing, euler
        self._ticket: Ticket | None = None
        self._next_s = -math.inf
        self._state_s = -math.inf
        self.state: State | None = None
        self.place_mm: FloatArray | None = None
        """(3,) where ``G`` is, of the last answer; taken by who reads it."""
        self.fault: Fault | None = None
        """An error of the controller, or a program that ended by itself."""

    @property
    def ended(self) -> bool:
        """Whether the controller has told that no program runs."""
        return self.state is not None and Run.RUNNING not in self.state.run

    def step(self, now_s: float, *, streaming: bool, probing: bool = False) -> None:
        """Read the answer that came, ask the next question when it is time.

        ``probing``: the force program runs, so that questions keep their distance; then most of
        them are for the place.
        """
        if self._ticket is not None:
            if not self._ticket.done:
                return
            self._read(self._ticket, streaming=streaming)
            self._ticket = None
        if now_s < self._next_s:
            return
        due = streaming or now_s - self._state_s >= (PROBING_STATE_S if probing else STATE_S)
        if due:
            self._state_s = now_s
        self._next_s = now_s + (STATE_S if streaming else PLACE_S)
        self._ticket = self._ask(STATE if due else PLACE, TIMEOUT_S)

    def _read(self, ticket: Ticket, *, streaming: bool) -> None:
        try:
            if ticket.request == PLACE:
                self.place_mm = self._of_reading(read_axes(ticket.answer))
                return
            self.state = state = read_state(ticket.answer)
        except FaultError as error:
            self.fault = error.fault
        except WireError as error:
            self.fault = link_fault(f"The controller does not answer as it should: {error}.")
        else:
            if state.error:
                self.fault = controller_fault(state.error)
            elif streaming and Run.RUNNING not in state.run:
                self.fault = ENDED

    def _of_reading(self, reading: Reading) -> FloatArray:
        axes = dict(zip(reading.names, reading.values, strict=True))
        x, y, z, a, b, c = (axes[name] for name in "XYZABC")
        return self._placing.from_flange(np.array([x, y, z]), hand_of(a, b, c, self._euler))


ENDED = Fault(
    "MXT-ENDED",
    "The controller's real-time program has ended by itself.",
    "The arm stands still; the gripper was not opened.",
    "Look at the controller, press Reset, then connect the arm again.",
    "arm",
)
