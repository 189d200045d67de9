"""One press of the second world: descent, detection on noisy samples, ramp and hold.

The law of the command is that of the bench: down at the approach speed until contact is declared at
a cycle boundary, then to the depth of the ramp counted from the back-dated onset, never up.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from backend.config.method import SAMPLES_PER_PROBE, TICK_S, ProbeSettings
from backend.core.flow import FloatArray
from backend.core.onset import OnsetRule, back_date, detect, over_baseline
from backend.simulation.conditions import Conditions
from backend.simulation.elsewhere.mount import HAND, HELD, STEP_S, Mount, pad_stiffness
from backend.simulation.elsewhere.pads import Pads
from backend.simulation.pressing import LONGEST, air_samples

CLEAR_MM = 0.1
"""Height of the face over the highest place it may touch, at the start."""
BALANCE_N, BALANCE_NMM = 0.1, 2.0
"""Contact and springs may differ by this at the end; otherwise the press has not settled."""
HAND_Z = HAND.start + 2


@dataclass(frozen=True, slots=True)
class Descended:
    """``t_s`` (M,) from about first touch; ``values`` (M, 14) as in a timeline; ``air`` (14,).

    ``onset_s``: back-dated, NaN where no contact was declared. ``settled``: contact and springs
    balance at the end. ``press_n`` at the end.
    """

    t_s: FloatArray
    values: FloatArray
    air: FloatArray
    onset_s: float
    settled: bool

    @property
    def ticks_s(self) -> FloatArray:
        """(20,) instants of the model's input."""
        onset = self.onset_s if np.isfinite(self.onset_s) else 0.0
        return np.asarray(onset + TICK_S * np.arange(1, SAMPLES_PER_PROBE + 1))

    @property
    def press_n(self) -> float:
        """Press force at the end."""
        return float(self.values[-1, 2])


class Press:
    """A mounted piece on its way down."""

    def __init__(
        self, mounted: Mount, pads: Pads, conditions: Conditions, probe: ProbeSettings
    ) -> None:
        self._mount, self._pads, self._probe = mounted, pads, probe
        self._stiffness = pad_stiffness(conditions)
        self._values: list[FloatArray] = []
        self._force_n: list[float] = []

    def run(
        self, high_mm: float, noise_n: FloatArray, rule: OnsetRule, cycle_s: float
    ) -> Descended:
        """Press from ``high_mm`` over the centre of the support.

        ``noise_n``: errors of the press force on the sample grid, as for ``pressing.press``.
        """
        rest = self._pads.rest()
        data, held_z = self._mount.data, float(rest[2])
        data.qpos[HELD] = rest * np.array([1e-3] * 3 + [1.0] * 3)
        start_mm = high_mm - held_z
        data.qpos[HAND_Z] = 1e-3 * start_mm
        air = self._now()
        speed = self._probe.approach_mm_s
        onset_s, acted = float("nan"), 0
        for cycle in range(LONGEST):
            high = start_mm - speed * cycle * cycle_s
            self._cycle(high, high - speed * cycle_s, cycle_s)
            found = self._onset(noise_n, rule, cycle_s)
            if found is not None:
                onset_s, acted = found, cycle + 1
                break
        if not acted:
            return self._ended(air, onset_s, cycle_s)
        stopped_s = acted * cycle_s
        cycles = int(np.ceil((onset_s + self._probe.duration_s - stopped_s) / cycle_s)) + 1
        times = stopped_s + cycle_s * np.arange(cycles + 1)
        commands = [
            start_mm - speed * onset_s - self._depth_mm(onset_s, stopped_s, t)
            for t in times.tolist()
        ]
        for command, following in pairwise(commands):
            self._cycle(command, following, cycle_s)
        return self._ended(air, onset_s, cycle_s)

    def _depth_mm(self, onset_s: float, stopped_s: float, t_s: float) -> float:
        """Return the commanded depth below the onset at a time after the descent was stopped."""
        probe = self._probe
        reached = probe.approach_mm_s * (stopped_s - onset_s)
        along = min(1.0, (t_s - onset_s) / (probe.ramp_fraction * probe.duration_s))
        return max(reached, probe.depth_mm * along)

    def _cycle(self, from_mm: float, to_mm: float, cycle_s: float) -> None:
        """Move the command for one cycle, then let the pads follow."""
        model, data, pads = self._mount.model, self._mount.data, self._pads
        steps = round(cycle_s / STEP_S)
        for command_mm in np.linspace(from_mm, to_mm, steps + 1)[1:].tolist():
            model.qpos_spring[HAND_Z] = 1e-3 * command_mm
            self._mount.engine.mj_step(model, data)
            self._force_n.append(float(data.qfrc_constraint[HELD.start + 2]))
        pads.follow(self._mount.held(), cycle_s)
        model.qpos_spring[HELD] = pads.rest() * np.array([1e-3] * 3 + [1.0] * 3)
        harder = np.array([pads.hardening, 1.0, *[pads.hardening] * 4])
        model.jnt_stiffness[HELD] = self._stiffness * harder
        self._values.append(self._now())

    def _now(self) -> FloatArray:
        return np.concatenate(
            [self._mount.wrench_g(), self._pads.seen.ravel(), self._pads.normal_n]
        )

    def _onset(self, noise_n: FloatArray, rule: OnsetRule, cycle_s: float) -> float | None:
        """Return the back-dated onset since the start, once contact is declared."""
        lead = air_samples(rule)
        steps = STEP_S * (np.arange(len(self._force_n)) + 1.0)
        sample_s = (np.arange(round(steps[-1] * rule.rate_hz)) + 1.0) / rule.rate_hz
        force = noise_n[: lead + len(sample_s)].copy()
        force[lead:] += np.interp(sample_s, steps, self._force_n)
        over = over_baseline(force[None], rule)
        found = detect(over, rule)
        if found[0] < lead:
            return None
        t_s = np.asarray((np.arange(len(force)) + 1.0 - lead) / rule.rate_hz, dtype=np.float64)
        onset = float(back_date(t_s, over, found, rule)[0])
        return onset if np.isfinite(onset) else None

    def _ended(self, air: FloatArray, onset_s: float, cycle_s: float) -> Descended:
        touched = np.flatnonzero(np.array(self._force_n) > 0.0)
        first_s = STEP_S * float(touched[0]) if len(touched) else 0.0
        zero_s = cycle_s * np.floor(first_s / cycle_s)
        t_s = cycle_s * np.arange(1, len(self._values) + 1) - zero_s
        return Descended(t_s, np.array(self._values), air, onset_s - zero_s, self._settled())

    def _settled(self) -> bool:
        """Whether contact and springs of the piece balance, the engine's forces against ours."""
        model, data = self._mount.model, self._mount.data
        spring = model.jnt_stiffness[HELD] * (data.qpos[HELD] - model.qpos_spring[HELD])
        spring[3:] *= 1e3
        left = np.abs(self._mount.wrench_g() - spring)
        return bool((left[:3] < BALANCE_N).all() and (left[3:] < BALANCE_NMM).all())
