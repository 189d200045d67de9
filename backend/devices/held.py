"""By what right the jaws open on a held piece, and which grippers want to know it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from backend.devices.interlock import ReleaseEvidence
from backend.devices.protocols import Motion
from backend.devices.putting_back import JigEvidence


@dataclass(frozen=True, slots=True)
class ByHand:
    """The operator's own order, confirmed by them."""

    confirmed: bool


Right = ReleaseEvidence | JigEvidence | ByHand


@runtime_checkable
class OpensByRight(Protocol):
    """A gripper that looks at its own sensors before it opens on a held piece."""

    def open_held(self, right: Right, width_mm: float, speed_mm_s: float) -> Motion:
        """Open to ``width_mm`` if ``right`` and what is measured now allow it; ``RefusedError``."""
