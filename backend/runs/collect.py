"""A run that collects: mounting after mounting until the plan of the campaign is done."""

from __future__ import annotations

import json
from dataclasses import replace

from backend.catalogue.dataset import Dataset
from backend.catalogue.diskspace import NO_ROOM, room_for
from backend.catalogue.uuid7 import follow, uuid7
from backend.catalogue.values import EpisodeContext, EpisodeEntry, EpisodeFilter
from backend.core.facts import CampaignBegan, RunFinished, RunStarted
from backend.core.faults import FaultError, InputError, RefusedError
from backend.runs.bench import Bench
from backend.runs.campaign import Campaign, campaign_now, new_campaign, newest_campaign
from backend.runs.collect_plan import Target, planned_mm
from backend.runs.collect_report import pair_coverage
from backend.runs.collected import EpisodeRecorder, Origin
from backend.runs.collecting import Collector
from backend.runs.host import RunHost
from backend.runs.jig import fitted_anew
from backend.runs.mounting import NEW, Mounting, mounting_id, mounting_to_go_on
from backend.runs.orderly import Ended, orderly
from backend.runs.plan import Plan
from backend.runs.record import record_of
from backend.runs.requests import CollectRequest
from backend.runs.room import no_plan_saved, saved


def collect_run(host: RunHost, request: CollectRequest) -> Plan[None]:
    """Collect what the plan still lacks; every episode is durable before the next press."""
    dataset = _dataset(host, request)
    campaign = _begun(dataset, request)
    request = replace(
        request, piece=campaign.piece, bottom=campaign.bottom, count=campaign.count,
        pattern=campaign.pattern, seed=campaign.seed, within_mm=campaign.within_mm,
        campaign=campaign.uuid,
    )  # fmt: skip
    host = replace(host, method=request.method(host.method))
    settings = record_of(request, host.method, host.check(request.scene()))
    entries = dataset.episodes(EpisodeFilter(campaign=campaign.uuid))
    room_for(dataset.folder, len(campaign.todo(entries)))
    host.open()
    yield RunStarted(
        0.0, host.run_id, request.piece, request.bottom, request.pattern, request.seed, 1,
        host.simulated, settings, activity="collect",
    )  # fmt: skip
    recorder = EpisodeRecorder(dataset)
    try:
        yield from _mountings(host, request, campaign, entries, recorder)
    finally:
        recorder.close()


def _mountings(
    host: RunHost,
    request: CollectRequest,
    campaign: Campaign,
    entries: list[EpisodeEntry],
    recorder: EpisodeRecorder,
) -> Plan[None]:
    bench = host.set_scene(request.scene(campaign.mountings), host.method)
    target = Target(bench.piece.face, bench.outline, request.within_mm)
    collector = _collector(host, request, campaign, entries, recorder, target)
    begun = yield from orderly(bench, _mounting(bench, request, recorder.dataset, campaign))
    ended: Ended[bool] = Ended(None, begun.run_ending, begun.reason)
    mounting = begun.value
    if mounting is not None and mounting.goes_on:
        bench = host.set_scene(request.scene(campaign.mountings - 1), host.method)
    while mounting is not None:
        ended = yield from _one(host, request, bench, target, collector, mounting)
        if ended.value is None or not collector.todo:
            break
        if _by_hand(request, bench):
            # No simulation does it: two mountings are two only if somebody fitted them.
            ended = yield from orderly(bench, fitted_anew(bench))
            if ended.value is None:
                break
        mounting = NEW
        bench = host.set_scene(request.scene(collector.campaign.mountings), host.method)
    ending = ended.run_ending or ("finished" if ended.value else "failed")
    reason = ended.reason or _summary(collector)
    yield RunFinished(bench.now_s(), host.run_id, ending, reason)


def _collector(
    host: RunHost,
    request: CollectRequest,
    campaign: Campaign,
    entries: list[EpisodeEntry],
    recorder: EpisodeRecorder,
    target: Target,
) -> Collector:
    """Return what works off the campaign; raises ``InputError`` where nothing can be probed."""
    seen = pair_coverage(recorder.dataset, campaign, target)
    planned_mm(campaign.pattern, target, campaign.seed, 0, campaign.count, seen)
    collector = Collector(campaign, recorder, host.decisions, seen, entries)
    collector.ask, collector.check_origin = request.ask, request.check_origin
    collector.hand_over = request.hand_over
    return collector


def _by_hand(request: CollectRequest, bench: Bench) -> bool:
    """Whether somebody fits bottom and gels; a simulation with a jig does so by itself."""
    return request.hand_over or bench.jig is None


def _mounting(
    bench: Bench, request: CollectRequest, dataset: Dataset, campaign: Campaign
) -> Plan[Mounting]:
    """Return the mounting to begin with: only one that a person fitted may be the former one."""
    if campaign.mountings and _by_hand(request, bench):
        return (yield from mounting_to_go_on(bench, dataset, campaign))
    return NEW


def _one(
    host: RunHost,
    request: CollectRequest,
    bench: Bench,
    target: Target,
    collector: Collector,
    mounting: Mounting,
) -> Plan[Ended[bool]]:
    """Collect on one mounting, a new one or the rest of one; the campaign is saved around it."""
    dataset = collector.recorder.dataset
    if not mounting.goes_on:
        begun = collector.campaign.with_mounting()
        kept = yield from orderly(bench, saved(lambda: begun.save(dataset.folder)))
        if not kept.value:
            return kept
        collector.campaign = begun
    origin = _origin(bench, request)
    context = _context(host, request, bench, origin, collector.campaign, dataset)
    context = replace(context, series=mounting.series or context.series)
    yield CampaignBegan(
        bench.now_s(), collector.campaign.uuid, context.series, str(dataset.folder),
        collector.done, collector.campaign.count,
    )  # fmt: skip
    work = collector.mounting(bench, target, origin, context, after=mounting.grips)
    try:
        ended = yield from orderly(bench, work)
    except Exception:
        # The probe before is on its way to the disk: it is told whatever ended the run.
        yield from collector.settle(bench)
        raise
    yield from collector.settle(bench)
    kept = yield from orderly(bench, _saved_after(collector, dataset, waits=bool(ended.value)))
    return ended if kept.value else kept


def _saved_after(collector: Collector, dataset: Dataset, *, waits: bool) -> Plan[bool]:
    """Save what a mounting left out; only a run that goes on ``waits`` for room on a full disk."""
    if waits:
        return (yield from saved(lambda: collector.campaign.save(dataset.folder)))
    try:
        collector.campaign.save(dataset.folder)
    except OSError as error:
        if error.errno not in NO_ROOM:
            raise
        raise FaultError(no_plan_saved(dataset.folder)) from error
    return True


def _summary(collector: Collector) -> str:
    left_out = len(collector.campaign.skipped)
    text = f"{collector.done} of {collector.campaign.count} probes are collected"
    return f"{text}, {left_out} left out." if left_out else f"{text}."


def _dataset(host: RunHost, request: CollectRequest) -> Dataset:
    if host.dataset is None:
        raise RefusedError("NO-DATASET", "No dataset is open to collect into.")
    if not host.dataset.writable:
        raise RefusedError("READ-ONLY", "The dataset is open for reading only.")
    for name, limit in (
        ("grip", request.probes_per_grip),
        ("mounting", request.grips_per_mounting),
    ):
        if limit is not None and limit < 1:
            what = "probe" if name == "grip" else "grip"
            raise InputError(
                f"A {name} makes at least one {what}.", f"{what}s per {name}", "Give 1 or more."
            )
    if not request.person.strip():
        raise InputError("Nobody is named.", "--person", "Say who collects.")
    return host.dataset


def _begun(dataset: Dataset, request: CollectRequest) -> Campaign:
    if request.campaign:
        return campaign_now(dataset, request.campaign)
    # Resuming takes the newest one by its id, also after the clock was set back.
    follow(newest_campaign(dataset.folder) or "")
    return new_campaign(
        request.piece, request.bottom, request.pattern, request.seed, request.count,
        request.within_mm,
    )  # fmt: skip


def _origin(bench: Bench, request: CollectRequest) -> Origin:
    sigma_mm = request.origin_sigma_mm
    if sigma_mm is None:
        sigma_mm = bench.settings.collect.origin_sigma_mm
    at = bench.placed.origin(request.origin_mm, sigma_mm, bench.bottom)
    return Origin(at.x_mm, at.y_mm, at.sigma_mm)


def _context(
    host: RunHost,
    request: CollectRequest,
    bench: Bench,
    origin: Origin,
    campaign: Campaign,
    dataset: Dataset,
) -> EpisodeContext:
    """Return what holds for all episodes of one mounting: a series of its own."""
    bottom = host.piece(request.bottom)
    calibration = {"origin_mm": [origin.x_mm, origin.y_mm], "origin_sigma_mm": origin.sigma_mm}
    return EpisodeContext(
        series=uuid7(),
        bottom=request.bottom,
        geometry=dataset.geometry.store_pair(bench.piece, bottom),
        person=request.person,
        grip_id="",
        mounting_id=mounting_id(campaign),
        campaign=campaign.uuid,
        mode=host.mode,
        seed=request.seed,
        bench={
            "run": host.run_id,
            "origin": json.dumps(calibration),
            "facts": host.facts.model_dump_json(),
        },
    )
