"""Which plan each request means: the one table to extend for a new activity of the bench."""

from __future__ import annotations

from backend.runs.calibrate import calibrate_run
from backend.runs.collect import collect_run
from backend.runs.host import RunHost
from backend.runs.plan import Plan
from backend.runs.requests import (
    CalibrateRequest,
    CollectRequest,
    ProbeRequest,
    Request,
    SetRequest,
)
from backend.runs.set_scene import set_run
from backend.runs.single_probe import probe_run
from backend.runs.trials import stack_run


def plan_of(request: Request, host: RunHost) -> Plan[None]:
    """Return the plan of ``request``; nothing happens until it is driven."""
    if isinstance(request, CollectRequest):
        return collect_run(host, request)
    if isinstance(request, CalibrateRequest):
        return calibrate_run(host, request)
    if isinstance(request, ProbeRequest):
        return probe_run(host, request)
    if isinstance(request, SetRequest):
        return set_run(host, request)
    return stack_run(host, request)
