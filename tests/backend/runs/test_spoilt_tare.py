"""A disturbed tare is repeated up to a time limit and never used for a press."""

from __future__ import annotations

import pytest

from tests.backend.runs.oracle_bench import OracleSession, request
from touchdown.backend.core.events import Event, FaultRaised, PhaseEntered, TrialFinished
from touchdown.backend.core.values import Outcome
from touchdown.backend.emulation.disturbances import Disturbance, DisturbanceScript
from touchdown.backend.runs.motions import REFERENCE_S

# Shorter than what counts as silent, and no window of a tare is free of it.
BURST_S, EVERY_S = 0.15, 0.25


def spoil(bench: OracleSession, bursts: int) -> list[float]:
    """Inject bursts of NaN from the first reference on; return their start."""
    began: list[float] = []

    def hear(fact: Event) -> None:
        if isinstance(fact, PhaseEntered) and fact.phase == "reference" and not began:
            began.append(fact.t_s)
            # The first one lies in the window of the first try.
            at = [fact.t_s + 0.4 + EVERY_S * n for n in range(bursts)]
            found = (Disturbance("force_torque", "nan", t_s, BURST_S) for t_s in at)
            bench.benches[-1]._script = DisturbanceScript(tuple(found))

    bench.session.events.subscribe(hear)
    return began


def approaches(bench: OracleSession) -> list[float]:
    """Return the start times of the descents to a probe."""
    return [f.t_s for f in bench.of(PhaseEntered) if getattr(f, "phase", "") == "approach"]


@pytest.mark.promise("S8")
def test_a_spoilt_tare_is_taken_again() -> None:
    bursts = 3
    bench = OracleSession()
    began = spoil(bench, bursts)

    def enough(fact: Event) -> None:
        if isinstance(fact, PhaseEntered) and fact.phase == "approach":
            bench.session.stop()

    bench.session.events.subscribe(enough)
    bench.session.run(request(trials=1))
    assert bench.session.interlock.faults == ()
    # Not before the bursts had left the window.
    assert approaches(bench)[0] > began[0] + 0.4 + EVERY_S * (bursts - 1) + BURST_S


@pytest.mark.promise("S8")
def test_a_tare_that_stays_spoilt_ends_the_run_before_a_probe() -> None:
    bench = OracleSession()
    began = spoil(bench, 40)
    bench.session.run(request(trials=1))
    end = bench.of(TrialFinished)[-1]
    assert isinstance(end, TrialFinished)
    assert end.outcome is Outcome.ABORTED
    assert [fault.code for fault in bench.session.interlock.faults] == ["TARE-REFUSED"]
    assert approaches(bench) == []
    (told,) = bench.of(FaultRaised)
    assert REFERENCE_S <= told.t_s - began[0] <= REFERENCE_S + 2.0
    assert bench.benches[-1].gripper.status().holding
