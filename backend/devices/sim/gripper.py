"""The simulated gripper as a device."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping

import numpy as np

from backend.core.turning import refuse_turned
from backend.devices.motion import CommandedMotion, replaced_fault, stopped_fault
from backend.devices.protocols import GripStatus
from backend.devices.sim.connection import Connection, SimDevice
from backend.simulation.world import World

WIDTH_NOISE_MM = 0.01
FORCE_NOISE_N = 0.05


class SimGripper(SimDevice):
    """Moves the jaws of a ``World``; ``stop`` works from any thread and keeps the grip."""

    def __init__(self, world: World, now_s: Callable[[], float]) -> None:
        self._world = world
        super().__init__(Connection("gripper", "simulated gripper", now_s))
        self._rng = np.random.Generator(
            np.random.PCG64(np.random.SeedSequence([world.scene.seed, 6]))
        )
        self._lock = threading.Lock()
        self._motion: CommandedMotion | None = None
        self._status = GripStatus(world.jaws.width_mm, 0.0, False)

    def close(self) -> None:
        """Close; the jaws stay as they are."""
        self.stop()
        self._connection.close()

    def describe(self) -> Mapping[str, str | float]:
        """Return width and force."""
        status = self._status
        return {"kind": "simulated", "width_mm": status.width_mm, "force_n": status.force_n}

    def status(self) -> GripStatus:
        """Return what was measured in the last cycle."""
        return self._status

    def grip(self, force_n: float) -> CommandedMotion:
        """Close until the piece is held with ``force_n`` per finger; refused on a turned hand."""
        self._connection.require_ready()
        refuse_turned(self._world.drive.turn)
        if not 0.0 < force_n < float("inf"):
            raise ValueError("the grip force must be positive")
        with self._lock:
            self._world.jaws.close(force_n)
            return self._take(CommandedMotion({"force_n": force_n}))

    def open_to(self, width_mm: float, speed_mm_s: float) -> CommandedMotion:
        """Open to ``width_mm``; a held piece is let go."""
        self._connection.require_ready()
        if not (0.0 <= width_mm < float("inf") and 0.0 < speed_mm_s < float("inf")):
            raise ValueError("width and speed must be finite, the speed positive")
        with self._lock:
            self._world.jaws.open_to(width_mm, speed_mm_s)
            return self._take(CommandedMotion({"width_mm": width_mm, "speed_mm_s": speed_mm_s}))

    def stop(self) -> None:
        """Stop where it is; the grip is kept."""
        with self._lock:
            self._world.jaws.halt()
            if self._motion is not None:
                self._motion.end(stopped_fault(self.name))
                self._motion = None

    def deliver(self, t_s: float, *, silent: bool = False) -> None:
        """Measure width and force of one cycle and see whether the motion ended.

        ``silent``: nothing of it is told; the jaws go on.
        """
        jaws = self._world.jaws
        width, force = self._rng.standard_normal(2).tolist()
        if self._connection.ready and not silent:
            force_n = jaws.force_n + FORCE_NOISE_N * force if jaws.force_n > 0.0 else 0.0
            self._status = GripStatus(jaws.width_mm + WIDTH_NOISE_MM * width, force_n, jaws.holding)
            self._connection.arrived(t_s, 1)
        with self._lock:
            if self._motion is not None and not jaws.moving:
                self._motion.end()
                self._motion = None

    def _take(self, motion: CommandedMotion) -> CommandedMotion:
        if self._motion is not None:
            self._motion.end(replaced_fault(self.name))
        self._motion = motion
        return motion
