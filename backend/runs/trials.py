"""A run: several trials of one strategy, each on a scene of its own, each ending in one outcome."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from backend.core.facts import FaultRaised, RunFinished, RunStarted, Said, TrialStarted
from backend.core.faults import FaultError, RefusedError
from backend.core.flow import Outcome
from backend.runs.baseline import pick_and_place
from backend.runs.bench import Bench
from backend.runs.ending import Ending
from backend.runs.motions import lift
from backend.runs.outcome import finished
from backend.runs.plan import CancelledError, Plan, StoppedError
from backend.runs.requests import StackRequest
from backend.runs.stack import stack

RunEnding = Literal["finished", "cancelled", "stopped", "failed"]
Prepare = Callable[[int], Bench]
"""Set the scene of trial k (0, 1, ...) and return its bench; its clock starts at zero."""


@dataclass(frozen=True, slots=True)
class RunHead:
    """What a run is called, and the settings it depends on (a JSON text)."""

    run_id: str
    simulated: bool
    settings: str


def stack_run(prepare: Prepare, request: StackRequest, head: RunHead) -> Plan[None]:
    """Run all trials; ends early when cancelled, stopped or on a fault."""
    yield RunStarted(
        0.0,
        head.run_id,
        request.piece,
        "+".join(request.bottoms),
        request.strategy,
        request.seed,
        request.trials,
        head.simulated,
        head.settings,
    )
    for trial in range(request.trials):
        bench = prepare(trial)
        seed = request.seed + trial
        start_mm = None if bench.scoring is None else bench.scoring.start_mm()
        yield TrialStarted(bench.now_s(), trial + 1, seed, start_mm)
        ending, run_ending = yield from _one_trial(bench, request)
        yield finished(bench, trial + 1, seed, ending)
        if run_ending is not None:
            yield RunFinished(bench.now_s(), head.run_id, run_ending, ending.reason)
            return
    yield RunFinished(bench.now_s(), head.run_id, "finished", "All trials are done.")


def _one_trial(bench: Bench, request: StackRequest) -> Plan[tuple[Ending, RunEnding | None]]:
    """Return how the trial ended and, if the whole run ends with it, how the run ended."""
    plan = pick_and_place if request.strategy == "pick-and-place" else stack
    probes = bench.probe_count
    try:
        ending = yield from plan(bench)
    except CancelledError as cause:
        yield from _retreat(bench)
        return Ending(Outcome.ABORTED, str(cause), probes()), "cancelled"
    except StoppedError as cause:
        return Ending(Outcome.ABORTED, str(cause), probes()), "stopped"
    except RefusedError as cause:
        if bench.interlock.latched:
            return Ending(Outcome.ABORTED, _stopped(bench), probes()), "stopped"
        yield Said(bench.now_s(), f"Refused: {cause}")
        yield from _retreat(bench)
        return Ending(Outcome.ABORTED, str(cause), probes()), None
    except FaultError as cause:
        if bench.interlock.stopped_by and not bench.interlock.faults:
            # The motion was interrupted by STOP: that is no fault of a device.
            return Ending(Outcome.ABORTED, _stopped(bench), probes()), "stopped"
        # A fault that stopped the arm comes back as an interrupted motion: name the first cause.
        faults = bench.interlock.faults
        first = FaultError(faults[0]) if faults else cause
        bench.interlock.raise_fault(first.fault)
        yield FaultRaised(bench.now_s(), first.fault)
        return Ending(Outcome.ABORTED, str(first), probes()), "failed"
    return ending, None


def _stopped(bench: Bench) -> str:
    return f"stopped by {bench.interlock.stopped_by}"


def _retreat(bench: Bench) -> Plan[None]:
    """Lift straight off if the bench may still move; the piece stays in the gripper."""
    if bench.gripper.status().holding and not bench.interlock.latched:
        yield from lift(bench, bench.probe_count())
