"""The law of compliance: stable on its whole grid, peaks, bounds, energy, and no wind-up.

Stiffness limits and peak forces are held to the published figures of the same law.
"""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from tests.backend.devices.streamed.contact_loop import largest_stable, press, slowest_root
from touchdown.backend.devices.streamed.compliance import (
    ACCELERATION_MM_S2,
    AT_REST,
    DESIGN_N_MM,
    Deflection,
    LoopDelays,
    admittance_law,
    damping,
    deflect,
    fastest_approach_mm_s,
)

GAINS = (30.0, 30.0, 15.0)
LIMITS = {0.0035: (78, 82), 0.0071: (75, 79), 0.010: (73, 78), 0.030: (71, 76)}
"""Cycle in s; stiffest environment in N/mm that is stable at the default damping, along z and x."""
PEAKS = {
    0.0035: {1.0: 2.4, 3.0: 4.8, 10.0: 10.4, 30.0: 17.3},
    0.0071: {1.0: 2.4, 3.0: 4.9, 10.0: 11.0, 30.0: 18.4},
    0.010: {1.0: 2.5, 3.0: 5.0, 10.0: 11.4, 30.0: 19.3},
    0.030: {1.0: 2.8, 3.0: 5.9, 10.0: 14.0, 30.0: 25.5},
}
"""Peak force in N at 2 mm/s by cycle and stiffness of the environment."""


@pytest.mark.parametrize("cycle_s", LIMITS)
def test_the_stiffest_stable_environment_is_the_published_one(cycle_s):
    loop = LoopDelays(cycle_s)
    law = admittance_law(loop, GAINS)
    found = largest_stable(law, loop, 2), largest_stable(law, loop, 0)
    assert found == pytest.approx(LIMITS[cycle_s], rel=0.015)


def test_damping_is_the_published_one():
    assert LoopDelays(0.0035).delay_s == pytest.approx(0.0237, abs=5e-5)
    assert damping(LoopDelays(0.0035).delay_s, DESIGN_N_MM) == pytest.approx(1.42, abs=0.005)
    adapter = LoopDelays(0.0035, sensor_lag_s=0.016)
    assert admittance_law(adapter, GAINS).damping == pytest.approx(2.38, abs=0.005)


def test_every_loop_is_stable_up_to_twice_the_design():
    unstable, points = [], 0
    for cycle_s, k in itertools.product((0.0035, 0.0071, 0.010, 0.030), (1.0, 5.0, 15.0, 30.0)):
        loop = LoopDelays(cycle_s)
        law = admittance_law(loop, (k, k, k))
        for environment in np.linspace(0.0, 2.0 * DESIGN_N_MM, 31):
            points += 1
            if not slowest_root(law, loop, environment) < 1.0:
                unstable.append((cycle_s, k, environment))
    assert points == 496
    assert unstable == []


def test_the_rule_of_a_free_oscillator_would_not_protect():
    """So the grid can fail: critical damping of 2 kg swings at what a stiff contact has."""
    loop, mass = LoopDelays(0.0035), 0.002
    law = replace(admittance_law(loop, GAINS), mass=mass, damping=2.0 * math.sqrt(mass * GAINS[2]))
    assert largest_stable(law, loop) == pytest.approx(31.0, rel=0.02)


@pytest.mark.promise("G3")
@pytest.mark.parametrize("cycle_s", PEAKS)
def test_peaks_are_the_published_ones_and_settle(cycle_s):
    loop = LoopDelays(cycle_s)
    law = admittance_law(loop, GAINS)
    for environment, peak_n in PEAKS[cycle_s].items():
        found = press(law, loop, environment, 2.0)
        assert found.peak_n == pytest.approx(peak_n, rel=0.10, abs=0.15)
        assert found.peak_n < 60.0
        assert not found.bounced
        assert found.ripple_n < (0.2 if cycle_s < 0.02 else 1.4)


def test_skipped_cycles_change_the_steady_force_by_little():
    loop = LoopDelays(0.0035)
    law = admittance_law(loop, GAINS)
    for environment in (3.0, 10.0, 30.0):
        smooth = press(law, loop, environment, 1.0)
        rough = press(law, loop, environment, 1.0, stall=0.05, seed=4)
        # The detection itself varies by a sample or two: 0.1 N besides the two per cent.
        assert rough.last_n == pytest.approx(smooth.last_n, rel=0.02, abs=0.1)
        assert rough.peak_n < 40.0


def test_in_free_air_energy_never_grows():
    law = admittance_law(LoopDelays(0.0035), GAINS)
    rng = np.random.default_rng(2)
    k = np.array(GAINS)
    for case in range(50):
        # Let go at rest; or in motion, where the bound of the acceleration does not work.
        free = replace(law, acceleration_mm_s2=math.inf) if case % 2 else law
        speed = rng.uniform(-15, 15, 3) if case % 2 else np.zeros(3)
        give = Deflection(rng.uniform(-2, 2, 3), speed, np.zeros(3))
        before = math.inf
        for _ in range(60):
            energy = float((law.mass * give.v_mm_s**2 + k * give.d_mm**2).sum() / 2.0)
            assert energy <= before * (1.0 + 1e-9)
            before, give = energy, deflect(free, give, np.zeros(3))


@pytest.mark.promise("P1")
def test_any_force_leaves_it_bounded_and_finite():
    law = admittance_law(LoopDelays(0.0035), GAINS)
    rng = np.random.default_rng(9)
    wild = np.array([math.nan, math.inf, -math.inf, 1e6, -1e6, 1e308, 0.0, 3.0])
    give = AT_REST
    for force in rng.choice(wild, (5000, 3)):
        after = deflect(law, give, force)
        assert (np.abs(after.d_mm) <= law.give_mm).all()
        assert (np.abs(after.v_mm_s) <= law.speed_mm_s).all()
        assert (np.abs(after.v_mm_s - give.v_mm_s) <= _most(law, give)).all()
        give = after if np.isfinite(after.g_n).all() else AT_REST


def _most(law, give):
    """A speed changes by the acceleration, or falls to what the limit of the way allows."""
    return np.maximum(ACCELERATION_MM_S2 * law.cycle_s, np.abs(give.v_mm_s)) * (1 + 1e-9)


def test_without_a_finite_force_it_stands_where_it_is():
    law = admittance_law(LoopDelays(0.0035), GAINS)
    give = Deflection(np.array([0.1, 0.2, 0.3]), np.ones(3), np.ones(3))
    after = deflect(law, give, np.array([0.0, math.nan, 0.0]))
    assert (after.d_mm == give.d_mm).all()
    assert (after.v_mm_s == 0.0).all()


def test_pushed_against_its_limit_it_comes_back_without_overshoot():
    law = admittance_law(LoopDelays(0.0035), GAINS)
    give = AT_REST
    for _ in range(round(5.0 / law.cycle_s)):
        give = deflect(law, give, np.array([0.0, 0.0, 200.0]))
    assert give.d_mm[2] == pytest.approx(law.give_mm)
    way = []
    for _ in range(round(2.0 / law.cycle_s)):
        give = deflect(law, give, np.zeros(3))
        way.append(float(give.d_mm[2]))
    assert min(way) > -0.2
    assert abs(way[-1]) < 0.01
    back_s = next(i for i, d in enumerate(way) if d < 0.1) * law.cycle_s
    assert 0.1 < back_s < 1.1


def test_steady_force_is_that_of_springs_in_series():
    law = admittance_law(LoopDelays(0.0035), GAINS)
    give, reference, environment = AT_REST, -1.5, 8.0
    for _ in range(2000):
        give = deflect(law, give, np.array([0, 0, environment * -(reference + give.d_mm[2])]))
    assert give.g_n[2] == pytest.approx(1.5 * 15.0 * 8.0 / 23.0, rel=1e-3)


def test_senseless_gains_are_refused():
    for gains in ((0.0, 30.0, 15.0), (30.0, math.nan, 15.0), (30.0, 30.0, -1.0)):
        with pytest.raises(ValueError, match="positive"):
            admittance_law(LoopDelays(0.0035), gains)
    with pytest.raises(ValueError, match="too small"):
        admittance_law(LoopDelays(0.0035), (1e4, 1e4, 1e4))


def test_an_approach_is_as_fast_as_the_peak_allows():
    loop = LoopDelays(0.0035)
    law = admittance_law(loop, GAINS)
    speed = fastest_approach_mm_s(law, loop, 40.0, 1.5)
    assert press(law, loop, DESIGN_N_MM, min(speed, 5.0)).peak_n < 40.0
