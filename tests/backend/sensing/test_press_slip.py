"""Slip from the gels against the slip of the simulated grasp."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from touchdown.backend.config.method import ProbeSettings
from touchdown.backend.config.simulation import SimulationSettings
from touchdown.backend.core.values import FINGERS, MarkerField, Recording
from touchdown.backend.sensing.slip import press_slip_mm
from touchdown.backend.simulation import conditions as nuisance
from touchdown.backend.simulation import mechanics
from touchdown.backend.simulation.marker_fields import build_gel
from touchdown.backend.simulation.mechanics import advance_probes, begin_probes

NOISE_PX = 0.05
GRIP_HEIGHT_MM, WIDTH_MM = 33.0, 30.0


class Disc:
    def contains(self, points_mm: np.ndarray, /) -> np.ndarray:
        return np.hypot(points_mm[..., 0], points_mm[..., 1]) <= 9.0


def face_points() -> np.ndarray:
    axis = np.arange(-13.0, 14.0)
    points = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    return points[np.hypot(points[:, 0], points[:, 1]) <= 12.7]


def pressed(mu_grip: float, count: int = 12) -> tuple[list[Recording], np.ndarray]:
    """Return presses at random places, slightly tilted, and their true vertical slip (count,)."""
    rng = np.random.default_rng(11)
    spread = SimulationSettings(preset="off")
    draw = (
        nuisance.draw_mounting(spread, rng),
        nuisance.draw_gripping(spread, 10.0, rng),
        nuisance.draw_probe(spread, rng),
    )
    conditions = replace(
        nuisance.conditions_from_draws(
            spread, ProbeSettings(), GRIP_HEIGHT_MM, WIDTH_MM, [draw] * count
        ),
        mu_grip=np.full(count, mu_grip),
        slips=np.ones(count, dtype=bool),
        tilt_rad=rng.normal(0.0, 0.004, (count, 2)),
    )
    state = begin_probes(face_points(), Disc(), rng.uniform(-7, 7, (count, 2)), conditions)
    gel = build_gel((0.058, 0.058))
    fields: list[list[MarkerField]] = [[] for _ in range(count)]
    times, heights = np.arange(-7, 51) * 0.04 + 0.013, []
    for number, t_s in enumerate(times):
        command = np.zeros((count, 3))
        command[:, 2] = -2.0 * t_s if t_s < 0 else -1.5 * min(1.0, t_s / 1.5)
        height, shown_px = command[:, 2], np.zeros((count, 2, 63, 2))
        if t_s > 0:
            spring = mechanics.springs(conditions, state.relaxed, 0.04)
            state, solved = advance_probes(state, command, 0.04)
            unloaded = spring.hidden.copy()
            unloaded[:, :, :3] += solved.slip
            zero = mechanics.elastic_zero(command, unloaded, conditions.width_mm)
            height = height + (spring.give * (solved.q - zero)[:, :3])[:, 2]
            shown_px = gel.displacement_px(solved.strain, solved.normal_n, conditions.grip_force_n)
        heights.append(height)
        noisy = shown_px + NOISE_PX * rng.standard_normal(shown_px.shape)
        for k in range(count):
            for i, finger in enumerate(FINGERS):
                moved = noisy[k, i].copy()
                fields[k].append(
                    MarkerField(finger, number, t_s, moved + 99, moved, np.zeros(63, np.uint8), 1.0)
                )
    recordings = []
    for k in range(count):
        pose = np.zeros((len(times), 3))
        pose[:, 2] = [height[k] for height in heights]
        wrench = np.zeros((len(times), 6))
        recordings.append(
            Recording(times.copy(), wrench, tuple(fields[k]), (), times.copy(), pose, np.zeros(6))
        )
    return recordings, np.abs(solved.slip[:, :, 1]).max(axis=1)


@pytest.mark.parametrize(
    ("mu_grip", "least_mm", "most_mm"), [(0.8, 0.0, 0.0), (0.4, 0.0, 0.11), (0.33, 0.15, 0.4)]
)
def test_slip_of_the_simulated_grasp(mu_grip: float, least_mm: float, most_mm: float) -> None:
    recordings, true_mm = pressed(mu_grip)
    assert least_mm <= np.median(true_mm)
    assert true_mm.max() <= most_mm
    found_mm = np.array([press_slip_mm(recording, 0.0, 2.0) for recording in recordings])
    np.testing.assert_allclose(found_mm, true_mm, atol=0.04)


def test_what_cannot_be_judged_is_not_a_number() -> None:
    recording = pressed(0.8, 1)[0][0]
    blind = replace(recording, pose_t_s=np.zeros(0), pose_mm=np.zeros((0, 3)))
    one_finger = replace(recording, fields=tuple(f for f in recording.fields if f.finger == "left"))
    still = replace(recording, pose_mm=np.zeros_like(recording.pose_mm))
    for incomplete in (blind, one_finger, still):
        assert np.isnan(press_slip_mm(incomplete, 0.0, 2.0))
