"""A batch of presses: descent, detection on noisy samples, back-dating, ramp and hold.

The same law as on the stepped bench: the command falls at the approach speed until the cycle after
detection, then follows the ramp from the back-dated onset, and never rises. During the descent the
time steps are those of the bench; afterwards they end at the ticks and at the corners of the ramp,
since the press is quasi-static and monotone. Time zero is less than one cycle before the true first
touch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.config import SAMPLES_PER_PROBE, TICK_S, ProbeSettings
from touchdown.backend.core import (
    FloatArray,
    OnsetRule,
    back_date_onset,
    detect_contact,
    force_over_baseline,
)
from touchdown.backend.simulation.contact import surface_motion
from touchdown.backend.simulation.mechanics import ContactState, ProbeEquilibrium, advance_probes
from touchdown.backend.simulation.supports import SupportMotion

TIMELINE_VALUES = 14


@dataclass(frozen=True, slots=True)
class Timeline:
    """``t_s`` (B, M), ascending; ``values`` (B, M, 14): wrench at ``G``, strain, pad forces."""

    t_s: FloatArray
    values: FloatArray

    def at(self, t_s: FloatArray) -> FloatArray:
        """Return (B, Q, 14) at the times (B, Q); constant before the first and after the last."""
        last = self.t_s.shape[1] - 1
        after = (self.t_s[:, None, :] <= t_s[:, :, None]).sum(axis=-1)
        right = np.clip(after, 0, last)
        left = np.clip(after - 1, 0, last)
        rows = np.arange(len(t_s))[:, None]
        t_left = self.t_s[rows, left]
        gap = self.t_s[rows, right] - t_left
        share = np.where(gap > 0.0, (t_s - t_left) / np.where(gap > 0.0, gap, 1.0), 0.0)
        low = self.values[rows, left]
        high = self.values[rows, right]
        return np.asarray(low + share[..., None] * (high - low), dtype=np.float64)

    def followed_by(self, later: Self) -> Timeline:
        """Return both timelines in sequence."""
        return Timeline(
            np.concatenate([self.t_s, later.t_s], axis=1),
            np.concatenate([self.values, later.values], axis=1),
        )


def pack_equilibrium(solved: ProbeEquilibrium) -> FloatArray:
    """Return (B, 14) of one equilibrium."""
    flat = solved.strain.reshape(len(solved.strain), 6)
    return np.concatenate([solved.wrench_g, flat, solved.normal_n], axis=1)


AIR_MARGIN = 20  # air samples beyond those of the running baseline
AIR_MM, AIR_S = 3.0, 1.5  # height and time in air before the descent; a slipped gel settles there
# Cycles of descent before the first contact check, between checks, and at most.
FIRST_BLOCK, NEXT_BLOCK, MAX_CYCLES = 15, 3, 60


@dataclass(frozen=True, slots=True)
class PressCourse:
    """Course of B presses. ``ticks_s`` (B, 20): instants of the model input; ``air`` (B, 14):
    values before the descent. ``travel_mm`` (B, 20): travel of the arm at the ticks as it measures
    it, downwards from the onset.
    """

    timeline: Timeline
    ticks_s: FloatArray
    air: FloatArray
    travel_mm: FloatArray


@dataclass(frozen=True, slots=True)
class PressBatch(PressCourse):
    """B presses. ``onset_s`` (B,) back-dated; ``detected`` (B,): contact was found in time.

    ``touch_s`` (B,): true first touch; ``state``: at the end of the hold.
    """

    onset_s: FloatArray
    touch_s: FloatArray
    detected: NDArray[np.bool_]
    state: ContactState


@dataclass(frozen=True, slots=True)
class _Descent:
    """States at the ends of the cycles, in order; ``values`` of the same instants.

    ``touch_s`` (B,): first touch. ``lead_mm`` (B,): commanded depth at time 0: a piece that has
    slipped upwards in the hand touches later.
    """

    states: list[ContactState]
    values: list[FloatArray]
    t_s: list[FloatArray]
    touch_s: FloatArray
    lead_mm: FloatArray


def air_samples(rule: OnsetRule) -> int:
    """Return the number of samples of the press-force noise before the first cycle."""
    return rule.lead + AIR_MARGIN


def noise_samples(rule: OnsetRule, cycle_s: float) -> int:
    """Return the largest number of press-force noise samples that ``press_batch`` needs."""
    return air_samples(rule) + MAX_CYCLES * round(cycle_s * rule.rate_hz)


def press_batch(
    state: ContactState,
    phase_s: FloatArray,
    noise_n: FloatArray,
    probe: ProbeSettings,
    rule: OnsetRule,
    cycle_s: float,
) -> PressBatch:
    """Press B probes.

    ``phase_s`` (B,) in [0, cycle): phase of the cycle boundaries relative to the contact.
    ``noise_n`` (B, ``noise_samples``): errors of the press force on the sample grid.
    """
    speed = probe.approach_mm_s
    descent = _start_descent(state, phase_s, cycle_s, speed)
    end = FIRST_BLOCK
    while True:
        _descend(descent, end, cycle_s, speed)
        force = _sampled_force(descent, noise_n, rule, cycle_s)
        over = force_over_baseline(force, rule)
        found = detect_contact(over, rule)
        if ((found >= 0) | (state.cells.count == 0)).all() or end >= MAX_CYCLES:
            break
        end = min(end + NEXT_BLOCK, MAX_CYCLES)
    air = air_samples(rule)
    sample_s = np.arange(force.shape[1]) + 1.0 - air
    sample_t = sample_s / rule.rate_hz - phase_s[:, None]
    onset = back_date_onset(sample_t, over, found, rule)
    detected = (found >= air) & np.isfinite(onset)
    onset = np.where(detected, onset, 0.0)
    per_cycle = round(cycle_s * rule.rate_hz)
    acted = np.clip(-(-(found - (air - 1)) // per_cycle), 1, len(descent.states) - 1)
    # The descent up to the cycle end ``acted`` of each probe, held there to the end.
    index = np.minimum(np.arange(len(descent.states)), acted[:, None])
    rows = np.arange(len(acted))[:, None]
    first = Timeline(
        np.stack(descent.t_s, axis=1)[rows, index], np.stack(descent.values, axis=1)[rows, index]
    )
    ticks = onset[:, None] + TICK_S * np.arange(1, SAMPLES_PER_PROBE + 1)
    chosen = _state_at(descent.states, acted)
    command = _Ramp(probe, onset, first.t_s[:, -1], descent.lead_mm)
    later, chosen = _follow_ramp(chosen, command, ticks)
    timeline = first.followed_by(later)
    return PressBatch(
        timeline=timeline,
        travel_mm=_measured_travel_mm(timeline, command, ticks, state.conditions.robot_n_mm),
        onset_s=onset,
        touch_s=descent.touch_s,
        ticks_s=ticks,
        detected=detected,
        air=descent.values[0],
        state=chosen,
    )


def _start_descent(
    state: ContactState, phase_s: FloatArray, cycle_s: float, speed_mm_s: float
) -> _Descent:
    command = np.zeros((len(phase_s), 3))
    command[:, 2] = AIR_MM
    settled, solved = advance_probes(state, command, AIR_S)
    _, _, u_z = surface_motion(state.cells, settled.q)
    gap = np.where(state.cells.normal > 0.0, u_z - state.cells.gap_mm, np.inf).min(axis=1)
    touch_s = (np.where(np.isfinite(gap), gap, AIR_MM) - AIR_MM) / speed_mm_s
    start_s = cycle_s * np.floor(touch_s / cycle_s + 1e-9)
    return _Descent(
        [settled], [pack_equilibrium(solved)], [-phase_s], touch_s - start_s, speed_mm_s * start_s
    )


def _descend(descent: _Descent, cycles: int, cycle_s: float, speed_mm_s: float) -> None:
    """Solve further cycles of the descent, up to ``cycles`` in all."""
    while len(descent.states) <= cycles:
        t_s = descent.t_s[-1] + cycle_s
        command = np.zeros((len(t_s), 3))
        command[:, 2] = -descent.lead_mm - speed_mm_s * t_s
        after, solved = advance_probes(descent.states[-1], command, cycle_s)
        descent.states.append(after)
        descent.values.append(pack_equilibrium(solved))
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


def _state_at(states: list[ContactState], acted: NDArray[np.intp]) -> ContactState:
    rows = np.arange(len(acted))
    used = states[: int(acted.max()) + 1]
    anchors = np.stack([state.anchor for state in used])[acted, :, rows]

    def own(name: str) -> FloatArray:
        return np.stack(list(map(attrgetter(name), used)))[acted, rows]

    pose = SupportMotion(own("pose.rock_rad"), own("pose.slide_mm"))
    names = ("q", "slip", "relaxed", "residual", "depth_mm", "slope", "toppled")
    anchor = np.ascontiguousarray(anchors.swapaxes(0, 1))
    changed: dict[str, Any] = {name: own(name) for name in names}
    return replace(states[0], anchor=anchor, pose=pose, **changed)


@dataclass(frozen=True, slots=True)
class _Ramp:
    """The command after detection: hold, then the ramp from the onset."""

    probe: ProbeSettings
    onset_s: FloatArray
    start_s: FloatArray
    lead_mm: FloatArray

    @property
    def length_s(self) -> float:
        return self.probe.ramp_fraction * self.probe.duration_s

    @property
    def reached_mm(self) -> FloatArray:
        """(B,) depth below the onset at which the descent was stopped."""
        travelled = self.start_s - self.onset_s
        return np.asarray(self.probe.approach_mm_s * travelled, dtype=np.float64)

    def corners_s(self) -> FloatArray:
        """Return (B, 2): times at which the command moves again and at which it ends."""
        again = self.reached_mm * self.length_s / self.probe.depth_mm
        return self.onset_s[:, None] + np.stack([again, np.full_like(again, self.length_s)], axis=1)

    def command_mm(self, t_s: FloatArray) -> FloatArray:
        """Return (B, 3) at the times ``t_s`` (B,)."""
        along = np.minimum(1.0, (t_s - self.onset_s) / self.length_s)
        depth = np.maximum(self.reached_mm, self.probe.depth_mm * along)
        command = np.zeros((len(t_s), 3))
        command[:, 2] = -(self.lead_mm + self.probe.approach_mm_s * self.onset_s + depth)
        return command


def _measured_travel_mm(
    timeline: Timeline, ramp: _Ramp, ticks_s: FloatArray, robot_n_mm: FloatArray
) -> FloatArray:
    """Return (B, 20) travel of the compliant arm under the contact force."""
    t_s = np.concatenate([ramp.onset_s[:, None], ticks_s], axis=1)
    command_mm = np.stack([ramp.command_mm(at)[:, 2] for at in t_s.T], axis=1)
    # At the onset the arm is still in its descent.
    command_mm[:, 0] = -(ramp.lead_mm + ramp.probe.approach_mm_s * ramp.onset_s)
    height_mm = command_mm + timeline.at(t_s)[:, :, 2] / robot_n_mm[:, 2:]
    return np.asarray(height_mm[:, :1] - height_mm[:, 1:])


def _follow_ramp(
    state: ContactState, ramp: _Ramp, ticks_s: FloatArray
) -> tuple[Timeline, ContactState]:
    """Follow the ramp; time steps end at the ticks and at its corners."""
    ends = np.concatenate([ticks_s, ramp.corners_s()], axis=1)
    ends = np.sort(np.maximum(ends, ramp.start_s[:, None]), axis=1)
    times, values, now = [], [], ramp.start_s
    for end in ends.T:
        state, solved = advance_probes(state, ramp.command_mm(end), end - now)
        times.append(end)
        values.append(pack_equilibrium(solved))
        now = end
    return Timeline(np.stack(times, axis=1), np.stack(values, axis=1)), state
