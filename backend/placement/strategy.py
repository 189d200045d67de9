"""A strategy: from the estimate of a probe to belief, verdict and next move, chosen by name.

The run on devices, the batch of trials and the window know strategies through this door alone. A
``Reasoner`` keeps what one trial believes; it never sees the bottom, only what was felt.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from backend.config.method import StackSettings
from backend.core.faults import InputError
from backend.core.flow import BeliefMap, ContactPatch, PlaceAction, Stability
from backend.placement.belief import Belief
from backend.placement.below import Below
from backend.placement.policy import choose
from backend.placement.stability import judge

XY = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Held:
    """What a strategy knows of the grasped piece before the first probe.

    ``com_xy_mm``: centre of mass in ``F``; ``grip_height_mm``: pivot above the face;
    ``base_rate``: share of contact in the training data of the model, None without a model.
    ``sensor_height_mm``: wrist sensor above the pivot, as the bench tells; None if it does not.
    ``below``: the tower under the touched surface as entered, None if nobody told of one.
    """

    com_xy_mm: XY
    grip_height_mm: float
    base_rate: float | None = None
    sensor_height_mm: float | None = None
    below: Below | None = None

    def lever_mm(self) -> float:
        """Return the height of the sensor above the face; raises ``InputError`` if nobody told."""
        if self.sensor_height_mm is None:
            raise InputError(
                "This strategy needs the height of the wrist sensor above the grasp pivot.",
                "mounting.sensor_height_mm",
                "Tell it in the lab file, or choose another strategy.",
            )
        return self.grip_height_mm + self.sensor_height_mm


@dataclass(frozen=True, slots=True)
class Touched:
    """One probe: ``observation`` (20, 258) as the model saw it, the ``patch`` that it estimated,
    and the commanded ``offset_mm`` of the face (frame of the map).
    """

    observation: NDArray[np.float32]
    patch: ContactPatch
    offset_mm: XY


@dataclass(frozen=True, slots=True)
class Conclusion:
    """What follows from all probes so far: the ``map`` as believed, the verdict here, the move."""

    map: BeliefMap
    stability: Stability
    action: PlaceAction


class Reasoner(Protocol):
    """The memory of one trial."""

    def conclude(self, touched: Touched) -> Conclusion:
        """Take the next probe; return what follows."""

    def stable_at(self, offset_mm: XY) -> bool:
        """Whether all probes so far would have it released with the face at ``offset_mm``."""

    def likely_at(self, offset_mm: XY) -> bool:
        """Whether it would there rather stand than fall, whatever risk a release may take."""


@runtime_checkable
class SeekingReasoner(Reasoner, Protocol):
    """The memory of one trial by a strategy to which a place without contact is no end."""

    def missed(self, offset_mm: XY) -> PlaceAction:
        """Take note that no contact was found at ``offset_mm``; return the shift, or the end."""


class PaperReasoner:
    """Ota et al.: independent cells, hull of the confident ones, step towards its middle."""

    def __init__(self, held: Held, settings: StackSettings, origin_mm: XY) -> None:
        self._held, self._settings = held, settings
        self._belief = Belief.unknown(settings.belief, origin_mm, held.base_rate)
        self._patch: ContactPatch | None = None

    def conclude(self, touched: Touched) -> Conclusion:
        """Fuse, judge, choose."""
        settings, here = self._settings, touched.offset_mm
        self._belief, self._patch = self._belief.updated(touched.patch, here), touched.patch
        stability = judge(
            self._belief, touched.patch, self._held.com_xy_mm, here, settings.stability
        )
        action = choose(stability, self._belief, here, settings.policy, settings.stability)
        return Conclusion(self._belief.map, stability, action)

    def stable_at(self, offset_mm: XY) -> bool:
        """Judge the map there; with ``judge_from`` "patch" the latest patch, as if felt there."""
        if self._patch is None:
            return False
        com, rules = self._held.com_xy_mm, self._settings.stability
        return judge(self._belief, self._patch, com, offset_mm, rules).stable

    def likely_at(self, offset_mm: XY) -> bool:
        """Judge alike: it tells stable from not stable in one way only."""
        return self.stable_at(offset_mm)
