"""How a plan on a bench ends when it is cancelled, stopped, refused or meets a fault."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, Literal, TypeVar

from backend.core.facts import FaultRaised, Said
from backend.core.faults import FaultError, RefusedError, StaleSampleError
from backend.runs.bench import Bench
from backend.runs.motions import lift
from backend.runs.plan import CancelledError, Plan, StoppedError, stopped_words
from backend.runs.stale import stale_fault

RunEnding = Literal["finished", "cancelled", "stopped", "failed"]
R = TypeVar("R")


@dataclass(frozen=True, slots=True)
class Ended(Generic[R]):
    """``value`` of a plan that came to its end, else None and the ``reason``.

    ``run_ending``: how the whole run ends with it, None where the run may go on.
    """

    value: R | None
    run_ending: RunEnding | None = None
    reason: str = ""


def orderly(bench: Bench, plan: Plan[R]) -> Plan[Ended[R]]:
    """Drive ``plan``; lift off after a cancel or a refusal, never move after a stop or a fault."""
    try:
        value = yield from plan
    except CancelledError as cause:
        yield from _retreat(bench)
        return Ended(None, "cancelled", str(cause))
    except StoppedError as cause:
        return Ended(None, "stopped", str(cause))
    except RefusedError as cause:
        faults = bench.interlock.faults
        if faults:
            # The order met the latch of a fault that nobody has told this run yet.
            yield FaultRaised(bench.now_s(), faults[0])
            return Ended(None, "failed", str(FaultError(faults[0])))
        if bench.interlock.latched:
            return Ended(None, "stopped", _stopped(bench))
        yield Said(bench.now_s(), f"Refused: {cause}")
        yield from _retreat(bench)
        return Ended(None, None, str(cause))
    except (FaultError, StaleSampleError) as cause:
        if bench.interlock.stopped_by and not bench.interlock.faults:
            # The motion was interrupted by STOP: that is no fault of a device.
            return Ended(None, "stopped", _stopped(bench))
        # A fault that stopped the arm comes back as an interrupted motion: name the first cause.
        faults = bench.interlock.faults
        found = stale_fault(cause) if isinstance(cause, StaleSampleError) else cause.fault
        first = FaultError(faults[0] if faults else found)
        bench.interlock.raise_fault(first.fault)
        yield FaultRaised(bench.now_s(), first.fault)
        return Ended(None, "failed", str(first))
    return Ended(value)


def _stopped(bench: Bench) -> str:
    return stopped_words(bench.interlock.stopped_by)


def _retreat(bench: Bench) -> Plan[None]:
    """Lift straight off if the bench may still move; the piece stays in the gripper."""
    if bench.gripper.status().holding and not bench.interlock.latched:
        yield from lift(bench, bench.probe_count())
