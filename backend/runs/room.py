"""A disk that fills up while a campaign goes on: it pauses before the next probe, then goes on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from backend.catalogue.diskspace import free_to_go_on
from backend.core.faults import Fault
from backend.runs.plan import Checkpoint, Plan

FULL = "DISK-FULL"
CONSEQUENCE = "The campaign is paused, the arm stands lifted; every probe so far is safe."
NEXT_STEP = "Make room on this disk, then resume (P)."


def room_awaited(folder: Path) -> Plan[None]:
    """Pause, as often as it is resumed, until there is room for more episodes in ``folder``."""
    while (short_bytes := free_to_go_on(folder)) is not None:
        what = f"Only {short_bytes / 1e9:.2f} GB are free on the disk of the dataset."
        yield Checkpoint(Fault(FULL, what, CONSEQUENCE, NEXT_STEP))


def refused_episode(fault: Fault) -> Fault:
    """Return what to say of a probe that is still held in memory, since the disk refused it."""
    return replace(fault, consequence=f"{CONSEQUENCE} The last one is kept in memory.",
                   next_step=NEXT_STEP)  # fmt: skip
