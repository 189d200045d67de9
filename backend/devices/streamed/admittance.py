"""Compliance in software: how far the arm gives way to the force at its wrist.

Per axis M a + D v + K d = f with implicit damping and explicit spring; ``d`` is added to the
reference. Forces are those of the environment on the tool, in air zero, along the axes of the
bench; all arrays (3,), N and mm. Stability is a matter of damping against delay, not of K: see
``damping``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from backend.core.flow import FloatArray

DESIGN_N_MM = 30.0
"""Stiffness of the environment that the damping is made for."""
STIFF_N_MM = 100.0
"""The same for a stiffer contact, at half the speed."""
MASS_S = 0.020
"""M / D."""
FILTER_HZ = 50.0
SPEED_MM_S = 20.0
ACCELERATION_MM_S2 = 500.0
GIVE_MM = 3.0


@dataclass(frozen=True, slots=True)
class Loop:
    """The delays around the loop: ``cycle_s``, whole dead cycles, lags of arm and sensor."""

    cycle_s: float
    dead_cycles: int = 2
    arm_lag_s: float = 0.010
    sensor_lag_s: float = 0.0
    filter_hz: float = FILTER_HZ

    @property
    def delay_s(self) -> float:
        """Delay of the whole loop."""
        link_s = (self.dead_cycles + 1) * self.cycle_s
        filter_s = 1.0 / (2.0 * math.pi * self.filter_hz)
        return link_s + self.arm_lag_s + self.sensor_lag_s + filter_s


def damping(delay_s: float, stiffest_n_mm: float) -> float:
    """Return D in N·s/mm: gain margin 3.1 at ``stiffest_n_mm``, whatever K."""
    return 2.0 * stiffest_n_mm * delay_s


@dataclass(frozen=True, slots=True)
class Law:
    """Constants of one law. ``stiffness_n_mm`` (x, y, z); D in N·s/mm; M in N·s²/mm."""

    cycle_s: float
    stiffness_n_mm: tuple[float, float, float]
    damping: float
    mass: float
    filter_hz: float = FILTER_HZ
    speed_mm_s: float = SPEED_MM_S
    acceleration_mm_s2: float = ACCELERATION_MM_S2
    give_mm: float = GIVE_MM

    def doubled(self) -> Law:
        """Return the law with twice the damping and mass: what calms a swing."""
        return replace(self, damping=2.0 * self.damping, mass=2.0 * self.mass)


def law_for(
    loop: Loop, stiffness_n_mm: tuple[float, float, float], stiffest_n_mm: float = DESIGN_N_MM
) -> Law:
    """Return the law for a loop; raises ValueError if the spring would ring by itself."""
    if not all(math.isfinite(k) and k > 0.0 for k in (*stiffness_n_mm, stiffest_n_mm)):
        raise ValueError("stiffness must be finite and positive")
    d = damping(loop.delay_s, stiffest_n_mm)
    if not d > max(stiffness_n_mm) * loop.cycle_s:
        raise ValueError("the damping is too small for this cycle")
    return Law(loop.cycle_s, stiffness_n_mm, d, MASS_S * d, loop.filter_hz)


@dataclass(frozen=True, slots=True)
class Give:
    """How far the arm has given way: ``d_mm``, its speed, and the filtered force ``g_n``."""

    d_mm: FloatArray
    v_mm_s: FloatArray
    g_n: FloatArray


AT_REST = Give(np.zeros(3), np.zeros(3), np.zeros(3))


def give_way(law: Law, give: Give, force_n: FloatArray) -> Give:
    """Return the next state for ``force_n`` (3,); without a finite force it stands still."""
    if not np.isfinite(force_n).all():
        return replace(give, v_mm_s=np.zeros(3))
    t = law.cycle_s
    old = math.exp(-2.0 * math.pi * law.filter_hz * t)
    g = old * give.g_n + (1.0 - old) * force_n
    spring = np.asarray(law.stiffness_n_mm) * give.d_mm
    v = (give.v_mm_s + t / law.mass * (g - spring)) / (1.0 + t * law.damping / law.mass)
    change = law.acceleration_mm_s2 * t
    v = np.clip(v, give.v_mm_s - change, give.v_mm_s + change)
    v = np.clip(v, -law.speed_mm_s, law.speed_mm_s)
    free = give.d_mm + t * v
    d = np.clip(free, -law.give_mm, law.give_mm)
    # A clipped way is the way that was gone: the speed must not wind up behind the limit.
    v = np.where(d == free, v, (d - give.d_mm) / t)
    return Give(d, v, g)


def cut_back(give: Give, reference_mm: FloatArray, command_mm: FloatArray) -> Give:
    """Return the state after the command was cut to ``command_mm`` by the lead limit."""
    return replace(give, d_mm=command_mm - reference_mm, v_mm_s=np.zeros(3))


def fastest_approach_mm_s(law: Law, loop: Loop, peak_n: float, press_mm: float) -> float:
    """Return the highest approach speed whose peak stays under ``peak_n`` at design stiffness."""
    k, contact = law.stiffness_n_mm[2], law.damping / (2.0 * loop.delay_s)
    steady_n = press_mm * k * contact / (k + contact)
    return (peak_n - steady_n) / (law.damping + contact * loop.delay_s)
