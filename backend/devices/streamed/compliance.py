"""Software compliance of a streamed arm in contact.

Per axis M a + D v + K d = f with implicit damping and explicit spring; ``d`` is added to the
reference. Forces are those of the environment on the tool, tared in air, in bench axes; all arrays
are (3,), N and mm. Stability depends on the damping and the loop delay, not on K: see ``damping``.
An unstable contact is detected as an oscillation of the force at a frequency set by the loop delay.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from touchdown.backend.core import FloatArray

DESIGN_N_MM = 30.0  # stiffness of the environment for which the damping is designed
STIFF_N_MM = 100.0  # the same for a stiffer contact, at half the speed
MASS_S = 0.020  # m / D
FILTER_HZ = 50.0
SPEED_MM_S = 20.0
ACCELERATION_MM_S2 = 500.0
GIVE_MM = 3.0


@dataclass(frozen=True, slots=True)
class LoopDelays:
    """Delays of the control loop: ``cycle_s``, lags of arm and sensor, whole dead cycles."""

    cycle_s: float
    arm_lag_s: float = 0.010
    sensor_lag_s: float = 0.0
    dead_cycles: int = 2
    filter_hz: float = FILTER_HZ

    @property
    def delay_s(self) -> float:
        """Delay of the whole loop."""
        link_s = (self.dead_cycles + 1) * self.cycle_s
        filter_s = 1.0 / (2.0 * math.pi * self.filter_hz)
        return link_s + self.arm_lag_s + self.sensor_lag_s + filter_s


def damping(delay_s: float, stiffest_n_mm: float) -> float:
    """Return D in N·s/mm for a gain margin of 3.1 at ``stiffest_n_mm``, for any K."""
    return 2.0 * stiffest_n_mm * delay_s


@dataclass(frozen=True, slots=True)
class AdmittanceLaw:
    """Constants of an admittance law. ``stiffness_n_mm`` (x, y, z); D in N·s/mm; M in N·s²/mm."""

    cycle_s: float
    stiffness_n_mm: tuple[float, float, float]
    damping: float
    mass: float
    filter_hz: float = FILTER_HZ
    speed_mm_s: float = SPEED_MM_S
    acceleration_mm_s2: float = ACCELERATION_MM_S2
    give_mm: float = GIVE_MM

    def doubled(self) -> AdmittanceLaw:
        """Return the law with twice the damping and mass, to end an oscillation."""
        return replace(self, damping=2.0 * self.damping, mass=2.0 * self.mass)


def admittance_law(
    loop: LoopDelays, stiffness_n_mm: tuple[float, float, float], stiffest_n_mm: float = DESIGN_N_MM
) -> AdmittanceLaw:
    """Return the law for a loop; raises ``ValueError`` if the spring would oscillate by itself."""
    if not all(math.isfinite(k) and k > 0.0 for k in (*stiffness_n_mm, stiffest_n_mm)):
        raise ValueError("stiffness must be finite and positive")
    d = damping(loop.delay_s, stiffest_n_mm)
    if not d > max(stiffness_n_mm) * loop.cycle_s:
        raise ValueError("the damping is too small for this cycle")
    return AdmittanceLaw(loop.cycle_s, stiffness_n_mm, d, MASS_S * d, loop.filter_hz)


@dataclass(frozen=True, slots=True)
class Deflection:
    """Compliant deflection: ``d_mm``, its speed, and the filtered force ``g_n``."""

    d_mm: FloatArray
    v_mm_s: FloatArray
    g_n: FloatArray


AT_REST = Deflection(np.zeros(3), np.zeros(3), np.zeros(3))


def deflect(law: AdmittanceLaw, give: Deflection, force_n: FloatArray) -> Deflection:
    """Return the next state for ``force_n`` (3,); unchanged without a finite force."""
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
    # Use the clipped displacement: the speed must not wind up behind the limit.
    v = np.where(d == free, v, (d - give.d_mm) / t)
    return Deflection(d, v, g)


def fastest_approach_mm_s(
    law: AdmittanceLaw, loop: LoopDelays, peak_n: float, press_mm: float
) -> float:
    """Return the highest approach speed with a force peak below ``peak_n`` at design stiffness."""
    k, contact = law.stiffness_n_mm[2], law.damping / (2.0 * loop.delay_s)
    steady_n = press_mm * k * contact / (k + contact)
    return (peak_n - steady_n) / (law.damping + contact * loop.delay_s)


TURNS = 4
APART_N = 1.0
WINDOW_DELAYS = 10.0


class OscillationDetector:
    """Detects oscillation by turning points of the force, ``APART_N`` apart, in ten loop delays."""

    def __init__(self, delay_s: float) -> None:
        self._window_s = WINDOW_DELAYS * delay_s
        self._turns: deque[float] = deque(maxlen=TURNS)
        self.forget()

    def forget(self) -> None:
        """Reset the detector."""
        self._turns.clear()
        self._rising: bool | None = None
        self._low_n, self._high_n = math.inf, -math.inf

    def feed(self, t_s: float, force_n: float) -> bool:
        """Add the force at ``t_s``; return True if it oscillates."""
        self._low_n, self._high_n = min(self._low_n, force_n), max(self._high_n, force_n)
        fallen = self._high_n - force_n > APART_N
        risen = force_n - self._low_n > APART_N
        if fallen and self._rising is not False:
            self._turn(t_s, force_n, rising=False)
        elif risen and self._rising is not True:
            self._turn(t_s, force_n, rising=True)
        elif self._rising is True:
            self._low_n = force_n
        elif self._rising is False:
            self._high_n = force_n
        return len(self._turns) == TURNS and t_s - self._turns[0] <= self._window_s

    def _turn(self, t_s: float, force_n: float, *, rising: bool) -> None:
        if self._rising is not None:
            self._turns.append(t_s)
        self._rising, self._low_n, self._high_n = rising, force_n, force_n


# Above the first the reference moves at half speed, above the second it stands.
SOFT_N, PRESS_N = 15.0, 25.0
TRIP_N, TRIP_AT_ONCE_N = 40.0, 60.0
OLD_S = 0.1  # maximum age of a wrench; without one the arm stands still


class TripDetector:
    """Detects a force above the trip limit on two samples in a row, or far above it on one."""

    def __init__(self) -> None:
        self._over = False

    def feed(self, force_n: FloatArray) -> bool:
        """Add tared samples (n, 3); return True above the limit."""
        size = np.linalg.norm(force_n, axis=1)
        over = np.concatenate([[self._over], size > TRIP_N])
        self._over = bool(over[-1])
        return bool((over[:-1] & over[1:]).any() or (size > TRIP_AT_ONCE_N).any())


class Compliance:
    """Computes the command from reference and force; forces in N relative to ``air_n``. ``moved_n``
    (3,) is the drift of this zero until contact; the arm does not comply with it. Reported forces
    are relative to ``air_n``, like the tare of the run.
    """

    def __init__(
        self,
        law: AdmittanceLaw,
        loop: LoopDelays,
        reference_mm: FloatArray,
        air_n: FloatArray,
        moved_n: FloatArray | None = None,
    ) -> None:
        self._loop = loop
        self.law = law  # may be replaced in contact: the deflection stays
        self._give = AT_REST
        self._swing = OscillationDetector(loop.delay_s)
        self._air_n = air_n.copy()
        self._moved_n = np.zeros(3) if moved_n is None else moved_n.copy()
        self._felt_n, self._felt_s = np.full(3, math.nan), -math.inf
        self._trip = TripDetector()
        self._calmed_s = math.inf
        self.reference_mm = reference_mm.copy()
        self.tripped = False

    @property
    def press_n(self) -> float:
        """Press force, N, filtered by the law."""
        return float(self._give.g_n[2])

    @property
    def felt_n(self) -> FloatArray:
        """Newest force on the tool, (3,) N; NaN when too old."""
        return self._felt_n

    def silent_s(self, now_s: float) -> float:
        """Return the age of the newest finite sample."""
        return now_s - self._felt_s

    @property
    def speed_share(self) -> float:
        """Permitted share of the reference speed at this force."""
        force_n = float(np.linalg.norm(self._give.g_n))
        if not force_n <= PRESS_N:
            return 0.0
        return 1.0 if force_n <= SOFT_N else 0.5

    @property
    def swinging(self) -> bool:
        """True after an oscillation was detected and the law was changed."""
        return math.isfinite(self._calmed_s)

    def feel(self, now_s: float, t_s: FloatArray, force_n: FloatArray) -> None:
        """Add samples (n,), (n, 3); the mean of the finite ones is the force of this cycle."""
        finite = np.isfinite(force_n).all(axis=1)
        if finite.any():
            values = force_n[finite] - self._air_n
            self._felt_n, self._felt_s = values.mean(axis=0), float(t_s[finite][-1])
            self.tripped |= self._trip.feed(values)
        elif not now_s - self._felt_s <= OLD_S:
            self._felt_n = np.full(3, math.nan)

    def command_mm(self, now_s: float) -> FloatArray:
        """Return the next command (3,)."""
        self._give = deflect(self.law, self._give, self._felt_n - self._moved_n)
        if np.isfinite(self._felt_n).all():
            self._watch_swing(now_s)
        return np.asarray(self.reference_mm + self._give.d_mm)

    def cut(self, command_mm: FloatArray) -> None:
        """Continue from a command that the lead limit reduced."""
        d_mm = command_mm - self.reference_mm
        self._give = replace(self._give, d_mm=d_mm, v_mm_s=np.zeros(3))

    def rebase(self, command_mm: FloatArray) -> None:
        """Continue from a command that was changed elsewhere."""
        self.reference_mm = command_mm - self._give.d_mm

    def still_swinging(self, now_s: float) -> bool:
        """Return True if the force still oscillates ten delays after the change."""
        waited_s = now_s - self._calmed_s
        return waited_s >= 10.0 * self._loop.delay_s and self._swing.feed(now_s, self.press_n)

    def _watch_swing(self, now_s: float) -> None:
        if self._swing.feed(now_s, float(self._felt_n[2])) and not self.swinging:
            self.law = self.law.doubled()
            self._calmed_s = now_s
            self._swing.forget()
