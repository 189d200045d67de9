"""The batched press against the stepped law in cycles of 10 ms."""

from __future__ import annotations

import numpy as np
import pytest

from tests.backend.simulation.conftest import Disc, lattice, plain
from touchdown.backend.config.method import ProbeSettings
from touchdown.backend.core.contact_onset import OnsetRule
from touchdown.backend.simulation.marker_fields import build_gel
from touchdown.backend.simulation.mechanics import GraspHistory, advance_probes, begin_probes
from touchdown.backend.simulation.pressing import (
    Timeline,
    noise_samples,
    pack_equilibrium,
    press_batch,
)

RULE, PROBE, CYCLE_S = OnsetRule(), ProbeSettings(), 0.01
COUNT = 24


def setting(seed: int, **changes):
    """Return a fresh state, cycle phases and noise of ``COUNT`` presses of the Pot on circle25."""
    rng = np.random.default_rng(seed)
    tilt = 0.004 * rng.standard_normal((COUNT, 2))
    made = plain(COUNT, 30.0, tilt_rad=tilt, **changes)
    angle, reach = rng.uniform(0, 2 * np.pi, COUNT), rng.uniform(0, 16, COUNT)
    offsets = np.stack([reach * np.cos(angle), reach * np.sin(angle)], axis=1)
    state = begin_probes(lattice(15.0), Disc(25), offsets, made)
    noise = 0.1 * rng.standard_normal((COUNT, noise_samples(RULE, CYCLE_S)))
    return state, CYCLE_S * rng.random(COUNT), noise


def stepped(state, phase_s, pressed) -> Timeline:
    """Follow the law of the bench cycle by cycle, told only when to stop and the onset."""
    times, values = [-phase_s], []
    state, solved = advance_probes(state, np.tile([0.0, 0.0, 3.0], (COUNT, 1)), 1.5)
    values.append(pack_equilibrium(solved))
    descent = pressed.timeline.t_s[:, :-22]
    stop_s = descent.max(axis=1)
    onset, t_s = pressed.onset_s, -phase_s
    for _ in range(206):
        t_s = t_s + CYCLE_S
        ramp = 2.0 * onset + 1.5 * np.minimum(1.0, (t_s - onset) / 1.5)
        falling = t_s <= stop_s + 1e-9
        depth = np.where(falling, 2.0 * t_s, np.maximum(2.0 * stop_s, ramp))
        command = np.zeros((COUNT, 3))
        command[:, 2] = -depth
        state, solved = advance_probes(state, command, CYCLE_S)
        times.append(t_s)
        values.append(pack_equilibrium(solved))
    return Timeline(np.stack(times, axis=1), np.stack(values, axis=1))


def pixels(values, air):
    strain = (values[..., 6:12] - air[:, None, 6:12]).reshape(*values.shape[:2], 2, 3)
    gel = build_gel((0.058, 0.058))
    return gel.displacement_px(strain, values[..., 12:14], np.full((COUNT, 1), 10.0))


@pytest.mark.parametrize(
    ("changes", "limit_px"),
    [({}, 0.003), ({"mu_grip": 0.38}, 0.03), ({"alpha": 0.1}, 0.005)],
    ids=["plain", "slipping", "hysteretic"],
)
def test_steps_at_the_ticks_agree_with_steps_of_every_cycle(changes, limit_px) -> None:
    state, phase_s, noise = setting(1, **changes)
    pressed = press_batch(state, phase_s, noise, PROBE, RULE, CYCLE_S)
    reference = stepped(state, phase_s, pressed)
    t_s = pressed.onset_s[:, None] + np.arange(0.02, 2.0, 0.02)
    ours, theirs = pressed.timeline.at(t_s), reference.at(t_s)
    difference = pixels(ours, pressed.air) - pixels(theirs, pressed.air)
    assert np.sqrt((difference**2).mean()) < limit_px
    # Where slip begins between two ticks the coarse line cuts the corner.
    assert np.sqrt(((ours - theirs)[..., :3] ** 2).mean()) < 0.01
    np.testing.assert_allclose(ours[:, 4::5, :3], theirs[:, 4::5, :3], atol=0.03)


def test_onset_is_found_within_a_few_milliseconds() -> None:
    state, phase_s, noise = setting(2)
    pressed = press_batch(state, phase_s, noise, PROBE, RULE, CYCLE_S)
    assert pressed.detected.all()
    error_s = pressed.onset_s - pressed.touch_s
    assert abs(error_s.mean()) < 4e-3
    assert np.abs(error_s).max() < 0.02
    np.testing.assert_allclose(np.diff(pressed.ticks_s, axis=1), 0.1)


def test_a_slipped_piece_touches_later_and_is_found_all_the_same() -> None:
    state, phase_s, noise = setting(3)
    slipped = np.zeros((COUNT, 2, 3))
    slipped[:, :, 1] = 0.7
    moved = begin_probes(
        lattice(15.0),
        Disc(25),
        np.zeros((COUNT, 2)),
        state.conditions,
        previous=GraspHistory(slipped, state.relaxed),
    )
    pressed = press_batch(moved, phase_s, noise, PROBE, RULE, CYCLE_S)
    assert pressed.detected.all()
    assert np.abs(pressed.onset_s - pressed.touch_s).max() < 0.02


def test_no_contact_is_reported_not_invented() -> None:
    state, phase_s, noise = setting(4)
    aside = begin_probes(lattice(15.0), Disc(25), np.full((COUNT, 2), 40.0), state.conditions)
    pressed = press_batch(aside, phase_s, noise, PROBE, RULE, CYCLE_S)
    assert not pressed.detected.any()
    assert not pressed.timeline.values[..., :6].any()


def test_timeline_is_linear_between_and_constant_outside() -> None:
    line = Timeline(np.array([[0.0, 1.0, 1.0, 2.0]]), np.zeros((1, 4, 14)))
    line.values[0, :, 0] = [0.0, 2.0, 4.0, 6.0]
    got = line.at(np.array([[-1.0, 0.5, 1.0, 1.5, 9.0]]))[0, :, 0]
    np.testing.assert_allclose(got, [0.0, 1.0, 4.0, 5.0, 6.0])
