"""Trials in the second world, in place of those of ``simulation.lockstep``.

Draws of mountings, grippings, probes and sensors are those of the bench with the same scenes; what
is felt differs. Presses are solved one after the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from backend.config.method import ProbeSettings
from backend.core.flow import FloatArray
from backend.simulation.conditions import true_offset_mm
from backend.simulation.elsewhere.aftermath import aftermath
from backend.simulation.elsewhere.descent import CLEAR_MM, Descended, Press
from backend.simulation.elsewhere.kernel import build_half_space_gel
from backend.simulation.elsewhere.mount import mount
from backend.simulation.elsewhere.pads import Pads
from backend.simulation.episodes import Eye, draw_noise, observe
from backend.simulation.lockstep import Lockstep, Presses
from backend.simulation.mechanics import Carried
from backend.simulation.scene import Scene
from backend.simulation.timeline import Timeline


@dataclass(frozen=True, slots=True)
class _Felt:
    """Presses side by side, as ``episodes.observe`` reads them."""

    timeline: Timeline
    ticks_s: FloatArray
    air: FloatArray


class Elsewhere(Lockstep):
    """The second world behind the interface of the bench."""

    def __init__(self, scenes: Sequence[Scene], probe: ProbeSettings | None = None) -> None:
        super().__init__(scenes, probe)
        tactile = self._first.settings.tactile
        self._eye = Eye(build_half_space_gel(tactile.mm_per_px, tactile.pitch_mm, tactile.dilation))

    def press(self, trials: Sequence[int], commands_mm: FloatArray) -> Presses:
        """Press the pieces of the named ``trials`` at ``commands_mm`` (k, 2); slip stays."""
        rows = np.asarray(trials, dtype=np.intp)
        settings, first = self._first.settings, self._first
        conditions = self._conditions(rows)
        before = self._carried.take(rows).slip
        true = true_offset_mm(commands_mm, conditions, before) - self._slid_mm[rows]
        noise = [draw_noise(settings, self._rule, self._sensor_rng(i)) for i in rows.tolist()]
        pressed: list[Descended] = []
        slip, toppled = before.copy(), np.zeros(len(rows), dtype=np.bool_)
        reach_mm = float(np.hypot(*first.surface.half_extents_mm))
        for k, trial in enumerate(rows.tolist()):
            own = conditions.take(np.array([k]))
            mounted = mount(first.piece, self.bottoms[trial], own, true[k], settings.support)
            pads = Pads(own, before[k])
            high_mm = CLEAR_MM + float(np.hypot(*own.tilt_rad[0])) * reach_mm
            high_mm += self._probe.approach_mm_s * noise[k].phase_s
            press = Press(mounted, pads, own, self._probe)
            pressed.append(
                press.run(high_mm, noise[k].force_n, self._rule, 1e-6 * settings.cycle_us)
            )
            slip[k] = pads.slip
            slide_mm, toppled[k] = aftermath(mounted, self.bottoms[trial])
            self._slide(rows[k : k + 1], slide_mm[None])
        self._carried = self._carried.replaced(rows, Carried(slip, np.zeros((len(rows), 2, 4))))
        moved = slip[:, :, :2] - before[:, :, :2]
        return Presses(
            observation=observe(_side_by_side(pressed), conditions, settings, noise, self._eye),
            true_mm=true_offset_mm(commands_mm, conditions, slip) - self._slid_mm[rows],
            valid=_valid(pressed, toppled),
            press_n=np.array([p.press_n for p in pressed]),
            slip_mm=np.asarray(np.hypot(moved[..., 0], moved[..., 1]).max(axis=1)),
            toppled=toppled,
        )


def _valid(pressed: list[Descended], toppled: NDArray[np.bool_]) -> NDArray[np.bool_]:
    found = [bool(np.isfinite(p.onset_s)) and p.settled for p in pressed]
    return np.array(found, dtype=np.bool_) & ~toppled


def _side_by_side(pressed: list[Descended]) -> _Felt:
    """Join presses; the shorter ones stay as they ended."""
    longest = max(len(p.t_s) for p in pressed)
    index = [np.minimum(np.arange(longest), len(p.t_s) - 1) for p in pressed]
    return _Felt(
        Timeline(
            np.stack([p.t_s[i] for p, i in zip(pressed, index, strict=True)]),
            np.stack([p.values[i] for p, i in zip(pressed, index, strict=True)]),
        ),
        np.stack([p.ticks_s for p in pressed]),
        np.stack([p.air for p in pressed]),
    )
