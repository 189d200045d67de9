"""Plans by request. A new activity of the bench is added here."""

from __future__ import annotations

from dataclasses import replace

from touchdown.backend.core import EpisodeRecorded, PatchEstimated, RunStarted, Said
from touchdown.backend.runs import messages, motions, requests
from touchdown.backend.runs.bench import Bench, NoEstimator, RunContext
from touchdown.backend.runs.calibrate import calibrate_run
from touchdown.backend.runs.collect import collect_run, prepare_campaign
from touchdown.backend.runs.manual_control import refuse_simulated_only
from touchdown.backend.runs.outcome import trial_start_mm
from touchdown.backend.runs.plan import Plan
from touchdown.backend.runs.probe import press_once
from touchdown.backend.runs.stack import check_pieces, stack_run


def set_scene_run(session: RunContext, request: requests.SetRequest) -> Plan[None]:
    """Set the scene; nothing moves."""
    session.check_scene(request.choice)
    bench = session.set_scene(request.choice, session.method)
    yield Said(bench.now_s(), f"The bench is set: {bench.piece.name} above {bench.bottom}.")


def probe_run(session: RunContext, request: requests.ProbeRequest) -> Plan[None]:
    """Probe once at the present arm pose, report the result, and lift."""
    session.present_scene(session.method)  # raises before a folder is made
    session.open_record()
    bench = session.present_scene(session.method)  # with the store of this run
    yield RunStarted(
        bench.now_s(), session.run_id, bench.piece.name, bench.bottom, "", 0, 1, session.simulated,
        requests.request_record(request, session.method, {}), activity="probe",
    )  # fmt: skip
    ended = yield from motions.run_to_end(bench, _probe(bench))
    yield motions.run_finished(bench, session.run_id, ended, "The probe is done.")


def _probe(bench: Bench) -> Plan[bool]:
    if not bench.gripper.status().holding:
        yield from motions.take_piece(bench)
    pressed = yield from press_once(bench, 1)
    episode = pressed.episode
    bench.store.keep(episode)
    if not episode.quality.accepted:
        yield Said(bench.now_s(), messages.rejected_message(1, episode.quality.reasons))
    elif not isinstance(bench.estimator, NoEstimator):
        patch = bench.estimator.estimate(episode)
        x_mm, y_mm = episode.offset_mm.tolist()
        yield PatchEstimated(bench.now_s(), patch, (x_mm, y_mm), 1)
    yield from motions.lift(bench, 1)
    yield from motions.wait_while_writing(bench, lambda: bench.store.written)
    path = bench.store.settle()
    name = "" if path is None else path.name
    yield EpisodeRecorded(bench.now_s(), replace(episode, recording=None), 1, name)
    return True


def make_plan(request: requests.Request, session: RunContext) -> Plan[None]:
    """Return the plan of ``request``; nothing happens until it runs."""
    if isinstance(request, requests.CollectRequest):
        return collect_run(session, request)
    if isinstance(request, requests.CalibrateRequest):
        return calibrate_run(session, request)
    if isinstance(request, requests.ProbeRequest):
        return probe_run(session, request)
    if isinstance(request, requests.SetRequest):
        return set_scene_run(session, request)
    return stack_run(session, request)


def check_request(request: requests.Request, session: RunContext) -> None:
    """Raise the errors of ``request`` that are known before a device is connected."""
    refuse_simulated_only(request)
    if isinstance(request, requests.CollectRequest):
        prepare_campaign(session, request)
    elif isinstance(request, requests.StackRequest):
        session.check_scene(request.scene())
        check_pieces(session, request)
        trial_start_mm(session, request, 0)
    elif isinstance(request, requests.CalibrateRequest):
        session.check_scene(request.scene())
