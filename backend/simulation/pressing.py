"""A batch of presses: descent, detection on noisy samples, back-dating, ramp and hold.

The same law as on the stepped bench: the command falls at the approach speed until detection is
acted on at the next cycle boundary, then to the depth of the ramp counted from the back-dated
onset, never up. During the descent the time steps are those of the bench; afterwards they end at
the ticks (and where the command starts to move again): the press is quasi-static and monotone.
Times are relative to the instant at which the command reaches the height of first touch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from backend.config.method import SAMPLES_PER_PROBE, TICK_S, ProbeSettings
from backend.core.flow import FloatArray
from backend.core.onset import OnsetRule, back_date, detect, over_baseline
from backend.simulation.mechanics import ContactState, advance
from backend.simulation.timeline import Timeline, packed

AIR_MARGIN = 20
"""Samples in air beyond what the running baseline needs."""
FIRST_BLOCK, NEXT_BLOCK, LONGEST = 15, 5, 80
"""Cycles of descent solved before looking for contact, between looks, and at most."""


@dataclass(frozen=True, slots=True)
class Pressed:
    """B presses. ``onset_s`` (B,) back-dated; ``detected`` (B,): contact was found in time.

    ``touch_s`` (B,): when the faces really met; ``ticks_s`` (B, 20); ``air`` (B, 14): values before
    the descent; ``state``: at the end of the hold.
    """

    timeline: Timeline
    onset_s: FloatArray
    touch_s: FloatArray
    ticks_s: FloatArray
    detected: NDArray[np.bool_]
    air: FloatArray
    state: ContactState


@dataclass(frozen=True, slots=True)
class _Descent:
    """States at the ends of the cycles, in order; ``values`` of the same instants."""

    states: list[ContactState]
    values: list[FloatArray]
    t_s: list[FloatArray]


def air_samples(rule: OnsetRule) -> int:
    """Return the number of samples of the press-force noise before the first cycle."""
    return rule.lead + AIR_MARGIN


def noise_samples(rule: OnsetRule, cycle_s: float) -> int:
    """Return how many samples of press-force noise ``press`` may need."""
    return air_samples(rule) + LONGEST * round(cycle_s * rule.rate_hz)


def press(
    state: ContactState,
    phase_s: FloatArray,
    noise_n: FloatArray,
    probe: ProbeSettings,
    rule: OnsetRule,
    cycle_s: float,
) -> Pressed:
    """Press B probes.

    ``phase_s`` (B,) in [0, cycle): how long before first touch the last cycle boundary lies.
    ``noise_n`` (B, ``noise_samples``): errors of the press force on the sample grid.
    """
    speed = probe.approach_mm_s
    descent = _in_air(state, phase_s)
    slip_z = state.slip[:, :, 1].mean(axis=1)
    end = FIRST_BLOCK
    while True:
        _descend(descent, end, cycle_s, speed)
        force = _sampled_force(descent, noise_n, rule, cycle_s)
        over = over_baseline(force, rule)
        found = detect(over, rule)
        if (found >= 0).all() or end >= LONGEST:
            break
        end = min(end + NEXT_BLOCK, LONGEST)
    air = air_samples(rule)
    sample_s = np.arange(force.shape[1]) + 1.0 - air
    sample_t = sample_s / rule.rate_hz - phase_s[:, None]
    onset = back_date(sample_t, over, found, rule)
    detected = (found >= air) & np.isfinite(onset)
    onset = np.where(detected, onset, 0.0)
    per_cycle = round(cycle_s * rule.rate_hz)
    acted = np.clip(-(-(found - (air - 1)) // per_cycle), 1, len(descent.states) - 1)
    first = _first_stretch(descent, acted)
    ticks = onset[:, None] + TICK_S * np.arange(1, SAMPLES_PER_PROBE + 1)
    chosen = _state_at(descent.states, acted)
    later, chosen = _ramp(chosen, first.t_s[:, -1], onset, ticks, probe)
    return Pressed(
        timeline=first.followed_by(later),
        onset_s=onset,
        touch_s=np.maximum(slip_z, 0.0) / speed,
        ticks_s=ticks,
        detected=detected,
        air=descent.values[0],
        state=chosen,
    )


def _in_air(state: ContactState, phase_s: FloatArray) -> _Descent:
    command = np.zeros((len(phase_s), 3))
    command[:, 2] = 3.0
    settled, solved = advance(state, command, 1.5)
    return _Descent([settled], [packed(solved)], [-phase_s])


def _descend(descent: _Descent, cycles: int, cycle_s: float, speed_mm_s: float) -> None:
    """Solve further cycles of the descent, up to ``cycles`` in all."""
    while len(descent.states) <= cycles:
        t_s = descent.t_s[-1] + cycle_s
        command = np.zeros((len(t_s), 3))
        command[:, 2] = -speed_mm_s * t_s
        after, solved = advance(descent.states[-1], command, cycle_s)
        descent.states.append(after)
        descent.values.append(packed(solved))
        descent.t_s.append(t_s)


def _sampled_force(
    descent: _Descent, noise_n: FloatArray, rule: OnsetRule, cycle_s: float
) -> FloatArray:
    per_cycle = round(cycle_s * rule.rate_hz)
    at_ends = np.stack([values[:, 2] for values in descent.values], axis=1)
    share = np.arange(1, per_cycle + 1) / per_cycle
    rise = np.diff(at_ends, axis=1)[:, :, None] * share + at_ends[:, :-1, None]
    rise = rise.reshape(len(rise), -1)
    air = air_samples(rule)
    force = noise_n[:, : air + rise.shape[1]].copy()
    force[:, air:] += rise
    return force


def _first_stretch(descent: _Descent, acted: NDArray[np.intp]) -> Timeline:
    """Return the descent up to the cycle end ``acted`` of each probe, held there to the end."""
    index = np.minimum(np.arange(len(descent.states)), acted[:, None])
    rows = np.arange(len(acted))[:, None]
    t_s = np.stack(descent.t_s, axis=1)[rows, index]
    return Timeline(t_s, np.stack(descent.values, axis=1)[rows, index])


def _state_at(states: list[ContactState], acted: NDArray[np.intp]) -> ContactState:
    """Return for each probe its own state at the cycle end ``acted``."""
    rows = np.arange(len(acted))
    used = states[: int(acted.max()) + 1]
    anchors = np.stack([state.anchor for state in used])[acted, :, rows]
    return replace(
        states[0],
        q=np.stack([state.q for state in used])[acted, rows],
        slip=np.stack([state.slip for state in used])[acted, rows],
        anchor=np.ascontiguousarray(anchors.swapaxes(0, 1)),
        relaxed=np.stack([state.relaxed for state in used])[acted, rows],
        residual=np.stack([state.residual for state in used])[acted, rows],
    )


def _ramp(
    state: ContactState,
    start_s: FloatArray,
    onset_s: FloatArray,
    ticks_s: FloatArray,
    probe: ProbeSettings,
) -> tuple[Timeline, ContactState]:
    """Follow the ramp from ``start_s``; steps end at the ticks and where motion starts again."""
    speed, ramp_s = probe.approach_mm_s, probe.ramp_fraction * probe.duration_s
    reached = speed * start_s
    above = speed * onset_s
    resume = onset_s + (reached - above) / (probe.depth_mm / ramp_s)
    ends = np.concatenate([ticks_s, resume[:, None], onset_s[:, None] + ramp_s], axis=1)
    ends = np.sort(np.maximum(ends, start_s[:, None]), axis=1)
    times, values, now = [], [], start_s
    for end in ends.T:
        ramp = probe.depth_mm * np.minimum(1.0, (end - onset_s) / ramp_s)
        command = np.zeros((len(end), 3))
        command[:, 2] = -np.maximum(reached, above + ramp)
        state, solved = advance(state, command, end - now)
        times.append(end)
        values.append(packed(solved))
        now = end
    return Timeline(np.stack(times, axis=1), np.stack(values, axis=1)), state
