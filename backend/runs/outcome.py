"""What became of the piece, where the bench can tell."""

from __future__ import annotations

from backend.core.facts import Released, TrialFinished
from backend.core.flow import Outcome
from backend.runs import words
from backend.runs.attended import seen_outcome
from backend.runs.bench import Bench
from backend.runs.ending import Ending
from backend.runs.plan import Plan


def after_release(bench: Bench, probe: int) -> Plan[Ending]:
    """Announce what a bench with known truth says; without truth the operator is asked."""
    if bench.scoring is None:
        ending = yield from seen_outcome(bench, probe)
        yield Released(bench.now_s(), probe, ending.outcome is Outcome.PLACED, None, None)
        return ending
    verdict = bench.scoring.verdict()
    yield Released(bench.now_s(), probe, verdict.stands, verdict.margin_mm, verdict.fall)
    if verdict.knocked_over:
        return Ending(Outcome.KNOCKED_OVER, "The support was knocked over.", probe)
    outcome = Outcome.PLACED if verdict.stands else Outcome.FELL
    reason = words.release(verdict.stands, verdict.margin_mm)
    if verdict.contradicted:
        reason = f"{reason} {words.CONTRADICTED}"
    return Ending(outcome, reason, probe)


def finished(bench: Bench, trial: int, seed: int, ending: Ending) -> TrialFinished:
    """Return the closing fact of a trial, with the truth where it is known."""
    margin_mm = excess = contradicted = None
    if bench.scoring is not None:
        verdict = bench.scoring.verdict()
        margin_mm, contradicted = verdict.margin_mm, verdict.contradicted
        if ending.outcome is Outcome.PLACED:
            excess = max(0, ending.probes - bench.scoring.least_probes())
    return TrialFinished(
        bench.now_s(),
        trial,
        seed,
        ending.outcome,
        ending.reason,
        ending.probes,
        excess,
        margin_mm,
        contradicted,
    )
