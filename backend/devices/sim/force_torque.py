"""The simulated wrist sensor as a device."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping

import numpy as np

from backend.core.flow import FloatArray
from backend.core.stream import SampleStream
from backend.devices.protocols import DeviceState, Health, Identity
from backend.devices.sim.connection import Connection

RATED = (200.0, 200.0, 200.0, 4.0, 4.0, 4.0)
"""N and N·m, those of the laboratory's sensor."""


class SimForceTorque:
    """Untared samples at 1 kHz, delivered in blocks of one cycle."""

    def __init__(self, samples: SampleStream, now_s: Callable[[], float]) -> None:
        self._samples = samples
        self._connection = Connection("force_torque", "simulated wrist sensor", now_s)

    @property
    def name(self) -> str:
        """Name of the device."""
        return self._connection.name

    @property
    def state(self) -> DeviceState:
        """State of the connection."""
        return self._connection.state

    @property
    def identity(self) -> Identity | None:
        """Known once connected."""
        return self._connection.identity

    @property
    def health(self) -> Health:
        """Rate, age and losses."""
        return self._connection.health

    @property
    def samples(self) -> SampleStream:
        """Fx Fy Fz Tx Ty Tz in N and N·m."""
        return self._samples

    @property
    def rated(self) -> FloatArray:
        """(6,) rated range."""
        return np.array(RATED)

    def connect(self, timeout_s: float, cancel: threading.Event) -> None:
        """Connect at once."""
        self._connection.open()

    def close(self) -> None:
        """Close."""
        self._connection.close()

    def describe(self) -> Mapping[str, str | float]:
        """Return the rated force and torque."""
        return {"kind": "simulated", "rated_n": RATED[0], "rated_nm": RATED[3]}

    def deliver(self, t_s: FloatArray, values: FloatArray) -> bool:
        """Put one block into the stream; return whether it was delivered."""
        if not self._connection.ready:
            return False
        self._samples.put(t_s, values)
        self._connection.arrived(float(t_s[-1]), len(t_s))
        return True
