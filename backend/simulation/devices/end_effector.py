"""The simulated end effector as devices: gripper, finger cameras, and wrist sensor."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping

import numpy as np

from touchdown.backend import core, devices
from touchdown.backend.devices.force_torque import overload_fault, range_text
from touchdown.backend.emulation import DisturbanceScript
from touchdown.backend.simulation.devices.connection import SimDevice
from touchdown.backend.simulation.finger_camera import Exposure
from touchdown.backend.simulation.world import World

WIDTH_NOISE_MM = 0.01
FORCE_NOISE_N = 0.05


class SimGripper(SimDevice):
    """Moves the jaws of a ``World``; ``stop`` works from any thread and keeps the grip."""

    def __init__(self, world: World, now_s: Callable[[], float]) -> None:
        self._world = world
        super().__init__("gripper", "simulated gripper", now_s)
        self._rng = np.random.default_rng([world.scene.seed, world.scene.number, 6])
        self._status = devices.GripStatus(world.jaws.width_mm, 0.0, False)

    def close(self) -> None:
        """Close; the jaws stay as they are."""
        self.stop()
        super().close()

    def describe(self) -> Mapping[str, str | float]:
        """Return width and force."""
        status = self._status
        return {"kind": "simulated", "width_mm": status.width_mm, "force_n": status.force_n}

    def status(self) -> devices.GripStatus:
        """Return the measurement of the last cycle."""
        return self._status

    def grip(self, force_n: float) -> devices.CommandedMotion:
        """Close until the piece is held with ``force_n`` per finger; refused on a rotated hand."""
        self.require_ready()
        core.require_unrotated(self._world.drive.turn)
        if not 0.0 < force_n < float("inf"):
            raise ValueError("the grip force must be positive")
        with self._lock:
            self._world.jaws.close(force_n)
            return self._start_motion(devices.CommandedMotion({"force_n": force_n}))

    def open_to(self, width_mm: float, speed_mm_s: float) -> devices.CommandedMotion:
        """Open to ``width_mm``; a held piece is released."""
        self.require_ready()
        if not (0.0 <= width_mm < float("inf") and 0.0 < speed_mm_s < float("inf")):
            raise ValueError("width and speed must be finite, the speed positive")
        with self._lock:
            self._world.jaws.open_to(width_mm, speed_mm_s)
            return self._start_motion(
                devices.CommandedMotion({"width_mm": width_mm, "speed_mm_s": speed_mm_s})
            )

    def stop(self) -> None:
        """Stop; the grip is kept."""
        with self._lock:
            self._world.jaws.halt()
            self._end_motion(devices.stopped_fault(self.name))

    def deliver(self, t_s: float, cycles: int = 1, *, silent: bool = False) -> None:
        """Measure width and force of the last cycle, and process the end of a motion.

        ``silent``: no status is delivered; the jaws continue.
        """
        jaws = self._world.jaws
        width, force = self._rng.standard_normal((cycles, 2))[-1].tolist()
        if self.ready and not silent:
            force_n = jaws.force_n + FORCE_NOISE_N * force if jaws.force_n > 0.0 else 0.0
            self._status = devices.GripStatus(
                jaws.width_mm + WIDTH_NOISE_MM * width, force_n, jaws.holding
            )
            self.arrived(t_s, cycles)
        with self._lock:
            if not jaws.moving:
                self._end_motion()


FLICKER = 0.25  # amplitude of the brightness, as in the known-truth test of the tracker


class SimTactile(SimDevice):
    """Frames of one finger; gaps in the sequence numbers count as lost frames."""

    def __init__(
        self,
        finger: core.Finger,
        frames: core.Stream[core.TactileFrame],
        now_s: Callable[[], float],
        script: DisturbanceScript,
    ) -> None:
        self.finger, self.frames, self._script = finger, frames, script
        super().__init__(f"tactile_{finger}", "simulated tactile finger", now_s)
        self._thinned = core.Decimator()
        self._newest: int | None = None
        self._frozen: core.ImageArray | None = None

    def connect(self, timeout_s: float, cancel: threading.Event) -> None:
        """Connect immediately."""
        if not self.ready:
            self._newest = None
        super().connect(timeout_s, cancel)

    def describe(self) -> Mapping[str, str | float]:
        """Return the image format."""
        return {"kind": "simulated", "width_px": 320.0, "height_px": 240.0, "gel": "large-dot"}

    def deliver(self, shots: list[Exposure]) -> None:
        """Put the images of one cycle into the stream."""
        if not self.ready:
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
            frame: core.TactileFrame = core.LazyFrame(self.finger, shot.sequence, t_s, shot.develop)
            if self._script.disturbances:
                frame = core.TactileFrame(self.finger, shot.sequence, t_s, self._seen(shot, t_s))
            self.frames.put(t_s, frame)
            self.arrived(t_s, 1, lost)

    def _seen(self, shot: Exposure, t_s: float) -> core.ImageArray:
        image = shot.develop()
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


RATED = (200.0, 200.0, 200.0, 4.0, 4.0, 4.0)  # N and N·m, as the sensor of the laboratory
_RATED = np.array(RATED)


class SimForceTorque(SimDevice):
    """Untared samples Fx Fy Fz Tx Ty Tz in N and N·m, delivered in blocks of one cycle."""

    def __init__(
        self, samples: core.SampleStream, now_s: Callable[[], float], usual_hz: float = 1000.0
    ) -> None:
        self.samples, self._usual_hz = samples, usual_hz  # NaN beyond the rated range
        self.fault: core.Fault | None = None
        self._pace = devices.ArrivalMonitor(1.0 / usual_hz)
        super().__init__("force_torque", "simulated wrist sensor", now_s)

    def connect(self, timeout_s: float, cancel: threading.Event) -> None:
        """Connect immediately; ends a fault."""
        self.fault = None
        super().connect(timeout_s, cancel)

    @property
    def rated(self) -> core.FloatArray:
        """(6,) rated range."""
        return np.array(RATED)

    @property
    def slow_since_s(self) -> float | None:
        """Time since which less than half of the samples arrive, or None."""
        return self._pace.slow_since_s

    def describe(self) -> Mapping[str, str | float]:
        """Return the rated force and torque, and the usual rate."""
        rated = {"rated_n": RATED[0], "rated_nm": RATED[3]}
        return {"kind": "simulated", "usual_hz": self._usual_hz, **rated}

    def deliver(self, t_s: core.FloatArray, values: core.FloatArray) -> bool:
        """Put one block into the stream; return True if samples were delivered."""
        if self.state is devices.DeviceState.CLOSED or not len(t_s):
            return False
        beyond = np.any(np.abs(values) >= _RATED, axis=1)
        if beyond.any():
            self.fault = self.fault or overload_fault(range_text(values[beyond][0], RATED))
            self.state = devices.DeviceState.FAULT
            values = np.where(beyond[:, None], np.nan, values)
        self.samples.put(t_s, values)
        self.arrived(float(t_s[-1]), len(t_s))
        self._pace.note(float(t_s[-1]), len(t_s))
        return True
