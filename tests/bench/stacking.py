"""Figures of the stacking loop: 60 seeds (3 pieces x 2 bottoms x 10), started unstable."""

from __future__ import annotations

from itertools import product

import numpy as np

from tests.bench.registry import Figure, figure
from touchdown.backend.bench.assembly import SimulatedBenchChoice, simulated_session
from touchdown.backend.core.events import ActionChosen, Event, TrialFinished
from touchdown.backend.core.values import Outcome
from touchdown.backend.runs.requests import StackRequest, StrategyChoice

FIRST_SEED = 100
"""Sixty seeds, none used twice: each cell has ten of its own."""
PIECES, BOTTOMS, TRIALS = ("pot", "mushroom", "barrel"), ("short", "long"), 10
UNSAFE = (Outcome.FELL, Outcome.KNOCKED_OVER)


def _sixty(preset: str | None, strategy: StrategyChoice) -> tuple[list[TrialFinished], list[float]]:
    """Return how each trial ended, and the decision latencies in ms."""
    facts: list[Event] = []
    session = simulated_session(SimulatedBenchChoice(preset=preset))
    session.events.subscribe(facts.append)
    try:
        for cell, (piece, bottom) in enumerate(product(PIECES, BOTTOMS)):
            seed = FIRST_SEED + TRIALS * cell
            session.run(StackRequest(piece, (bottom,), seed, trials=TRIALS, strategy=strategy))
    finally:
        session.close()
    ends = [fact for fact in facts if isinstance(fact, TrialFinished)]
    return ends, [fact.latency_ms for fact in facts if isinstance(fact, ActionChosen)]


def _counts(ends: list[TrialFinished]) -> tuple[int, int, str]:
    placed = sum(end.outcome is Outcome.PLACED for end in ends)
    unsafe = sum(end.outcome in UNSAFE for end in ends)
    probes = float(np.mean([end.probes for end in ends]))
    return placed, unsafe, f"{len(ends)} trials, {probes:.2f} probes on average"


@figure("stacking")
def paper_on_the_default_bench() -> list[Figure]:
    """Placed, unsafe releases and decision latency on mixed noise."""
    ends, latencies_ms = _sixty(None, "paper")
    placed, unsafe, note = _counts(ends)
    p50, p99 = (float(value) for value in np.percentile(latencies_ms, [50, 99]))
    decided = f"{len(latencies_ms)} decisions, median {p50:.1f}, max {max(latencies_ms):.1f} ms"
    return [
        Figure("placed, paper strategy", placed, "of 60", ">= 50", placed >= 50, note),
        Figure("released unsafely, paper strategy", unsafe, "of 60", "<= 3", unsafe <= 3, note),
        Figure("decision latency p99, headless", p99, "ms", "<= 10", p99 <= 10, decided),
    ]


@figure("stacking")
def paper_with_release_disturbance() -> list[Figure]:
    """The same with 0.5 mm of disturbance at release (no target: stated beside the other)."""
    placed, unsafe, note = _counts(_sixty("realistic", "paper")[0])
    note = f"{unsafe} released unsafely; {note}"
    return [Figure("placed, preset realistic", placed, "of 60", "stated", None, note)]


@figure("stacking")
def pick_and_place() -> list[Figure]:
    """Without touch nothing stands, since every start is unstable."""
    placed, _, note = _counts(_sixty(None, "pick-and-place")[0])
    return [Figure("placed, pick-and-place", placed, "of 60", "0", placed == 0, note)]
