"""When the rig opens the jaws on a held piece: evidence it is given, and its own sensors again.

Every row is a positive comparison, so that NaN and what is missing refuse, each by its own name.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from backend.core.faults import RefusedError
from backend.devices.held import ByHand, Right
from backend.devices.interlock import (
    MAX_WIDTH_CHANGE_MM,
    STATIONARY_MM,
    UNLOADED_N,
    ReleaseEvidence,
    release_refusal,
)
from backend.devices.putting_back import jig_refusal

OLD_S = 0.05
"""A wrench older than this is no evidence."""


@dataclass(frozen=True, slots=True)
class Measured:
    """What the rig itself measures: NaN where it does not know.

    ``press_n``: by the contact law's own zero; ``moved_mm``: largest travel of the arm as it
    stands (``travelled_mm``); ``width_change_mm`` since the piece was gripped; ``devices_ready``:
    all of them.
    """

    press_n: float
    wrench_age_s: float
    moved_mm: float
    width_change_mm: float
    holding: bool
    devices_ready: bool


def refuse_opening(right: Right, measured: Measured) -> None:
    """Raise ``RefusedError`` with the name of the first condition that does not hold."""
    refusal = next(_rows(right, measured), None)
    if refusal is not None:
        raise RefusedError(*refusal)


def _rows(right: Right, m: Measured) -> Iterator[tuple[str, str]]:
    if isinstance(right, ByHand):
        if not right.confirmed:
            yield "NOT-CONFIRMED", "A piece is held: opening drops it. Confirm first."
    else:
        release = isinstance(right, ReleaseEvidence)
        told = release_refusal(right) if release else jig_refusal(right)  # type: ignore[arg-type]
        if told is not None:
            yield told
        yield from _ready_rows(m)
    if not 0 <= m.moved_mm <= STATIONARY_MM:
        yield "RIG-ARM-MOVING", "The rig measures that the arm is not standing still."
    if isinstance(right, ReleaseEvidence):
        yield from _pressed_rows(m)


def _ready_rows(m: Measured) -> Iterator[tuple[str, str]]:
    if not m.devices_ready:
        yield "RIG-DEVICES", "Arm, wrist sensor and gripper are not all ready."
    if not m.holding:
        yield "RIG-NOT-HOLDING", "The gripper tells that it holds no piece."
    if not abs(m.width_change_mm) <= MAX_WIDTH_CHANGE_MM:
        change_mm = m.width_change_mm
        yield "RIG-WIDTH", f"The jaws moved by {change_mm:.2f} mm since the piece was gripped."


def _pressed_rows(m: Measured) -> Iterator[tuple[str, str]]:
    if not 0 <= m.wrench_age_s <= OLD_S:
        yield "RIG-WRENCH-OLD", "The rig has no fresh wrench."
    if not UNLOADED_N[0] <= m.press_n <= UNLOADED_N[1]:
        yield (
            "RIG-NOT-UNLOADED",
            f"The rig feels {m.press_n:.2f} N: not {UNLOADED_N[0]} to {UNLOADED_N[1]} N.",
        )
