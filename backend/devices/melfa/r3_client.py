"""Client of the R3 protocol."""

from __future__ import annotations

import math
import threading
from collections import deque

from touchdown.backend.core import Fault, FaultError
from touchdown.backend.devices.melfa.faults import controller_fault, link_fault
from touchdown.backend.devices.melfa.protocol_r3 import Reply, Request, encode_request, replies

PACE_S = 0.1
"""Between two exchanges while a program of the controller runs."""
TIMEOUT_S, DOWN_S = 1.0, 3.0


class Ticket:
    """One request on its way; ``wait`` on it, then ask for the ``answer``."""

    def __init__(self, request: Request, timeout_s: float) -> None:
        self.request, self.timeout_s = request, timeout_s
        self.until_s = math.inf
        self._ended = threading.Event()
        self._reply: Reply | None = None
        self._fault: Fault | None = None

    @property
    def done(self) -> bool:
        """Whether it was answered or given up."""
        return self._ended.is_set()

    def wait(self, timeout_s: float) -> bool:
        """Wait until it ends; return whether it did."""
        return self._ended.wait(timeout_s)

    def end(self, reply: Reply | None, fault: Fault | None = None) -> None:
        """End with a reply, or with the reason why there is none."""
        self._reply, self._fault = reply, fault
        self._ended.set()

    @property
    def reply(self) -> Reply:
        """The reply; raises ``FaultError`` if there is none."""
        if self._fault is not None or self._reply is None:
            raise FaultError(self._fault or link_fault("The controller did not answer."))
        return self._reply

    @property
    def answer(self) -> str:
        """What follows QoK; raises ``FaultError`` if the request was refused or not answered."""
        reply = self.reply
        if not reply.ok:
            raise FaultError(controller_fault(reply.error))
        return reply.answer


class R3Client:
    """``ask`` from any thread; ``step`` from the owner of the wire."""

    def __init__(self, reply_gap_s: float) -> None:
        self._gap_s = reply_gap_s
        self._decoder = replies()
        self._waiting: deque[Ticket] = deque()
        self._lock = threading.Lock()
        self._current: Ticket | None = None
        self._owed = 0
        self._over: Fault | None = None
        self._ready_s = -math.inf
        self._byte_s = -math.inf
        self._silent_since_s = math.inf
        self.paced = False
        """True while a program runs: exchanges keep their distance."""

    @property
    def bad_replies(self) -> int:
        """Replies that could not be read."""
        return self._decoder.bad_frames

    def ask(self, request: Request, timeout_s: float = TIMEOUT_S) -> Ticket:
        """Put a request in line; STOP goes before all that is not yet sent."""
        ticket = Ticket(request, timeout_s)
        with self._lock:
            if self._over is not None:
                ticket.end(None, self._over)
            elif request.command == "STOP":
                self._waiting.appendleft(ticket)
            else:
                self._waiting.append(ticket)
        return ticket

    def step(self, now_s: float, data: bytes) -> bytes:
        """Take what came; return what goes out. Raises ``FaultError`` when the link is down."""
        for reply in self._receive(now_s, data):
            self._take(now_s, reply)
        current = self._current
        if current is not None and now_s >= current.until_s:
            self._current, self._owed = None, self._owed + 1
            name = current.request.command.rstrip("=")
            current.end(None, link_fault(f"The controller did not answer to {name}."))
        if now_s - self._silent_since_s >= DOWN_S:
            fault = link_fault(f"The controller has been silent for {DOWN_S:.0f} s.")
            self.end(fault)
            raise FaultError(fault)
        return self._send(now_s)

    def end(self, fault: Fault) -> None:
        """Give up everything, also what is yet to be asked: the wire is gone."""
        with self._lock:
            self._over = fault
            left = [*([self._current] if self._current else []), *self._waiting]
            self._current = None
            self._waiting.clear()
        for ticket in left:
            ticket.end(None, fault)

    def _receive(self, now_s: float, data: bytes) -> list[Reply]:
        if data:
            self._byte_s = now_s
            return self._decoder.feed(data)
        if self._decoder.pending and now_s - self._byte_s >= self._gap_s:
            return self._decoder.flush()
        return []

    def _take(self, now_s: float, reply: Reply) -> None:
        self._silent_since_s = math.inf
        if self._owed:
            self._owed -= 1
        elif self._current is not None:
            ticket, self._current = self._current, None
            ticket.end(reply)
        self._ready_s = now_s + (PACE_S if self.paced else 0.0)

    def _send(self, now_s: float) -> bytes:
        with self._lock:
            if self._current is not None or self._owed or not self._waiting:
                return b""
            urgent = self._waiting[0].request.command == "STOP"
            if now_s < self._ready_s and not urgent:
                return b""
            ticket = self._waiting.popleft()
            self._current = ticket
        ticket.until_s = now_s + ticket.timeout_s
        self._silent_since_s = min(self._silent_since_s, now_s)
        return encode_request(ticket.request) + b"\r"
