"""Core of the real-time process."""

from __future__ import annotations

import math
from dataclasses import dataclass

from touchdown.backend.core import Fault, RefusedError
from touchdown.backend.devices import LEASE_S, Limits

BACKEND_SILENT_S = 0.25
"""The backend beats at least every 50 ms."""
LAPSED_S = 2.0 - LEASE_S
"""A run whose thread is late by this much beyond its lease has lost its motion: disks take time."""
WRENCH_SILENT_S = 0.3
"""A wrist sensor that is silent for longer forbids new motion."""


@dataclass(frozen=True, slots=True)
class Inbox:
    """What the round found: words of the shared memory, and how the devices are.

    ``moving``: whether a motion of the arm is under way; ``gone``: the backend is no more;
    ``wrench_s``: time of the newest finite wrench (-inf before the first).
    """

    beats: int
    stops: int
    lease_until_s: float
    moving: bool = False
    gone: bool = False
    wrench_s: float = -math.inf


@dataclass(frozen=True, slots=True)
class Outbox:
    """What is to be done now, the strongest first; ``fault`` is told, ``leave`` ends the process.

    ``why``: what a motion that ends by this is reported with, None for an ordinary stop.
    """

    stop: bool = False
    hold: bool = False
    leave: bool = False
    fault: Fault | None = None
    why: Fault | None = None


class RigCore:
    """Latches and watchdogs of one rig; not thread-safe: its owner locks."""

    def __init__(self, now_s: float, limits: Limits) -> None:
        self.limits = limits
        self._beats, self._beat_s = -1, now_s
        self._silent = False
        self._lease_until_s = -math.inf
        self._wrench_s = -math.inf
        self._stops = self._stops_reset = 0
        self._faults: list[Fault] = []
        self._faults_reset = 0

    @property
    def latched(self) -> bool:
        """Whether a STOP or a fault waits for the operator's reset."""
        return self._stops > self._stops_reset or len(self._faults) > self._faults_reset

    @property
    def stops(self) -> int:
        """How many STOPs this rig has taken."""
        return self._stops

    @property
    def faults(self) -> int:
        """How many faults this rig has raised; the newest carries this number."""
        return len(self._faults)

    # -- one round --------------------------------------------------------------------------------

    def step(self, now_s: float, inbox: Inbox) -> Outbox:
        """Take what came, return what is to be done."""
        if inbox.beats != self._beats:
            self._beats, self._beat_s, self._silent = inbox.beats, now_s, False
        self._lease_until_s = inbox.lease_until_s
        self._wrench_s = max(self._wrench_s, inbox.wrench_s)
        if inbox.gone:
            return Outbox(stop=True, leave=True)
        if inbox.stops > self._stops:
            self._stops = inbox.stops
            return Outbox(stop=True)
        if not now_s - self._beat_s <= BACKEND_SILENT_S:
            return self._fall_silent(now_s - self._beat_s, moving=inbox.moving)
        if inbox.moving and not now_s <= inbox.lease_until_s + LAPSED_S:
            return Outbox(hold=True, why=LAPSED)
        return Outbox()

    def _fall_silent(self, silent_s: float, *, moving: bool) -> Outbox:
        known, self._silent = self._silent, True
        if known or not moving:
            return Outbox(hold=moving)
        fault = silent_fault(silent_s)
        return Outbox(hold=True, fault=self.latch(fault), why=fault)

    # -- what is told by message ------------------------------------------------------------------

    def latch(self, fault: Fault) -> Fault:
        """Keep a fault until it is reset."""
        self._faults.append(fault)
        return fault

    def stop(self, stops: int) -> bool:
        """Latch STOP number ``stops``; return whether it is news."""
        news = stops > self._stops
        self._stops = max(self._stops, stops)
        return news

    def reset(self, stops: int, faults: int) -> None:
        """Clear what the operator has seen: STOPs and faults up to these numbers."""
        self._stops_reset = max(self._stops_reset, min(stops, self._stops))
        self._faults_reset = max(self._faults_reset, min(faults, len(self._faults)))

    def refuse(self, now_s: float, lease_until_s: float) -> None:
        """Raise ``RefusedError`` unless motion may start now; the order carries its lease."""
        if self._stops > self._stops_reset:
            raise RefusedError("STOPPED", "The rig process was stopped: press Reset first.")
        if len(self._faults) > self._faults_reset:
            raise RefusedError("FAULT", f"{self._faults[-1].what} Press Reset first.")
        if self._silent:
            raise RefusedError("BACKEND-SILENT", "The program that gave this order is silent.")
        if not now_s <= max(lease_until_s, self._lease_until_s):
            raise RefusedError("NO-LEASE", "Nobody holds a live motion lease.")

    def refuse_unfelt(self, now_s: float) -> None:
        """Raise ``RefusedError`` while the wrist is silent: the arm moves on what it feels."""
        age_s = now_s - self._wrench_s
        if not age_s <= WRENCH_SILENT_S:
            raise RefusedError("FT-STALE", "The wrist sensor is silent: nothing moves without it.")


def silent_fault(silent_s: float) -> Fault:
    """Return the fault of a backend that stopped beating while the arm moved."""
    return Fault(
        "BACKEND-SILENT",
        f"The program stood still for {1e3 * silent_s:.0f} ms while the arm moved.",
        "The arm was held; the gripper was not opened.",
        "Look at the load of this computer, then press Reset.",
        "arm",
    )


LAPSED = Fault(
    "LEASE-LAPSED",
    "The permission to move was not renewed in time.",
    "The arm was held; the gripper was not opened.",
    "Give the order again.",
    "arm",
)
