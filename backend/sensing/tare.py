"""Tare: what the wrist sensor reads in air, so that only contact remains (rulings 3).

The raw signal holds the gripper (about 14.7 N), the piece and the sensor's offset. All three vanish
only if the tare is taken with the piece held, still, in air and in the pose of the press.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from backend.core.faults import Fault, FaultError
from backend.core.flow import WRENCH_CHANNELS, FloatArray, read_only

STANDARD_GRAVITY_M_S2 = 9.80665


@dataclass(frozen=True, slots=True)
class TareLimits:
    """When a tare is refused. Forces in N, moments in N·m; set from noise measured in air."""

    noise: tuple[float, float] = (0.3, 0.012)
    """Largest standard deviation (force, moment): 3 sigma of the air noise 0.1 N, 0.004 N·m."""
    motion: tuple[float, float] = (0.15, 0.006)
    """Largest change between the halves of the window: a moving arm or a changing load."""
    load_n: float = 3.0
    """Largest force beyond the payload: more is a contact (reliability S8)."""
    least_samples: int = 10
    """Fewer samples are no mean; 200 ms hold 200 samples at 1 kHz."""
    least_span_s: float = 0.15
    """The samples must span at least this time."""


@dataclass(frozen=True, slots=True)
class Tare:
    """What is subtracted: the calibrated ``payload`` (6,) and the measured ``offset`` (6,)."""

    payload: FloatArray
    offset: FloatArray

    def __post_init__(self) -> None:
        read_only(self.payload)
        read_only(self.offset)

    @classmethod
    def zero(cls) -> Tare:
        """Return the tare that changes nothing."""
        return cls(np.zeros(WRENCH_CHANNELS), np.zeros(WRENCH_CHANNELS))

    @property
    def total(self) -> FloatArray:
        """(6,) payload and offset together, N and N·m."""
        return self.payload + self.offset

    def apply(self, wrench: FloatArray) -> FloatArray:
        """Return ``wrench`` (..., 6) without payload and offset."""
        return np.asarray(wrench - self.total, dtype=np.float64)


def gripper_payload(mass_kg: float, centre_mm: tuple[float, float, float]) -> FloatArray:
    """Return the wrench (6,) of a payload hanging at ``centre_mm`` from the sensor, z up."""
    weight_n = mass_kg * STANDARD_GRAVITY_M_S2
    x_m, y_m = 1e-3 * centre_mm[0], 1e-3 * centre_mm[1]
    return np.array([0.0, 0.0, -weight_n, -y_m * weight_n, x_m * weight_n, 0.0])


def take_tare(
    t_s: FloatArray,
    wrench: FloatArray,
    payload: FloatArray | None = None,
    limits: TareLimits | None = None,
) -> Tare:
    """Average still samples in air: ``t_s`` (n,) and raw ``wrench`` (n, 6).

    ``payload`` (6,) is the calibrated weight of the gripper; without one a contact is noticed by
    its motion and noise only. Raises ``FaultError`` "TARE-REFUSED" naming what is wrong.
    """
    limits = limits or TareLimits()
    base = np.zeros(WRENCH_CHANNELS) if payload is None else np.array(payload, dtype=np.float64)
    refusal = _refusal(t_s, wrench - base, limits, weighed=payload is not None)
    if refusal:
        raise FaultError(
            Fault(
                "TARE-REFUSED",
                f"The force sensor cannot be tared: {refusal}.",
                "No probe was started.",
                "Hold the piece still in air, free of contact, and try again.",
                "force_torque",
            )
        )
    return Tare(base, np.asarray((wrench - base).mean(axis=0), dtype=np.float64))


def _refusal(t_s: FloatArray, wrench: FloatArray, limits: TareLimits, *, weighed: bool) -> str:
    """Return why these samples are no tare, "" if they are one; NaN refuses."""
    if len(t_s) < limits.least_samples or not float(t_s[-1] - t_s[0]) >= limits.least_span_s:
        return f"{len(t_s)} samples are too few or span too short a time"
    if not np.isfinite(wrench).all():
        return "a sample is not a finite number"
    half = len(wrench) // 2
    noise = _largest(wrench.std(axis=0, ddof=1))
    motion = _largest(np.abs(wrench[half:].mean(axis=0) - wrench[:half].mean(axis=0)))
    for kind, measured, allowed in (
        ("noise", noise, limits.noise),
        ("drift", motion, limits.motion),
    ):
        if not (measured[0] <= allowed[0] and measured[1] <= allowed[1]):
            return f"{kind} of {measured[0]:.2f} N, {measured[1]:.3f} N·m in still air"
    load_n = math.hypot(*wrench[:, :3].mean(axis=0))
    if weighed and not load_n <= limits.load_n:
        return f"{load_n:.1f} N beyond the payload: the piece touches something"
    return ""


def _largest(channels: FloatArray) -> tuple[float, float]:
    """Return the largest of the forces and of the moments in ``channels`` (6,)."""
    return float(channels[:3].max()), float(channels[3:].max())
