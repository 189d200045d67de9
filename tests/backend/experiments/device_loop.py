"""One run on the stepped bench with devices, rendering and tracker, for comparison."""

from __future__ import annotations

from touchdown.backend.bench.assembly import SimulatedBenchChoice, simulated_session
from touchdown.backend.config.simulation import SimulationSettings
from touchdown.backend.core.events import Event
from touchdown.backend.runs import RecordingOptions, StackRequest


def run_on_devices(settings: SimulationSettings, request: StackRequest) -> list[Event]:
    """Return the facts of the run on the bench ``settings``."""
    facts: list[Event] = []
    session = simulated_session(SimulatedBenchChoice(given=settings), keep=RecordingOptions(None))
    session.events.subscribe(facts.append)
    try:
        session.run(request)
    finally:
        session.close()
    return facts
