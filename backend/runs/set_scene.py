"""A run that only sets the bench: another piece, another bottom, or the same ones anew."""

from __future__ import annotations

from backend.core.facts import Said
from backend.runs.host import RunHost
from backend.runs.plan import Plan
from backend.runs.requests import SetRequest


def set_run(host: RunHost, request: SetRequest) -> Plan[None]:
    """Set the scene and say so; nothing moves."""
    host.check(request.choice)
    bench = host.set_scene(request.choice, host.method)
    yield Said(bench.now_s(), f"The bench is set: {bench.piece.name} above {bench.bottom}.")
