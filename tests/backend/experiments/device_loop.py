"""One run on the stepped bench with devices, rendering and tracker, for comparison."""

from __future__ import annotations

from backend.assembly import SimulatedBenchChoice, simulated_session
from backend.config.simulation import SimulationSettings
from backend.core.facts import Fact
from backend.runs.requests import StackRequest
from backend.session import Keep


def run_on_devices(settings: SimulationSettings, request: StackRequest) -> list[Fact]:
    """Return the facts of the run on the bench ``settings``."""
    facts: list[Fact] = []
    session = simulated_session(SimulatedBenchChoice(given=settings), keep=Keep(None))
    session.hub.subscribe(facts.append)
    try:
        session.run(request)
    finally:
        session.close()
    return facts
