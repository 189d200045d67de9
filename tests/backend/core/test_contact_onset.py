"""The manual clock is exact: whole microseconds without accumulated rounding."""

from __future__ import annotations

import math
import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from touchdown.backend.core.clock import BenchClock, ClockJumpDetector, ManualClock
from touchdown.backend.core.contact_onset import (
    OnsetDetector,
    OnsetRule,
    back_date_onset,
    detect_contact,
    force_over_baseline,
)
from touchdown.backend.core.event_bus import EventBus, EventQueue
from touchdown.backend.core.events import Said
from touchdown.backend.core.marker_interpolation import fill_unseen_markers, marker_misfit
from touchdown.backend.core.rotations import (
    pose_rotation,
    rotation_angle_rad,
    rotation_from_vector,
    rotation_vector,
    tilt_margin_rad,
    tilt_rad,
)
from touchdown.backend.core.values import Pose


@given(st.lists(st.integers(0, 10_000_000)))
def test_many_small_steps_are_one_large_step(steps):
    by_steps, at_once = ManualClock(), ManualClock()
    for step in steps:
        by_steps.advance(step)
    at_once.advance(sum(steps))
    assert by_steps.now_us == at_once.now_us
    assert by_steps.now_s() == at_once.now_s()


def test_it_is_never_wound_back():
    clock = ManualClock()
    clock.advance(5)
    with pytest.raises(ValueError, match="cannot go back"):
        clock.advance(-1)
    assert clock.now_us == 5


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


def _fact(number: int) -> Said:
    return Said(float(number), str(number))


def test_a_subscriber_may_leave_during_delivery_and_again():
    hub, heard = EventBus(), []

    def once(fact):
        heard.append(fact)
        leave()

    leave = hub.subscribe(once)
    late = []
    hub.subscribe(late.append)
    hub.publish(_fact(0))
    leave()
    hub.publish(_fact(1))
    assert heard == [_fact(0)]
    assert late == [_fact(0), _fact(1)]


def test_a_fact_published_by_a_subscriber_reaches_all():
    hub, heard = EventBus(), []

    def answer(fact):
        if fact.t_s == 0:
            hub.publish(_fact(1))

    hub.subscribe(answer)
    hub.subscribe(heard.append)
    hub.publish(_fact(0))
    assert sorted(fact.t_s for fact in heard) == [0.0, 1.0]


def test_two_publishers_never_interleave_within_one_fact():
    hub, log = EventBus(), []
    hub.subscribe(lambda fact: log.append(("a", fact.text)))
    hub.subscribe(lambda fact: log.append(("b", fact.text)))

    def publish(start):
        for i in range(start, start + 300):
            hub.publish(_fact(i))

    threads = [threading.Thread(target=publish, args=(start,)) for start in (0, 1000, 2000)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(log) == 2 * 900
    assert all(log[i][1] == log[i + 1][1] and log[i][0] == "a" for i in range(0, len(log), 2))


@given(st.integers(1, 20), st.lists(st.booleans(), max_size=200))
def test_a_mailbox_keeps_the_newest_and_counts_the_rest(capacity, moves):
    """Against a plain list: True puts the next fact, False takes one."""
    box, model, put, dropped = EventQueue(capacity), [], 0, 0
    for is_put in moves:
        if is_put:
            box(_fact(put))
            model.append(_fact(put))
            put += 1
            if len(model) > capacity:
                model.pop(0)
                dropped += 1
        else:
            assert box.take() == (model.pop(0) if model else None)
    assert box.dropped == dropped
    rest = []
    while (fact := box.take()) is not None:
        rest.append(fact)
    assert rest == model


ROW, COL = np.divmod(np.arange(63), 9)


def affine(rng: np.random.Generator) -> np.ndarray:
    a = rng.normal(size=(3, 2))
    return np.stack([np.ones(63), COL, ROW], axis=1) @ a


def test_affine_fields_are_continued_exactly_even_beyond_the_border():
    rng = np.random.default_rng(1)
    truth = np.stack([affine(rng) for _ in range(200)])
    seen = rng.random((200, 63)) > rng.uniform(0.02, 0.6, (200, 1))
    seen[0, :9] = False
    seen[1, 54:] = False
    broken = np.where(seen[:, :, None], truth, np.nan)
    filled = fill_unseen_markers(broken, seen)
    np.testing.assert_allclose(filled, truth, atol=2e-3)
    assert (filled[seen] == truth[seen]).all()


def test_filling_bends_the_field_least():
    """Independent truth: direct minimisation of the bending energy written out as differences."""
    rng = np.random.default_rng(2)
    seen = np.ones(63, dtype=bool)
    hidden = np.array([0, 13, 14, 31, 44, 62])
    seen[hidden] = False
    values = np.sin(0.5 * COL) + 0.3 * np.cos(0.8 * ROW) + 0.05 * rng.normal(size=63)

    def energy(guess: np.ndarray) -> float:
        field = values.copy()
        field[hidden] = guess
        grid = field.reshape(7, 9)
        mixed = np.diff(np.diff(grid, axis=0), axis=1)
        bends = [np.diff(grid, 2, axis=0), np.diff(grid, 2, axis=1), np.sqrt(2) * mixed]
        return float(sum((b**2).sum() for b in bends))

    best = minimize(energy, np.zeros(6), method="BFGS", options={"gtol": 1e-9}).x
    filled = fill_unseen_markers(np.stack([values, 2 * values], axis=-1)[None], seen[None])[0]
    np.testing.assert_allclose(filled[hidden, 0], best, atol=1e-4)
    np.testing.assert_allclose(filled[:, 1], 2 * filled[:, 0], atol=1e-9)


def test_too_few_markers_give_the_neighbour_value_and_none_gives_zero():
    seen = np.zeros((2, 63), dtype=bool)
    seen[0, 30] = True
    field = np.full((2, 63, 2), 4.0)
    filled = fill_unseen_markers(field, seen)
    np.testing.assert_allclose(filled[0], 4.0, rtol=5e-2)
    assert (filled[1] == 0.0).all()


def test_each_frame_is_filled_by_itself():
    rng = np.random.default_rng(3)
    field = rng.normal(size=(40, 63, 2))
    seen = rng.random((40, 63)) > 0.1
    together = fill_unseen_markers(field, seen)
    alone = np.concatenate(
        [fill_unseen_markers(f[None], s[None]) for f, s in zip(field, seen, strict=True)]
    )
    np.testing.assert_allclose(together, alone, atol=1e-9)


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match="63"):
        fill_unseen_markers(np.zeros((1, 62, 2)), np.ones((1, 62), dtype=bool))


def test_misfit_is_the_error_of_leaving_one_marker_out():
    rng = np.random.default_rng(4)
    field = rng.normal(size=(63, 2))
    left_out = fill_unseen_markers(np.repeat(field[None], 63, axis=0), ~np.eye(63, dtype=bool))
    expected = field - left_out[np.arange(63), np.arange(63)]
    np.testing.assert_allclose(marker_misfit(field), expected, atol=1e-9)
    np.testing.assert_allclose(marker_misfit(affine(rng)), 0.0, atol=1e-3)


RULE = OnsetRule()
T_S = 1e-3 * np.arange(1200)
ONSET_S = 0.8


def ramp(slope_n_s: float, onset_s: float = ONSET_S):
    return slope_n_s * np.maximum(T_S - onset_s, 0.0)


def onset_of(force, t_s=T_S):
    over = force_over_baseline(np.atleast_2d(force))
    found = detect_contact(over)
    return found, back_date_onset(t_s, over, found)


@pytest.mark.parametrize("slope_n_s", [8.0, 10.0, 40.0])
def test_a_clean_ramp_is_dated_to_its_foot(slope_n_s):
    found, onset = onset_of(ramp(slope_n_s))
    assert onset[0] == pytest.approx(ONSET_S, abs=1e-9)
    crossing = np.flatnonzero(ramp(slope_n_s) > 1.0)[0]
    assert found[0] == crossing + 2


def test_a_very_soft_grasp_is_still_found():
    # At 4 N/s contact has crept into the baseline window by the time it is declared.
    found, onset = onset_of(ramp(4.0))
    assert T_S[found[0]] - ONSET_S > 0.25
    assert onset[0] == pytest.approx(ONSET_S, abs=5e-3)


def test_the_baseline_ends_200_ms_before_the_sample():
    force = np.zeros(600)
    force[100:300] = 5.0
    over = force_over_baseline(force)
    assert np.isnan(over[:400]).all()
    for i in (400, 450, 599):
        assert over[i] == pytest.approx(force[i] - force[i - 400 : i - 200].mean())


@pytest.mark.promise("S8")
def test_a_constant_load_and_a_slow_drift_are_no_contact():
    force = 14.7 + 0.5 * T_S
    found, onset = onset_of(force)
    assert found[0] == -1
    assert np.isnan(onset[0])


def test_two_high_samples_are_not_contact_three_are():
    for length, wanted in ((2, -1), (3, 702)):
        force = np.zeros(1200)
        force[700 : 700 + length] = 2.0
        assert onset_of(force)[0][0] == wanted


def test_noise_of_the_bench_neither_triggers_nor_biases_much():
    rng = np.random.default_rng(1)
    air = 0.1 * rng.standard_normal((50, 5000))
    assert (detect_contact(force_over_baseline(air)) == -1).all()
    pressed = ramp(10.0) + 0.1 * rng.standard_normal((400, 1200))
    over = force_over_baseline(pressed)
    found = detect_contact(over)
    error_s = back_date_onset(T_S, over, found) - ONSET_S
    assert (found >= 0).all()
    assert abs(error_s.mean()) < 2e-3
    assert error_s.std() < 6e-3


def test_rows_may_have_their_own_times():
    force = np.stack([ramp(10.0), ramp(6.0)])
    over = force_over_baseline(force)
    found = detect_contact(over)
    shifted = np.stack([T_S, T_S + 0.5])
    np.testing.assert_allclose(back_date_onset(shifted, over, found), [ONSET_S, ONSET_S + 0.5])


@pytest.mark.parametrize("chunk", [1, 7, 10, 400, 1200])
def test_the_stream_gives_what_the_whole_signal_gives(chunk):
    rng = np.random.default_rng(2)
    force = ramp(9.0) + 0.1 * rng.standard_normal(1200)
    found, onset = onset_of(force)
    detector = OnsetDetector(RULE)
    declared_at = None
    for start in range(0, 1200, chunk):
        part = slice(start, start + chunk)
        if detector.feed(T_S[part], force[part]):
            declared_at = start
            break
    assert declared_at == found[0] // chunk * chunk
    assert detector.detected_s == pytest.approx(T_S[found[0]])
    assert detector.onset_s == pytest.approx(onset[0], abs=1e-9)


def test_the_stream_stays_bounded_and_quiet_in_air():
    rng = np.random.default_rng(3)
    detector = OnsetDetector()
    for k in range(500):
        t_s = 1e-2 * k + 1e-3 * np.arange(10)
        assert not detector.feed(t_s, 14.7 + 0.1 * rng.standard_normal(10))
    assert detector.onset_s is None
    assert len(detector._force_n) <= 2 * RULE.lead


def test_a_sample_that_is_no_number_is_not_contact():
    force = ramp(10.0)
    force[600] = np.nan
    found, _ = onset_of(force)
    assert found[0] == -1


RNG = np.random.default_rng(5)


def test_a_turn_and_its_vector_are_those_of_scipy():
    for vector in RNG.normal(0.0, 1.0, (100, 3)):
        turn = rotation_from_vector(vector)
        assert turn == pytest.approx(Rotation.from_rotvec(vector).as_matrix(), abs=1e-12)
        back = Rotation.from_matrix(turn).as_rotvec()
        assert rotation_vector(turn) == pytest.approx(back, abs=1e-9)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-4, math.pi - 1e-5, math.pi])
def test_tiny_and_half_turns_come_back(size):
    for axis in (*np.eye(3), np.array([0.6, 0.0, -0.8])):
        turn = rotation_from_vector(size * axis)
        assert rotation_from_vector(rotation_vector(turn)) == pytest.approx(turn, abs=1e-8)
        assert np.linalg.norm(rotation_vector(turn)) == pytest.approx(size, abs=1e-8)


def test_a_turn_about_z_leans_nothing():
    assert tilt_rad(rotation_from_vector(np.array([0.0, 0.0, 2.0]))) == pytest.approx(
        0.0, abs=1e-12
    )
    assert tilt_rad(rotation_from_vector(np.array([0.3, 0.0, 0.0]))) == pytest.approx(0.3)
    pose = Pose(1.0, 2.0, 3.0, 0.0, 0.0, 0.25)
    assert rotation_angle_rad(pose) == 0.25
    assert tilt_rad(pose_rotation(pose)) == pytest.approx(0.0, abs=1e-12)


def test_the_room_ends_where_the_lean_does():
    most = math.radians(15.0)
    for _ in range(200):
        lean = RNG.uniform(0.0, 0.99) * most
        heading = RNG.uniform(-math.pi, math.pi)
        turn = rotation_from_vector(np.array([0.0, 0.0, RNG.uniform(-3, 3)]))
        turn = (
            rotation_from_vector(lean * np.array([math.cos(heading), math.sin(heading), 0.0]))
            @ turn
        )
        axis = RNG.normal(0.0, 1.0, 3)
        axis /= np.linalg.norm(axis)
        room = tilt_margin_rad(turn, axis, most)
        angles = np.linspace(0.0, min(room, 2 * math.pi), 60)
        leans = [tilt_rad(rotation_from_vector(angle * axis) @ turn) for angle in angles]
        assert max(leans) <= most + 1e-9
        if math.isfinite(room):
            assert leans[-1] == pytest.approx(most, abs=1e-9)


def test_at_the_limit_only_the_way_back_has_room():
    most = math.radians(15.0)
    x = np.array([1.0, 0.0, 0.0])
    turn = rotation_from_vector(most * x)
    assert tilt_margin_rad(turn, x, most) == pytest.approx(0.0, abs=1e-9)
    assert tilt_margin_rad(turn, -x, most) == pytest.approx(2 * most)
    beyond = rotation_from_vector(1.1 * most * x)
    assert tilt_margin_rad(beyond, x, most) == 0.0
    assert tilt_margin_rad(turn, np.array([0.0, 0.0, 1.0]), most) == math.inf
