"""A simulated finger camera as a device."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping

import numpy as np

from backend.core.flow import Finger, ImageArray, TactileFrame
from backend.core.stream import Stream
from backend.devices.sim.connection import Connection, SimDevice
from backend.simulation.disturbances import Script, Thinned
from backend.simulation.finger_camera import Shot

FLICKER = 0.25
"""Swing of the brightness, by the law of the tracker's known-truth test."""


class SimTactile(SimDevice):
    """Frames of one finger; a gap in the numbers of the exposures counts as lost frames."""

    def __init__(
        self,
        finger: Finger,
        frames: Stream[TactileFrame],
        now_s: Callable[[], float],
        script: Script,
    ) -> None:
        self._finger, self._frames, self._script = finger, frames, script
        super().__init__(Connection(f"tactile_{finger}", "simulated tactile finger", now_s))
        self._thinned = Thinned()
        self._newest: int | None = None
        self._frozen: ImageArray | None = None

    @property
    def finger(self) -> Finger:
        """Which finger."""
        return self._finger

    @property
    def frames(self) -> Stream[TactileFrame]:
        """Frames as they arrive."""
        return self._frames

    def connect(self, timeout_s: float, cancel: threading.Event) -> None:
        """Connect at once."""
        if not self._connection.ready:
            self._newest = None
        self._connection.open()

    def describe(self) -> Mapping[str, str | float]:
        """Return the image format."""
        return {"kind": "simulated", "width_px": 320.0, "height_px": 240.0, "gel": "large-dot"}

    def deliver(self, shots: list[Shot]) -> None:
        """Put the pictures of one cycle into the stream."""
        if not self._connection.ready:
            return
        for shot in shots:
            t_s = shot.t_us * 1e-6
            rate_hz = self._script.rate_hz(self.name, t_s)
            if self._script.active(self.name, "stop", t_s):
                continue
            if rate_hz is not None and not self._thinned.takes(t_s, rate_hz):
                continue
            lost = 0 if self._newest is None else shot.sequence - self._newest - 1
            self._newest = shot.sequence
            image = self._seen(shot, t_s)
            self._frames.put(t_s, TactileFrame(self._finger, shot.sequence, t_s, image))
            self._connection.arrived(t_s, 1, lost)

    def _seen(self, shot: Shot, t_s: float) -> ImageArray:
        image = shot.image
        if self._script.active(self.name, "flicker", t_s):
            light = 1.0 + FLICKER * math.sin(1.3 * shot.sequence)
            return np.asarray(np.clip(image * light, 0, 255), dtype=np.uint8)
        if self._script.active(self.name, "dark", t_s):
            return np.asarray(image // 16, dtype=np.uint8)
        if not self._script.active(self.name, "freeze", t_s):
            self._frozen = None
            return image
        if self._frozen is None:
            self._frozen = image
        return self._frozen
