"""A run: several trials of one strategy, each on a scene of its own, each ending in one outcome."""

from __future__ import annotations

from backend.core.facts import RunFinished, RunStarted, TrialStarted
from backend.core.flow import Outcome
from backend.runs.baseline import pick_and_place
from backend.runs.bench import Bench
from backend.runs.ending import Ending
from backend.runs.host import RunHost
from backend.runs.orderly import RunEnding, orderly
from backend.runs.outcome import finished
from backend.runs.plan import Plan
from backend.runs.record import record_of
from backend.runs.requests import StackRequest
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
        ending, run_ending = yield from _one_trial(bench, request)
        yield finished(bench, trial + 1, seed, ending)
        if run_ending is not None:
            reason = ending.reason if ending.fault is None else ending.fault.what
            yield RunFinished(bench.now_s(), host.run_id, run_ending, reason)
            return
    yield RunFinished(bench.now_s(), host.run_id, "finished", "All trials are done.")


def _one_trial(bench: Bench, request: StackRequest) -> Plan[tuple[Ending, RunEnding | None]]:
    """Return how the trial ended and, if the whole run ends with it, how the run ended."""
    plan = pick_and_place if request.strategy == "pick-and-place" else stack
    ended = yield from orderly(bench, plan(bench))
    if ended.value is not None:
        return ended.value, None if ended.value.fault is None else "failed"
    return Ending(Outcome.ABORTED, ended.reason, bench.felt_count()), ended.run_ending
