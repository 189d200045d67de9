"""R3 console: programs, alarms, variables."""

from __future__ import annotations

import math
import re
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace

from touchdown.backend.config import MelfaSettings, is_loopback
from touchdown.backend.core import FaultError
from touchdown.backend.devices.framing import WireError
from touchdown.backend.devices.melfa.faults import (
    controller_fault,
    link_fault,
    other_arm_fault,
    starved_fault,
    unlimited_fault,
)
from touchdown.backend.devices.melfa.protocol_mxt import CYCLE_S
from touchdown.backend.devices.melfa.protocol_r3 import (
    Request,
    Run,
    State,
    read_error,
    read_opened,
    read_parameter,
    read_state,
)
from touchdown.backend.devices.melfa.sockets import Wires
from touchdown.backend.devices.melfa.stream import FAULT_CYCLES, HOLD_CYCLES
from touchdown.backend.devices.protocols import Identity, Step
from touchdown.backend.devices.streamed import STOPPED

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


POLL_S = 0.1
ANSWER_S = 1.0
RUN_S = 5.0
CLIENT = "TOUCHDOWN"
"""How this program calls itself to the controller."""
RESETS = (
    "Connecting once more in the same window resets this error; from elsewhere reset it at the "
    "controller."
)


class Console:
    """Speaks to one controller; every refusal is a ``FaultError`` with its number.

    Once it was ``stopped``, or connecting was cancelled, it begins nothing: no motors, no program.
    """

    def __init__(
        self,
        wires: Wires,
        settings: MelfaSettings,
        stopped: threading.Event,
        cancel: threading.Event,
        alarm: int = 0,
    ) -> None:
        """``alarm``: the error for which the connection before was refused, 0 for none."""
        self._wires, self._settings = wires, settings
        self.alarm = alarm
        """The controller's error for which this connection is refused: the next one resets it."""
        self._stopped, self._cancel = stopped, cancel
        self.unlimited = False
        """Whether the controller would wait for packets for ever, and that was allowed."""
        self.notice = ""
        """What the operator should know of this connection; "" for nothing."""

    def again(self, cancel: threading.Event) -> Console:
        """Return the console of the next connection, which knows what was told in this one."""
        return Console(self._wires, self._settings, self._stopped, cancel, self.alarm)

    def ask(self, command: str, argument: str = "", timeout_s: float = ANSWER_S) -> str:
        """Send one request and return its answer."""
        ticket = self._wires.ask(Request(command, argument), timeout_s)
        self._wires.finish(ticket)
        return ticket.answer

    def state(self) -> State:
        """Return the state of the controller."""
        return read_state(self.ask("STATE"))

    # -- start-up ---------------------------------------------------------------------------------

    def start_up(self, reached: Callable[[Step], None]) -> Identity:
        """Go from an open wire to a running real-time program; raises ``FaultError``."""
        try:
            identity = self._identify()
            reached("identify")
            self._reset_alarm()
            self._require_no_error()
            self._require_time_limit()
            self.notice = notice_of_idle_check(self._wires, self._settings, self._go_on)
            self._go_on()
            self.servo_on()
            self._go_on()
            self.run_stream()
            reached("configure")
        except WireError as error:
            fault = link_fault(f"The controller does not answer as it should: {error}.")
            raise FaultError(fault) from error
        return identity

    def examine(self) -> Identity:
        """Return who answers and leave it as it was: nothing is switched on."""
        try:
            identity = self._identify()
            self._require_no_error()
            self._require_time_limit()
            self.ask("CLOSE")
        except WireError as error:
            fault = link_fault(f"The controller does not answer as it should: {error}.")
            raise FaultError(fault) from error
        return identity

    def run_stream(self) -> None:
        """Start the controller's program that opens the stream, and wait until it runs."""
        if Run.RUNNING in self.state().run:
            # Of a connection that broke: it is ended, never taken over.
            self.ask("STOP")
            self._wait_for_end()
        self._go_on()
        self.ask("SLOTINIT")
        self._run(self._settings.mxt.program, "The real-time program does not start.")

    def run_probe(self, values: Mapping[str, float]) -> None:
        """Write the variables of the force program, read them back, and run it."""
        program = self._settings.fsc.program
        if Run.RUNNING in self.state().run:
            self.ask("STOP")
        self._wait_for_end()
        self.ask("SLOTINIT")
        self.ask("PRGLOAD=", program)
        for name, value in values.items():
            self._go_on()
            self.ask("HOT", f"{program};{name}={value:g}")
            told = self.ask("VAL", name)
            if not re.fullmatch(rf"{name}=([-+0-9.Ee]+)", told):
                raise FaultError(link_fault(f"The controller tells '{told}' of {name}."))
            if not math.isclose(float(told.split("=")[1]), value, rel_tol=1e-3, abs_tol=1e-6):
                raise FaultError(link_fault(f"The controller did not take {name} = {value:g}."))
        self._run(program, "The force program does not start.")

    def _run(self, program: str, what: str) -> None:
        """Run a program, unless STOP came; one that was on its way as STOP came is stopped too."""
        self._go_on()
        self._wires.pace(running=True)
        self.ask("RUN", f"{program};1")
        try:
            self._poll(Run.RUNNING, RUN_S, what)
            self._go_on()
        except FaultError:
            self.ask("STOP")
            self._wires.pace(running=False)
            raise

    def _go_on(self) -> None:
        """Raise ``FaultError`` once nothing more may begin."""
        if self._stopped.is_set():
            raise FaultError(STOPPED)
        if self._cancel.is_set():
            raise FaultError(link_fault("Connecting was cancelled."))

    def _identify(self) -> Identity:
        opened = read_opened(self.ask("OPEN=", CLIENT))
        wanted = self._settings.robot_type
        if not opened.robot_type.startswith(wanted):
            raise FaultError(other_arm_fault(opened.robot_type, wanted))
        return Identity("Mitsubishi", opened.robot_type, self._settings.host, opened.version)

    def _reset_alarm(self) -> None:
        """Reset the error for which the last connection was refused, as was told then.

        The controller refuses while an emergency stop is pressed, and its error is told again.
        """
        if self.alarm and read_error(self.ask("ERROR"))[0] == self.alarm:
            self._go_on()
            self.ask("CNTL", "ON")
            with suppress(FaultError):
                self.ask("RSTALRM")

    def _require_no_error(self) -> None:
        found, _ = read_error(self.ask("ERROR"))
        self.alarm = found
        if found:
            fault = controller_fault(found, self.ask("ERRORMES", str(found)))
            raise FaultError(replace(fault, next_step=f"{fault.next_step} {RESETS}"))

    def _require_time_limit(self) -> None:
        try:
            _, value, _ = read_parameter(self.ask("PAR", "MXTTOUT"))
        except FaultError:
            value = "-1"
        self.unlimited = not value.isdecimal()
        if self.unlimited and not self._settings.mxt.allow_unlimited:
            raise FaultError(unlimited_fault())

    def servo_on(self) -> None:
        """Switch the motors on and wait until they are; raises ``FaultError``."""
        self.ask("CNTL", "ON")
        self.ask("OVRD=", str(self._settings.override_start))
        self._go_on()
        self.ask("SRV", "ON")
        self._poll(Run.SERVO_ON, self._settings.servo_timeout_s, "The servo does not come on.")

    def _poll(self, bit: Run, limit_s: float, what: str) -> None:
        waited_s = 0.0
        while bit not in self.state().run:
            self._go_on()
            if waited_s >= limit_s:
                raise FaultError(link_fault(what))
            self._wires.pause(POLL_S)
            waited_s += POLL_S

    # -- shutdown ---------------------------------------------------------------------------------

    def shut_down(self) -> None:
        """Switch off, give the right back; the stream has ended."""
        self.servo_off()
        self.ask("CNTL", "OFF")
        self.ask("CLOSE")

    def servo_off(self) -> None:
        """Stop, wait until nothing runs, switch the motors off; the stream has ended."""
        self.ask("STOP")
        self._wait_for_end()
        self.ask("SRV", "OFF")

    def _wait_for_end(self) -> None:
        waited_s = 0.0
        while Run.RUNNING in self.state().run and waited_s < RUN_S:
            self._wires.pause(POLL_S)
            waited_s += POLL_S
        self._wires.pace(running=False)
