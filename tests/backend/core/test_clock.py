"""The manual clock is exact: whole microseconds without accumulated rounding."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchdown.backend.core.clock import BenchClock, ClockJumpDetector, ManualClock, MonotonicClock


@given(st.lists(st.integers(0, 10_000_000)))
def test_many_small_steps_are_one_large_step(steps):
    by_steps, at_once = ManualClock(), ManualClock()
    for step in steps:
        by_steps.advance(step)
    at_once.advance(sum(steps))
    assert by_steps.now_us == at_once.now_us
    assert by_steps.now_s() == at_once.now_s()


def test_a_cycle_of_10_ms_wound_for_an_hour_is_an_hour():
    clock = ManualClock()
    for _ in range(360_000):
        clock.advance(10_000)
    assert clock.now_s() == 3600.0


def test_it_is_never_wound_back():
    clock = ManualClock()
    clock.advance(5)
    with pytest.raises(ValueError, match="cannot go back"):
        clock.advance(-1)
    assert clock.now_us == 5


def test_it_stands_still_between():
    clock = ManualClock()
    assert clock.now_s() == clock.now_s() == 0.0


def test_the_computer_s_clock_never_goes_back():
    clock = MonotonicClock()
    readings = [clock.now_s() for _ in range(1000)]
    assert readings == sorted(readings)


def test_the_clock_of_a_real_bench_waits_and_makes_up_for_nothing():
    clock = BenchClock()
    begun_s = clock.now_s()
    for _ in range(3):
        clock.wait(10_000)
    assert clock.now_s() - begun_s >= 0.03


@pytest.mark.promise("P2")
@pytest.mark.parametrize(
    ("wall_s", "steady_s", "told_s"),
    [
        (60.0, 60.0, 0.0),
        (-3540.0, 60.0, -3600.0),
        (90.0, 60.0, 30.0),
        (60.9, 60.0, 0.0),
        # What a time server corrects in a day is no jump.
        (86_405.0, 86_400.0, 0.0),
    ],
)
def test_a_wall_clock_that_is_set_is_told_from_one_that_is_kept_right(wall_s, steady_s, told_s):
    at = [1e9, 5.0]
    watch = ClockJumpDetector(lambda: at[0], lambda: at[1])
    assert watch.jump_s() == 0.0
    at[0] += wall_s
    at[1] += steady_s
    assert watch.jump_s() == pytest.approx(told_s)
    assert watch.jump_s() == 0.0
