"""STOP on a connection of its own: whoever asks waits for nothing, whatever the other wires do."""

from __future__ import annotations

import contextlib
import threading
from typing import Protocol


class Stopper(Protocol):
    """``dashboard_client.DashboardClient``, of which this lane alone makes use."""

    def stop(self) -> None:
        """End the script on the controller, which brakes the arm; ``RuntimeError`` if none runs."""

    def disconnect(self) -> None:
        """Close."""


class StopLane:
    """One thread that owns one connection to the dashboard."""

    def __init__(self, stopper: Stopper) -> None:
        self._stopper = stopper
        self._asked, self._settled = threading.Event(), threading.Event()
        self._settled.set()
        self._ends = False
        threading.Thread(target=self._run, name="ur-stop", daemon=True).start()

    def press(self) -> None:
        """Ask for a stop; returns at once."""
        self._settled.clear()
        self._asked.set()

    def settle(self, limit_s: float) -> bool:
        """Wait until every stop that was asked for has been answered; return whether it has."""
        return self._settled.wait(limit_s)

    def close(self) -> None:
        """End the thread and its connection; waits for nothing."""
        self._ends = True
        self._asked.set()

    def _run(self) -> None:
        while True:
            self._asked.wait()
            self._asked.clear()
            if self._ends and self._settled.is_set():
                break
            # No script to end is no failure: the arm stands.
            with contextlib.suppress(RuntimeError):
                self._stopper.stop()
            if not self._asked.is_set():
                self._settled.set()
            if self._ends:
                break
        with contextlib.suppress(RuntimeError):
            self._stopper.disconnect()
