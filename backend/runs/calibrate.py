"""A run that calibrates: it measures, tells the estimate with its residual, and changes nothing."""

from __future__ import annotations

from collections.abc import Callable

from backend.calibration.estimate import Estimate
from backend.calibration.kinds import ON, What
from backend.core.facts import RunFinished, RunStarted
from backend.runs.bench import Bench
from backend.runs.calibrate_board import measure_board
from backend.runs.calibrate_payload import measure_payload, measure_wrist
from backend.runs.calibrate_pushes import measure_cameras
from backend.runs.calibrate_tool import measure_tool
from backend.runs.host import RunHost
from backend.runs.jig import handed
from backend.runs.motions import rest
from backend.runs.orderly import orderly
from backend.runs.plan import Plan
from backend.runs.record import record_of
from backend.runs.requests import CalibrateRequest

Measure = Callable[[Bench, CalibrateRequest], Plan[Estimate]]
MEASURES: dict[What, Measure] = {
    "payload": measure_payload,
    "board": measure_board,
    "tool": measure_tool,
    "wrist": measure_wrist,
    "camera": measure_cameras,
}
FIRST_POSES_S = 0.1
"""A scene that was just set has no pose of the arm yet."""


def calibrate_run(host: RunHost, request: CalibrateRequest) -> Plan[None]:
    """Measure what was asked for; a person accepts the result afterwards, or does not."""
    choice = request.scene()
    settings = record_of(request, host.method, host.check(choice))
    host.open()
    yield RunStarted(
        0.0, host.run_id, request.piece, request.bottom, request.what, request.seed, 1,
        host.simulated, settings, activity="calibrate",
    )  # fmt: skip
    bench = host.set_scene(choice, host.method)
    ended = yield from orderly(bench, _measured(bench, request))
    if ended.value is not None:
        about = f"{request.piece}{ON}{request.bottom}" if request.what == "board" else ""
        yield ended.value.told(bench.now_s(), request.what, about)
    ending = ended.run_ending or ("failed" if ended.value is None else "finished")
    reason = ended.reason or f"The {request.what} is measured."
    yield RunFinished(bench.now_s(), host.run_id, ending, reason)


def _measured(bench: Bench, request: CalibrateRequest) -> Plan[Estimate]:
    yield from rest(bench, FIRST_POSES_S)
    if request.takes_piece and (request.hand_over or bench.jig is None):
        bench = handed(bench)
    return (yield from MEASURES[request.what](bench, request))
