""""""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.backend.sensing.drop_oracle import broken
from touchdown.backend.core.values import (
    FINGERS,
    Episode,
    Finger,
    MarkerField,
    MarkerState,
    Recording,
)
from touchdown.backend.sensing.episode import (
    EpisodeLimits,
    assemble_episode,
    judge_quality,
    synchronise,
)

ONSET_S = 5.0


def depth_mm(t_s: float, slip_mm: float = 0.0) -> float:
    """Travel of the gripper: a ramp of 1.5 s, then hold."""
    return 1.0 * float(np.clip((t_s - ONSET_S) / 1.5, 0.0, 1.0)) - slip_mm


def field(finger: Finger, number: int, t_s: float, slip_mm: float = 0.0) -> MarkerField:
    moved = np.zeros((63, 2))
    slipped = slip_mm * float(np.clip((t_s - ONSET_S - 1.0) / 0.5, 0.0, 1.0))
    moved[:, 1] = -17.0 * depth_mm(t_s, slipped)
    return MarkerField(finger, number, t_s, moved + 100.0, moved, np.zeros(63, np.uint8), 1.0)


def frames(keep: np.ndarray | None = None, slip_mm: float = 0.0) -> dict[Finger, list[MarkerField]]:
    times = ONSET_S - 0.3 + 0.013 + 0.04 * np.arange(60)
    chosen = np.ones(60, dtype=bool) if keep is None else keep
    return {
        finger: [field(finger, i, float(times[i]), slip_mm) for i in np.flatnonzero(chosen)]
        for finger in FINGERS
    }


def record(by_finger: dict[Finger, list[MarkerField]], press_n: float = 7.8) -> Recording:
    t_s = ONSET_S - 0.3 + 1e-3 * np.arange(2400)
    wrench = np.zeros((2400, 6))
    wrench[:, 2] = press_n * np.clip((t_s - ONSET_S) / 1.5, 0.0, 1.0)
    pose_t_s = ONSET_S - 0.3 + 0.01 * np.arange(240)
    pose = np.zeros((240, 3))
    pose[:, 2] = [30.0 - depth_mm(float(t)) for t in pose_t_s]
    fields = tuple(by_finger["left"] + by_finger["right"])
    return Recording(t_s, wrench, fields, (), pose_t_s, pose, np.zeros(6))


def build(recording: Recording) -> Episode:
    return assemble_episode(
        recording, onset_s=ONSET_S, offset_mm=np.array([3.0, -1.0]), piece="pot"
    )


def test_a_good_probe_is_accepted() -> None:
    episode = build(record(frames()))
    quality = episode.quality
    assert quality.accepted
    assert quality.reasons == ()
    assert (quality.dropped_frames, quality.lost_markers, quality.inferred_share) == (0, 0, 0.0)
    assert 0 < quality.skew_ms <= 20.0
    assert quality.slip_mm == pytest.approx(0.0, abs=1e-6)
    assert np.isfinite(episode.observation).all()
    assert episode.metadata == ()
    assert not episode.observation.flags.writeable


def test_equal_recordings_give_equal_episodes_and_others_do_not() -> None:
    first, again, other = (
        build(record(frames())),
        build(record(frames())),
        build(record(frames(), 7.9)),
    )
    assert first.episode_id == again.episode_id
    assert np.array_equal(first.observation, again.observation)
    assert other.episode_id != first.episode_id


@pytest.mark.parametrize("slip_mm", [0.1, 0.25, 0.4, 0.8])
def test_slip_is_measured_and_judged(slip_mm: float) -> None:
    quality = build(record(frames(slip_mm=slip_mm))).quality
    assert quality.slip_mm == pytest.approx(slip_mm, abs=0.02)
    assert quality.accepted == (slip_mm < 0.3)


def test_no_contact_is_named() -> None:
    quality = build(record(frames(), press_n=0.4)).quality
    assert not quality.accepted
    assert quality.reasons == ("No contact: 0.40 N at the end of the press",)


def test_a_nan_sample_is_not_an_observation() -> None:
    recording = record(frames())
    wrench = recording.wrench.copy()
    wrench[1234, 5] = np.nan
    episode = build(replace(recording, wrench=wrench))
    assert not episode.quality.accepted
    assert "force sensor" in episode.quality.reasons[0]
    assert np.isnan(episode.observation).any()


def test_arm_positions_are_needed_to_judge_slip() -> None:
    recording = record(frames())
    blind = replace(recording, pose_t_s=np.zeros(0), pose_mm=np.zeros((0, 3)))
    assert build(blind).quality.reasons == ("Slip in the grasp cannot be judged",)


def test_lost_and_inferred_markers() -> None:
    def with_state(count: int, state: MarkerState) -> Recording:
        by_finger = frames()
        states = np.zeros(63, np.uint8)
        states[:count] = state
        by_finger["left"] = [replace(f, state=states.copy()) for f in by_finger["left"]]
        return record(by_finger)

    assert build(with_state(9, MarkerState.INFERRED)).quality.accepted
    many = build(with_state(40, MarkerState.INFERRED)).quality
    assert many.inferred_share == pytest.approx(40 / 126)
    assert many.reasons == ("32 % of the markers were not seen",)
    assert build(with_state(6, MarkerState.LOST)).quality.accepted
    assert build(with_state(7, MarkerState.LOST)).quality.reasons == ("7 of 126 markers were lost",)


@pytest.mark.promise("C5")
def test_a_bridged_tick_is_named() -> None:
    keep = np.ones(60, dtype=bool)
    times = ONSET_S - 0.3 + 0.013 + 0.04 * np.arange(60)
    keep[np.abs(times - (ONSET_S + 1.0)) < 0.061] = False
    by_finger = {"left": frames(keep)["left"], "right": frames()["right"]}
    episode = build(record(by_finger))
    assert episode.quality.accepted
    assert episode.quality.dropped_frames == 3
    assert episode.metadata == (("bridged_ticks", "left:10"),)
    assert np.isfinite(episode.observation).all()


@pytest.mark.promise("P1")
def test_a_limit_or_position_of_nan_refuses() -> None:
    recording = record(frames())
    strict = judge_quality(synchronise(recording, ONSET_S), 0.0, EpisodeLimits(contact_n=np.nan))
    assert not strict.accepted
    nowhere = assemble_episode(
        recording, onset_s=ONSET_S, offset_mm=np.array([0.0, np.nan]), piece="pot"
    )
    assert not nowhere.quality.accepted


@pytest.mark.promise("C5")
def test_verdict_values_and_marks_equal_the_oracle_for_random_drop_patterns() -> None:
    wrong, accepted = broken(100, record(frames()))
    assert wrong == []
    assert 16 < accepted < 84


START_S = 12.3456
TICKS_S = START_S + 0.1 * np.arange(1, 21)


def displacement(finger: Finger, t_s: float) -> np.ndarray:
    """A field linear in time, so that linear interpolation must be exact; every number differs."""
    index = np.arange(126.0).reshape(63, 2)
    sign = 1.0 if finger == "left" else -1.0
    return sign * (0.01 * index + (t_s - START_S) * (1.0 + index / 126.0))


def ramp(finger: Finger, number: int, t_s: float) -> MarkerField:
    moved = displacement(finger, t_s)
    return MarkerField(finger, number, t_s, moved + 100.0, moved, np.zeros(63, np.uint8), 1.0)


def frame_times(period_s: float = 0.04, phase_s: float = 0.013) -> np.ndarray:
    return START_S - 0.3 + phase_s + period_s * np.arange(int(2.4 / period_s))


def ramp_fields(finger: Finger = "left") -> list[MarkerField]:
    return [ramp(finger, i, float(t)) for i, t in enumerate(frame_times())]


def ramps(
    left: list[MarkerField] | None = None,
    right: list[MarkerField] | None = None,
    wrench_t_s: np.ndarray | None = None,
    wrench: np.ndarray | None = None,
) -> Recording:
    own = {"left": left, "right": right}
    fields: list[MarkerField] = []
    for finger in FINGERS:
        given = own[finger]
        fields += ramp_fields(finger) if given is None else given
    t_s = START_S - 0.3 + 1e-3 * np.arange(2400) if wrench_t_s is None else wrench_t_s
    values = np.outer(t_s - START_S, np.arange(1.0, 7.0)) if wrench is None else wrench
    empty = np.zeros((0, 3))
    return Recording(t_s, values, tuple(fields), (), np.zeros(0), empty, np.zeros(6))


def test_linear_signals_are_met_exactly() -> None:
    ticks = synchronise(ramps(), START_S)
    for finger, name in zip(ticks.fingers, FINGERS, strict=True):
        for i, t_s in enumerate(TICKS_S):
            np.testing.assert_allclose(
                finger.displacement_px[i], displacement(name, t_s), atol=1e-9
            )
    # The mean of a ramp over (tick - 0.1, tick] of 100 samples lies 49.5 samples before the last.
    i = np.arange(20)
    last = np.floor((TICKS_S - (START_S - 0.3)) * 1e3 + 1e-6) * 1e-3 - 0.3
    np.testing.assert_allclose(ticks.wrench[i, 0], last - 0.0495, atol=1e-9)
    np.testing.assert_allclose(ticks.wrench[:, 5], 6 * ticks.wrench[:, 0])


def test_order_of_the_252_numbers() -> None:
    rows = synchronise(ramps(), START_S).observation()
    assert rows.shape == (20, 258)
    assert rows.dtype == np.float32
    for sensor, finger in enumerate(FINGERS):
        moved = displacement(finger, TICKS_S[4])
        for axis in (0, 1):
            for row, column in ((0, 0), (3, 7), (6, 8)):
                index = ((sensor * 2 + axis) * 7 + row) * 9 + column
                assert rows[4, index] == pytest.approx(moved[row * 9 + column, axis], abs=1e-5)


def test_skew_is_the_distance_to_the_nearest_frame() -> None:
    ticks = synchronise(ramps(), START_S)
    times = frame_times()
    expected = max(min(abs(t - tick) for t in times) for tick in TICKS_S)
    assert ticks.skew_s == pytest.approx(expected, abs=1e-12)


def test_frame_on_the_tick_needs_no_other() -> None:
    exact = [ramp("left", i, float(t)) for i, t in enumerate(TICKS_S)]
    ticks = synchronise(ramps(left=exact), START_S)
    assert ticks.left.near.all()
    np.testing.assert_allclose(ticks.left.displacement_px[0], exact[0].displacement_px)


def test_nothing_is_extrapolated() -> None:
    early = [field for field in ramp_fields() if field.t_s < START_S + 1.99]
    ticks = synchronise(ramps(left=early), START_S)
    assert np.isnan(ticks.left.displacement_px[19]).all()
    assert not ticks.left.near[19]
    late = [field for field in ramp_fields() if field.t_s > START_S + 0.101]
    ticks = synchronise(ramps(left=late), START_S)
    assert np.isnan(ticks.left.displacement_px[0]).all()


def test_no_frames_and_no_wrench_are_missing_not_zero() -> None:
    nothing = np.zeros((0, 6))
    ticks = synchronise(ramps(left=[], wrench_t_s=np.zeros(0), wrench=nothing), START_S)
    assert np.isnan(ticks.wrench).all()
    assert np.isnan(ticks.left.displacement_px).all()
    assert not ticks.left.near.any()
    assert ticks.skew_s == np.inf
    assert ticks.left.hole_s == pytest.approx(2.0)


def test_field_with_nan_is_a_frame_that_never_came() -> None:
    fields = ramp_fields()
    moved = fields[20].displacement_px.copy()
    moved[5, 1] = np.nan
    bad = fields[20]
    fields[20] = MarkerField(
        "left", 20, bad.t_s, bad.position_px.copy(), moved, bad.state.copy(), 1.0
    )
    with_bad = synchronise(ramps(left=fields), START_S)
    without = synchronise(ramps(left=fields[:20] + fields[21:]), START_S)
    np.testing.assert_array_equal(with_bad.left.displacement_px, without.left.displacement_px)
    assert np.isfinite(with_bad.left.displacement_px).all()
    assert (with_bad.left.dropped, without.left.dropped) == (0, 1)


def test_marker_states_of_both_frames_count() -> None:
    fields = ramp_fields()
    state = np.zeros(63, np.uint8)
    state[7], state[8] = MarkerState.INFERRED, MarkerState.LOST
    first = next(i for i, f in enumerate(fields) if f.t_s > TICKS_S[9])
    old = fields[first]
    fields[first] = MarkerField(
        "left", first, old.t_s, old.position_px.copy(), old.displacement_px.copy(), state, 1.0
    )
    ticks = synchronise(ramps(left=fields), START_S)
    assert ticks.left.inferred[9, 7]
    assert ticks.left.lost[9, 8]
    assert not ticks.left.lost[9, 7]
    assert ticks.left.inferred.sum() == 2


def test_wrench_needs_80_percent_and_finite_samples() -> None:
    t_s = START_S - 0.3 + 1e-3 * np.arange(2400)
    values = np.ones((2400, 6))
    in_fifth = (t_s > TICKS_S[4] - 0.1) & (t_s <= TICKS_S[4])
    keep = np.ones(2400, dtype=bool)
    keep[np.flatnonzero(in_fifth)[:19]] = False
    ticks = synchronise(ramps(wrench_t_s=t_s[keep], wrench=values[keep].copy()), START_S)
    assert np.isfinite(ticks.wrench).all()
    keep[np.flatnonzero(in_fifth)[:21]] = False
    ticks = synchronise(ramps(wrench_t_s=t_s[keep], wrench=values[keep].copy()), START_S)
    assert np.flatnonzero(np.isnan(ticks.wrench[:, 2])).tolist() == [4]
    values[np.flatnonzero(in_fifth)[50], 3] = np.nan
    ticks = synchronise(ramps(wrench_t_s=t_s, wrench=values), START_S)
    assert np.flatnonzero(np.isnan(ticks.wrench[:, 2])).tolist() == [4]
