"""The simulated wrist sensor as a device."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from backend.core.flow import FloatArray
from backend.core.stream import SampleStream
from backend.devices.arrivals import Arrivals
from backend.devices.sim.connection import Connection, SimDevice

RATED = (200.0, 200.0, 200.0, 4.0, 4.0, 4.0)
"""N and N·m, those of the laboratory's sensor."""


class SimForceTorque(SimDevice):
    """Untared samples, ``usual_hz`` a second, delivered in blocks of one cycle."""

    def __init__(
        self, samples: SampleStream, now_s: Callable[[], float], usual_hz: float = 1000.0
    ) -> None:
        self._samples, self._usual_hz = samples, usual_hz
        self._pace = Arrivals(1.0 / usual_hz)
        super().__init__(Connection("force_torque", "simulated wrist sensor", now_s))

    @property
    def samples(self) -> SampleStream:
        """Fx Fy Fz Tx Ty Tz in N and N·m."""
        return self._samples

    @property
    def rated(self) -> FloatArray:
        """(6,) rated range."""
        return np.array(RATED)

    @property
    def slow_since_s(self) -> float | None:
        """When it began to deliver less than half of its samples; None while it does not."""
        return self._pace.slow_since_s

    def describe(self) -> Mapping[str, str | float]:
        """Return the rated force and torque, and the usual rate."""
        rated = {"rated_n": RATED[0], "rated_nm": RATED[3]}
        return {"kind": "simulated", "usual_hz": self._usual_hz, **rated}

    def deliver(self, t_s: FloatArray, values: FloatArray) -> bool:
        """Put one block into the stream; return whether anything was delivered."""
        if not (self._connection.ready and len(t_s)):
            return False
        self._samples.put(t_s, values)
        self._connection.arrived(float(t_s[-1]), len(t_s))
        self._pace.note(float(t_s[-1]), len(t_s))
        return True
