"""Collecting run: probe mounting after mounting until the plan of the campaign is complete."""

from __future__ import annotations

import json
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any

from touchdown.backend import core
from touchdown.backend.annotations import (
    DISK_FULL_ERRNOS,
    Dataset,
    EpisodeContext,
    EpisodeEntry,
    EpisodeFilter,
    check_free_space,
    check_person,
    follow_uuid,
    pair_records,
    uuid7,
)
from touchdown.backend.calibration import HandPosition
from touchdown.backend.episodes import FACTS_KEY, START_KEY
from touchdown.backend.runs.bench import Bench, RunContext
from touchdown.backend.runs.campaign import (
    Campaign,
    ProbeTarget,
    current_campaign,
    new_campaign,
    newest_campaign,
    pair_coverage,
    planned_displacement_mm,
)
from touchdown.backend.runs.collector import Collector, EpisodeRecorder
from touchdown.backend.runs.jig import wait_for_refit
from touchdown.backend.runs.motions import PlanEnd, ask_operator, run_finished, run_to_end
from touchdown.backend.runs.plan import Plan
from touchdown.backend.runs.recorder import not_saved_fault, save_or_wait
from touchdown.backend.runs.requests import PRESS_OF_PLAN, CollectRequest, request_record

GRIP_LIMITS = ("probes_per_grip", "grips_per_mounting")
RECORDED = (*sorted(PRESS_OF_PLAN), *GRIP_LIMITS)


@dataclass(frozen=True, slots=True)
class MountingProgress:
    """State of a mounting that may continue: its series ("" for none) and number of grips."""

    goes_on: bool = False
    series: str = ""
    grips: int = 0


NEW_MOUNTING = MountingProgress()


def newest_mounting_id(campaign: Campaign) -> str:
    """Return the id of the newest mounting."""
    return f"{campaign.uuid}/mounting-{campaign.mountings}"


def ask_mounting(bench: Bench, dataset: Dataset, campaign: Campaign) -> Plan[MountingProgress]:
    """Ask whether bottom or gels were refitted; return the last mounting if not, else a new one.

    Nothing moves meanwhile.
    """
    question = core.MountingAwaited(bench.now_s(), bench.bottom, campaign.mountings)
    if (yield from ask_operator(bench, question, "the answer about the mounting")):
        return NEW_MOUNTING
    found = _last(dataset, campaign)
    text = f"Mounting {campaign.mountings} and its series go on, after {found.grips} grips."
    yield core.Said(bench.now_s(), text)
    return found


def _last(dataset: Dataset, campaign: Campaign) -> MountingProgress:
    """Return the progress of the last mounting from the dataset, discarded probes included."""
    wanted, series, grips = newest_mounting_id(campaign), "", 0
    for entry in dataset.episodes(EpisodeFilter(campaign=campaign.uuid, deleted=None)):
        if entry.mounting_id == wanted:
            series = entry.series
            grips = max(grips, int(entry.grip_id.rpartition("-")[2]))
    return MountingProgress(True, series, grips)


def collect_run(session: RunContext, request: CollectRequest) -> Plan[None]:
    """Collect the missing items of the plan; every episode is durable before the next press."""
    dataset, campaign, request = prepare_campaign(session, request)
    method = request.method(session.method)
    settings = request_record(request, method, session.check_scene(request.scene()))
    entries = dataset.episodes(EpisodeFilter(campaign=campaign.uuid))
    session.open_record()
    yield core.RunStarted(
        0.0, session.run_id, request.piece, request.bottom, request.pattern, request.seed, 1,
        session.simulated, settings, activity="collect",
    )  # fmt: skip
    with closing(EpisodeRecorder(dataset)) as recorder:
        yield from _mountings(session, request, campaign, entries, recorder)


def prepare_campaign(
    session: RunContext, request: CollectRequest
) -> tuple[Dataset, Campaign, CollectRequest]:
    """Return dataset, campaign and the request with its plan; nothing is written.

    Raises ``InputError`` or ``RefusedError`` if the campaign cannot be collected.
    """
    dataset = _dataset(session, request)
    campaign = _begun(dataset, request)
    stored: dict[str, Any] = {n: v for n, v in campaign.recording.items() if n in RECORDED}
    stored |= {n: v for n in GRIP_LIMITS if (v := getattr(request, n)) is not None}
    if campaign.recording and request.stage not in ("", stored.get("stage")):
        what = f"The campaign records '{stored.get('stage')}', not '{request.stage}'."
        raise core.InputError(what, "--plan", "Leave it out: a campaign keeps its plan.")
    request = replace(
        request, piece=campaign.piece, bottom=campaign.bottom, count=campaign.count,
        pattern=campaign.pattern, seed=campaign.seed, within_mm=campaign.within_mm,
        campaign=campaign.uuid, **stored,
    )  # fmt: skip
    session.check_scene(request.scene())
    piece, bottom = session.catalogue.top(campaign.piece), session.catalogue.bottom(campaign.bottom)
    pair_records(piece, bottom)
    target = ProbeTarget(piece.face, bottom.upper or bottom.face, request.within_mm)
    seen = pair_coverage(dataset, campaign, target)
    planned_displacement_mm(campaign.pattern, target, campaign.seed, 0, campaign.count, seen)
    check_free_space(dataset.folder)
    return dataset, campaign, request


def _mountings(
    session: RunContext,
    request: CollectRequest,
    campaign: Campaign,
    entries: list[EpisodeEntry],
    recorder: EpisodeRecorder,
) -> Plan[None]:
    method = request.method(session.method)
    bench = session.set_scene(request.scene(campaign.mountings), method)
    target = ProbeTarget(bench.piece.face, bench.outline, request.within_mm)
    seen = pair_coverage(recorder.dataset, campaign, target)
    # Raises ``InputError`` before anything moves if no displacement can be probed.
    planned_displacement_mm(campaign.pattern, target, campaign.seed, 0, campaign.count, seen)
    collector = Collector(campaign, recorder, session.decisions, seen, entries)
    collector.ask, collector.check_origin = request.ask, request.check_origin
    collector.hand_over, collector.rest_s = request.hand_over, request.rest_s
    collector.drag_mm = request.drag_mm
    begun = PlanEnd(NEW_MOUNTING)
    if campaign.mountings and _by_hand(request, bench):
        # Only a mounting fitted by hand may be continued.
        asked = ask_mounting(bench, recorder.dataset, campaign)
        begun = yield from run_to_end(bench, asked)
    ended: PlanEnd[bool] = PlanEnd(None, begun.run_ending, begun.reason)
    mounting = begun.value
    if mounting is not None and mounting.goes_on:
        bench = session.set_scene(request.scene(campaign.mountings - 1), method)
    while mounting is not None:
        ended = yield from _one(session, request, bench, target, collector, mounting)
        if ended.value is None or not collector.todo:
            break
        if _by_hand(request, bench):
            # Two mountings differ only if a person refitted bottom and gels.
            ended = yield from run_to_end(bench, wait_for_refit(bench))
            if ended.value is None:
                break
        mounting = NEW_MOUNTING
        bench = session.set_scene(request.scene(collector.campaign.mountings), method)
    done = f"{collector.done} of {collector.campaign.count} probes are collected"
    left_out = len(collector.campaign.skipped)
    done += f", {left_out} left out." if left_out else "."
    yield run_finished(bench, session.run_id, ended, done)


def _by_hand(request: CollectRequest, bench: Bench) -> bool:
    """Return True if a person fits bottom and gels; a simulation with a jig refits by itself."""
    return request.hand_over or bench.jig is None


def _one(
    session: RunContext,
    request: CollectRequest,
    bench: Bench,
    target: ProbeTarget,
    collector: Collector,
    mounting: MountingProgress,
) -> Plan[PlanEnd[bool]]:
    """Collect on one mounting, new or continued; the campaign is saved before and after."""
    dataset = collector.recorder.dataset
    if not mounting.goes_on:
        begun = replace(collector.campaign, mountings=collector.campaign.mountings + 1)
        kept = yield from run_to_end(bench, save_or_wait(lambda: begun.save(dataset.folder)))
        if not kept.value:
            return kept
        collector.campaign = begun
    sigma_mm = request.origin_sigma_mm
    if sigma_mm is None:
        sigma_mm = bench.settings.collect.origin_sigma_mm
    origin = bench.placed.origin(request.origin_mm, sigma_mm, bench.bottom)
    context = _context(session, request, bench, origin, collector.campaign, dataset)
    context = replace(context, series=mounting.series or context.series)
    yield core.CampaignBegan(
        bench.now_s(), collector.campaign.uuid, context.series, str(dataset.folder),
        collector.done, collector.campaign.count,
    )  # fmt: skip
    work = collector.mounting(bench, target, origin, context, after=mounting.grips)
    try:
        ended = yield from run_to_end(bench, work)
    except Exception:
        # The previous probe is being written: announce it before the error ends the run.
        yield from collector.settle(bench)
        raise
    yield from collector.settle(bench)
    kept = yield from run_to_end(bench, _saved_after(collector, dataset, waits=bool(ended.value)))
    return ended if kept.value else kept


def _saved_after(collector: Collector, dataset: Dataset, *, waits: bool) -> Plan[bool]:
    """Save the items left out; only a run that goes on ``waits`` for space on a full disk."""
    if waits:
        return (yield from save_or_wait(lambda: collector.campaign.save(dataset.folder)))
    try:
        collector.campaign.save(dataset.folder)
    except OSError as error:
        if error.errno not in DISK_FULL_ERRNOS:
            raise
        fault = not_saved_fault(
            dataset.folder,
            "the plan of the campaign",
            "Every probe and decision is safe; places given up after refused probes are tried "
            "again when it goes on.",
            "then press Reset.",
        )
        raise core.FaultError(fault) from error
    return True


def _dataset(session: RunContext, request: CollectRequest) -> Dataset:
    if session.dataset is None:
        raise core.RefusedError("NO-DATASET", "No dataset is open to collect into.")
    if not session.dataset.writable:
        raise core.RefusedError("READ-ONLY", "The dataset is open for reading only.")
    check_person(request.person)
    return session.dataset


def _begun(dataset: Dataset, request: CollectRequest) -> Campaign:
    if request.campaign:
        return current_campaign(dataset, request.campaign)
    # Ids order campaigns by age, also after the clock was set back.
    follow_uuid(newest_campaign(dataset.folder) or "")
    recording = {n: getattr(request, n) for n in RECORDED} if request.stage else {}
    campaign = new_campaign(
        request.piece, request.bottom, request.pattern, request.seed, request.count,
        request.within_mm,
    )  # fmt: skip
    return replace(campaign, recording=recording)


def _context(
    session: RunContext,
    request: CollectRequest,
    bench: Bench,
    origin: HandPosition,
    campaign: Campaign,
    dataset: Dataset,
) -> EpisodeContext:
    """Return the metadata shared by all episodes of one mounting, which is a series."""
    bottom = session.catalogue.piece(request.bottom)
    calibration = {"origin_mm": [origin.x_mm, origin.y_mm], "origin_sigma_mm": origin.sigma_mm}
    return EpisodeContext(
        series=uuid7(),
        bottom=request.bottom,
        geometry=dataset.geometry.store_pair(bench.piece, bottom),
        person=request.person,
        grip_id="",
        mounting_id=newest_mounting_id(campaign),
        campaign=campaign.uuid,
        mode=session.mode,
        seed=request.seed,
        bench={
            "run": session.run_id,
            "origin": json.dumps(calibration),
            FACTS_KEY: session.description.model_dump_json(),
            "probe": bench.settings.probe.model_dump_json(),
            "stage": request.stage,
            START_KEY: str(bench.started_ns),
        },
    )
