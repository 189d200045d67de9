"""A run: several trials of one strategy, each on a scene of its own, each ending in one outcome."""

from __future__ import annotations

from backend.core.facts import RunFinished, RunStarted, TrialStarted
from backend.core.flow import Outcome
from backend.runs import attended
from backend.runs.baseline import pick_and_place
from backend.runs.bench import Bench
from backend.runs.ending import Ending
from backend.runs.host import RunHost
from backend.runs.orderly import RunEnding, orderly
from backend.runs.outcome import finished
from backend.runs.plan import CancelledError, Plan
from backend.runs.record import record_of
from backend.runs.requests import StackRequest
from backend.runs.room import room_awaited
from backend.runs.stack import stack


def stack_run(host: RunHost, request: StackRequest) -> Plan[None]:
    """Run all trials; ends early when cancelled, stopped or on a fault."""
    method = request.method(host.method)
    settings = record_of(request, method, host.check(request.scene()))
    host.open()
    yield RunStarted(
        0.0,
        host.run_id,
        request.piece,
        "+".join(request.bottoms),
        request.strategy,
        request.seed,
        request.trials,
        host.simulated,
        settings,
    )
    for trial in range(request.trials):
        bench = host.set_scene(request.scene(trial), method)
        seed = request.seed + trial
        start_mm = None if bench.scoring is None else bench.scoring.start_mm()
        yield TrialStarted(bench.now_s(), trial + 1, seed, start_mm)
        at_mm = None if bench.scoring is not None else attended.start_mm(host, request, trial)
        ending, run_ending = yield from _one_trial(bench, request, at_mm)
        yield finished(bench, trial + 1, seed, ending)
        if run_ending is not None:
            reason = ending.reason if ending.fault is None else ending.fault.what
            yield RunFinished(bench.now_s(), host.run_id, run_ending, reason)
            return
    try:
        yield from room_awaited(bench.store.obstacle)
    except CancelledError as cause:
        yield RunFinished(bench.now_s(), host.run_id, "cancelled", str(cause))
        return
    yield RunFinished(bench.now_s(), host.run_id, "finished", "All trials are done.")


def _one_trial(
    bench: Bench, request: StackRequest, at_mm: tuple[float, float] | None
) -> Plan[tuple[Ending, RunEnding | None]]:
    """Return how the trial ended and, if the whole run ends with it, how the run ended.

    ``at_mm``: start of a trial that an operator sets up.
    """
    ended = yield from orderly(bench, _placing(bench, request, at_mm))
    if ended.value is not None:
        return ended.value, None if ended.value.fault is None else "failed"
    return Ending(Outcome.ABORTED, ended.reason, bench.felt_count()), ended.run_ending


def _placing(
    bench: Bench, request: StackRequest, at_mm: tuple[float, float] | None
) -> Plan[Ending]:
    if at_mm is not None:
        yield from attended.set_up(bench, request, at_mm)
    plan = pick_and_place if request.strategy == "pick-and-place" else stack
    return (yield from plan(bench))
