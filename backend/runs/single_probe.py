"""A run of one probe, here and now: what the operator presses for."""

from __future__ import annotations

from dataclasses import replace

from backend.core.facts import EpisodeRecorded, PatchEstimated, RunFinished, RunStarted, Said
from backend.runs import words
from backend.runs.bench import Bench, NoModel
from backend.runs.host import RunHost
from backend.runs.motions import lift, take_piece
from backend.runs.orderly import orderly
from backend.runs.plan import Plan
from backend.runs.probe import press_once
from backend.runs.record import record_of
from backend.runs.requests import ProbeRequest
from backend.runs.room import writing


def probe_run(host: RunHost, request: ProbeRequest) -> Plan[None]:
    """Probe once where the arm is, tell what was felt, and lift."""
    bench = host.present(host.method)
    host.open()
    yield RunStarted(
        bench.now_s(),
        host.run_id,
        bench.piece.name,
        bench.bottom,
        "",
        0,
        1,
        host.simulated,
        record_of(request, host.method, {}),
        activity="probe",
    )
    ended = yield from orderly(bench, _probe(bench))
    ending = ended.run_ending or ("finished" if ended.value else "failed")
    reason = ended.reason or "The probe is done."
    yield RunFinished(bench.now_s(), host.run_id, ending, reason)


def _probe(bench: Bench) -> Plan[bool]:
    if not bench.gripper.status().holding:
        yield from take_piece(bench)
    felt = yield from press_once(bench, 1)
    episode = felt.episode
    bench.store.keep(episode)
    if not episode.quality.accepted:
        yield Said(bench.now_s(), words.rejected(1, episode.quality.reasons))
    elif not isinstance(bench.estimator, NoModel):
        patch = bench.estimator.estimate(episode)
        x_mm, y_mm = episode.offset_mm.tolist()
        yield PatchEstimated(bench.now_s(), patch, (x_mm, y_mm), 1)
    yield from lift(bench, 1)
    yield from writing(bench, lambda: bench.store.written)
    path = bench.store.settle()
    name = "" if path is None else path.name
    yield EpisodeRecorded(bench.now_s(), replace(episode, recording=None), 1, name)
    return True
