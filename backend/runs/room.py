"""A disk that fills up during a run: it pauses before the next probe, then goes on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from backend.catalogue.diskspace import NO_ROOM, free_to_go_on
from backend.core.doing import DISK_S, doing
from backend.core.facts import Decision
from backend.core.faults import Fault, FaultError
from backend.runs.bench import Bench
from backend.runs.plan import CancelledError, Checkpoint, Plan, StoppedError, Waiting

FULL = "DISK-FULL"
CONSEQUENCE = "The run is paused, the arm stands lifted; every probe so far is safe."
NEXT_STEP = "Make room on this disk, then resume (P)."
WRITE_S = 60.0
"""An episode is on its way to the disk for so long at most."""


def room_awaited(obstacle: Callable[[], Fault | None]) -> Plan[None]:
    """Pause, as often as it is resumed, until nothing keeps the run from recording any more."""
    while (fault := obstacle()) is not None:
        yield Checkpoint(fault)


def no_room(folder: Path) -> Fault | None:
    """Return what to say where too little is free to record another episode, else None."""
    short_bytes = free_to_go_on(folder)
    if short_bytes is None:
        return None
    what = f"Only {short_bytes / 1e9:.2f} GB are free on the disk of {folder}."
    return Fault(FULL, what, CONSEQUENCE, NEXT_STEP)


def refused_episode(fault: Fault) -> Fault:
    """Return what to say of a probe that is still held in memory, since the disk refused it."""
    return replace(fault, consequence=f"{CONSEQUENCE} The last one is kept in memory.",
                   next_step=NEXT_STEP)  # fmt: skip


def saved(save: Callable[[], None]) -> Plan[bool]:
    """Save something small, and return True; a full disk pauses the run until it is saved.

    Raises ``FaultError`` or ``OSError`` where the disk refuses for another reason.
    """
    while True:
        try:
            with doing("waits for the disk", DISK_S):
                save()
        except FaultError as error:
            if error.fault.code != FULL:
                raise
            fault = error.fault
        except OSError as error:
            if error.errno not in NO_ROOM:
                raise
            fault = Fault(FULL, "The disk is full.", "", "")
        else:
            return True
        yield Checkpoint(replace(fault, consequence=CONSEQUENCE, next_step=NEXT_STEP))


def no_plan_saved(folder: Path) -> Fault:
    """Return what to say where a campaign that ended could not write down what it left out."""
    return Fault(
        FULL,
        f"The disk of {folder} is full: the plan of the campaign could not be saved.",
        "Every probe and decision is safe; places given up after three refused probes are tried "
        "again when it goes on.",
        "Make room on this disk, then press Reset.",
        "store",
    )


def not_decided(folder: Path, decision: Decision, item: int) -> Fault:
    """Return what to say where a run ended and its last decision could not be saved."""
    return Fault(
        FULL,
        f"The disk of {folder} is full: '{decision}' for item {item + 1} could not be saved.",
        "The probe stays in the dataset as it was.",
        "Make room on this disk, press Reset, choose the probe and decide again.",
        "store",
    )


def writing(bench: Bench, written: Callable[[], bool]) -> Plan[None]:
    """Where time passes by itself, let the sensors be read until ``written()``.

    A slow disk would leave the newest wrench so old that no motion sideways may begin. A bench
    that is stepped does not wait by its own clock: no number may depend on the disk.
    """
    if bench.real_time and not written():
        yield Waiting(written, WRITE_S, "the episode to be on the disk")


def durable(bench: Bench) -> Plan[Path | None]:
    """Return the file of the last episode; a full disk pauses the run until it is there.

    Raises ``FaultError`` where the disk refused for another reason, and where the run ends while
    it waits: what was held is then lost.
    """
    store = bench.store
    while True:
        yield from writing(bench, lambda: store.written)
        try:
            return store.settle()
        except FaultError as error:
            if error.fault.code != FULL:
                raise
            refused = error
        try:
            yield Checkpoint(refused_episode(refused.fault))
        except (CancelledError, StoppedError):
            raise refused from None
