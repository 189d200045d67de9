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
from touchdown.backend.sensing.episode import EpisodeLimits, assemble_episode

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
def test_a_limit_of_nan_or_bad_position_refuses() -> None:
    recording = record(frames())
    strict = assemble_episode(
        recording,
        onset_s=ONSET_S,
        offset_mm=np.zeros(2),
        piece="pot",
        limits=EpisodeLimits(contact_n=float("nan")),
    )
    assert not strict.quality.accepted
    nowhere = assemble_episode(
        recording, onset_s=ONSET_S, offset_mm=np.array([0.0, np.nan]), piece="pot"
    )
    assert not nowhere.quality.accepted


@pytest.mark.promise("C5")
def test_verdict_values_and_marks_equal_the_oracle_for_random_drop_patterns() -> None:
    # 500 of them: figure "dropped_frames".
    wrong, accepted = broken(48, record(frames()))
    assert wrong == []
    assert 8 < accepted < 40
