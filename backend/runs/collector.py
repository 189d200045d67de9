"""Probes of a campaign on one bench, each recorded as a labelled episode.

The label is the measured displacement. The origin is checked by touching the edges of the bottom on
both sides.
"""

from __future__ import annotations

import json
import math
from collections import Counter, deque
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from touchdown.backend import core
from touchdown.backend.annotations import (
    NO_LABEL,
    Dataset,
    EpisodeContext,
    EpisodeEntry,
    Label,
    with_uuid,
)
from touchdown.backend.calibration import HandPosition
from touchdown.backend.config import CollectSettings
from touchdown.backend.episodes import REST_KEY, Coverage, KeepFrames
from touchdown.backend.runs import jig, messages, motions
from touchdown.backend.runs.bench import Bench, PressedProbe
from touchdown.backend.runs.campaign import (
    Campaign,
    ProbeTarget,
    last_signal_excerpt,
    planned_displacement_mm,
    xy_mm,
)
from touchdown.backend.runs.plan import PausePoint, Plan, Wait
from touchdown.backend.runs.probe import (
    RESOLUTION_MM,
    edge_mm,
    find_height,
    press_once,
    scene_pictures,
)
from touchdown.backend.runs.recorder import (
    DISK_FULL,
    DiskWriter,
    no_space_fault,
    not_saved_fault,
    refused_episode_fault,
    save_or_wait,
    wait_for_space,
)
from touchdown.backend.sensing import EpisodeLimits, assemble_episode

MEASURED = "measured"
REST_BLOCK_S = 5.0  # length of an episode at rest; the streams hold 7.7 s of images
AT_REST = "Rest in air, no press"


@dataclass(frozen=True, slots=True)
class MeasuredOffset:
    """Displacement (2,) at contact, its standard uncertainty, and the contact height, mm."""

    offset_mm: core.FloatArray
    sigma_mm: float
    contact_mm: float

    def label(self) -> Label:
        """Return the label in whole µm."""
        x_um, y_um = np.rint(1e3 * self.offset_mm).astype(int).tolist()
        return Label(x_um, y_um, 0, round(1e3 * self.sigma_mm))


def measure_offset(
    episode: core.Episode, origin: HandPosition, settings: CollectSettings
) -> MeasuredOffset:
    """Return the position of the arm at contact onset relative to ``origin``.

    The uncertainties of arm, bottom and grasp are independent.
    """
    recording = episode.recording
    assert recording is not None
    x, y, z = (
        float(np.interp(episode.onset_s, recording.pose_t_s, recording.pose_mm[:, axis]))
        for axis in range(3)
    )
    sigma_mm = math.hypot(settings.arm_sigma_mm, origin.sigma_mm, settings.grip_sigma_mm)
    return MeasuredOffset(np.array([x - origin.x_mm, y - origin.y_mm]), sigma_mm, z)


class EpisodeRecorder(DiskWriter[EpisodeEntry]):
    """Writes episodes into a dataset on its own thread; the bench never waits for the disk."""

    def __init__(self, dataset: Dataset) -> None:
        super().__init__("collect-writer")
        self.dataset = dataset

    def record(
        self,
        episode: core.Episode,
        label: Label,
        context: EpisodeContext,
        keep_frames: KeepFrames = "jpeg95_444",
    ) -> None:
        """Start to write an episode; the previous one must be settled."""
        # The id is fixed here, so that a repeated write makes the same file.
        self.begin(
            partial(
                self.dataset.record,
                with_uuid(episode),
                label,
                source=MEASURED,
                context=context,
                keep_frames=keep_frames,
            )
        )


def check_origin(bench: Bench, origin: HandPosition) -> Plan[core.OriginChecked]:
    """Touch around all four edges with the held piece and return the residual of the origin.

    Raises ``RefusedError`` "ORIGIN-FAR" if an edge is too far off.
    """
    centre = np.array([origin.x_mm, origin.y_mm])
    contact_mm = yield from find_height(bench, centre)
    start_mm = contact_mm + bench.settings.probe.start_height_mm
    for axis in range(2):
        low_mm = yield from edge_mm(bench, centre, axis, -1.0, start_mm)
        high_mm = yield from edge_mm(bench, centre, axis, 1.0, start_mm)
        centre[axis] += 0.5 * (low_mm + high_mm)
    collect = bench.settings.collect
    touch = math.hypot(RESOLUTION_MM / math.sqrt(12.0), collect.arm_sigma_mm) / math.sqrt(2.0)
    # Combines resolution, arm and grasp
    sigma_mm = math.hypot(touch, collect.grip_sigma_mm)
    residual_mm = xy_mm(centre - (origin.x_mm, origin.y_mm))
    agrees = all(abs(off_mm) <= 3.0 * sigma_mm for off_mm in residual_mm)
    check = core.OriginChecked(bench.now_s(), residual_mm, sigma_mm, agrees)
    yield check
    return check


SLIP_MM = EpisodeLimits().slip_mm


@dataclass(frozen=True, slots=True)
class _PendingEpisode:
    pressed: PressedProbe
    item: int
    where: MeasuredOffset
    drift_mm: float


class Collector:
    """Works through the items of a campaign during one run, over all its mountings."""

    def __init__(
        self,
        campaign: Campaign,
        recorder: EpisodeRecorder,
        decisions: deque[core.EpisodeDecision],
        seen: Coverage,
        entries: list[EpisodeEntry],
    ) -> None:
        self.campaign, self.recorder, self._decisions = campaign, recorder, decisions
        self.seen: Coverage = seen
        self.todo: deque[int] = deque(campaign.todo(entries))
        self.done: int = sum(e.quality.accepted and not e.deleted for e in entries)
        self.ask = self.check_origin = self.hand_over = False
        self.rest_s = self.drag_mm = 0.0
        self._rejected: Counter[int] = Counter()
        self._probes = 0
        self._pending: _PendingEpisode | None = None
        self._last: tuple[EpisodeEntry, int] | None = None
        # Decision on the last episode until it is carried out
        self._decision: core.EpisodeDecision | None = None
        self._unpublished: deque[core.Event] = deque()  # events of durable probes, in order

    def mounting(
        self,
        bench: Bench,
        target: ProbeTarget,
        origin: HandPosition,
        context: EpisodeContext,
        after: int = 0,
    ) -> Plan[bool]:
        """Grip and probe until no item is left or the bottom has to be refitted.

        ``after`` is the number of grips made on this mounting before; at least one more is made.
        """
        if self.hand_over or bench.jig is None:
            yield from motions.wait(bench, motions.FIRST_POSES_S)
            bench = jig.with_handed_piece(bench)
        first = after + 1
        most = max(first, bench.settings.collect.grips_per_mounting)
        for grip in range(first, most + 1):
            if not self.todo:
                break
            mass_g = yield from jig.pick_piece(bench)
            yield core.Gripped(bench.now_s(), grip, self.campaign.mountings, mass_g)
            if self.check_origin and grip == first:
                context = yield from self._checked(bench, origin, context)
            held = replace(context, grip_id=f"{context.mounting_id}/grip-{grip}")
            if self.rest_s and grip == first:
                yield from self._rest(bench, held)
            yield from self._grip(bench, target, origin, held)
            yield from jig.return_piece(bench)
            yield from self._settled(bench)
            yield from self._carry_out(bench)
        return True

    def settle(self, bench: Bench) -> Plan[None]:
        """Announce the last probe of a mounting that ended early; a refused write is a fault.

        Announces everything that is in the dataset and carries out the pending decision.
        """
        yield from self._publish()
        for rest_of in (self._carry_out, self._settled):
            try:
                yield from rest_of(bench, waits=False)
            except core.FaultError as cause:
                bench.interlock.raise_fault(cause.fault)
                yield core.FaultRaised(bench.now_s(), cause.fault)

    def _settled(self, bench: Bench, *, waits: bool = True) -> Plan[None]:
        """Announce the previous probe once it is durable; ``waits`` for space on a full disk."""
        pending = self._pending
        if pending is None:
            return
        entry = yield from self._durable(bench, waits=waits)
        self._pending = None
        episode, where = pending.pressed.episode, pending.where
        if entry.quality.accepted:
            self.done += 1
        self._last = (entry, pending.item)
        now_s = bench.now_s()
        shown = replace(episode, episode_id=entry.uuid, recording=None)
        self._unpublished.append(
            core.EpisodeRecorded(now_s, shown, pending.pressed.probe, entry.path)
        )
        self._unpublished.append(core.ProbeCollected(
            now_s,
            uuid=entry.uuid,
            item=pending.item,
            probe=pending.pressed.probe,
            done=self.done,
            total=self.campaign.count,
            commanded_mm=xy_mm(episode.offset_mm),
            measured_mm=xy_mm(where.offset_mm),
            sigma_mm=where.sigma_mm,
            signals=last_signal_excerpt(episode.observation),
            slip_mm=episode.quality.slip_mm,
            drift_mm=pending.drift_mm,
            reasons="; ".join(episode.quality.reasons),
        ))  # fmt: skip
        yield from self._publish()

    def _publish(self) -> Plan[None]:
        """Publish the queued events; a stop between two events leaves the rest queued."""
        while self._unpublished:
            yield self._unpublished.popleft()

    def _checked(
        self, bench: Bench, origin: HandPosition, context: EpisodeContext
    ) -> Plan[EpisodeContext]:
        """Check the origin; the result is stored with every episode of the mounting."""
        check = yield from check_origin(bench, origin)
        x_mm, y_mm = check.residual_mm
        felt = f"The bottom was found {x_mm:+.2f}, {y_mm:+.2f} mm off its origin"
        fix = "." if check.agrees else ": set the origin again, because the labels have this error."
        yield core.Said(bench.now_s(), f"{felt} (s.d. {check.sigma_mm:.2f}){fix}")
        found = {"residual_mm": [x_mm, y_mm], "sigma_mm": check.sigma_mm}
        return replace(context, bench={**context.bench, "origin_check": json.dumps(found)})

    def _rest(self, bench: Bench, context: EpisodeContext) -> Plan[None]:
        """Record the held piece at rest in air, in blocks; they belong to no campaign."""
        yield from self._settled(bench)
        yield from motions.zero_sensors(bench, self._probes)
        yield core.Said(
            bench.now_s(), f"Recording {self.rest_s:g} s at rest; do not touch the bench."
        )
        context = replace(context, campaign="", plan_item=None)
        end_s, writing = bench.now_s() + self.rest_s, False
        while bench.now_s() < end_s:
            yield PausePoint()
            yield from wait_for_space(lambda: no_space_fault(self.recorder.dataset.folder))
            start_s = bench.now_s()
            yield from motions.wait(bench, min(REST_BLOCK_S, end_s - start_s))
            block = assemble_episode(
                bench.sensing.recording(start_s, bench.now_s()),
                onset_s=start_s,
                offset_mm=np.zeros(2),
                piece=bench.piece.name,
                metadata=((REST_KEY, "air"),),
            )
            still = replace(block.quality, accepted=False, reasons=(AT_REST,), slip_mm=0.0)
            # A block is written while the next one is recorded, so that they follow each other.
            if writing:
                yield from self._durable(bench, waits=True)
            self.recorder.record(replace(block, quality=still), NO_LABEL, context, "png")
            writing = True
        if writing:
            yield from self._durable(bench, waits=True)

    # -- inside -----------------------------------------------------------------------------------

    def _durable(self, bench: Bench, *, waits: bool) -> Plan[EpisodeEntry]:
        """Return the entry of the last probe; a full disk pauses until it is written."""
        while True:
            if waits:
                yield from motions.wait_while_writing(bench, lambda: self.recorder.written)
            try:
                entry = self.recorder.settle()
                assert entry is not None
                return entry
            except core.FaultError as error:
                if error.fault.code != DISK_FULL or not waits:
                    self._pending = None
                    raise
                obstacle = refused_episode_fault(error.fault)
            yield PausePoint(obstacle)

    def _grip(
        self, bench: Bench, target: ProbeTarget, origin: HandPosition, context: EpisodeContext
    ) -> Plan[None]:
        """Probe until the grip is used up: count, slip, or drift of the contact height."""
        settings = bench.settings.collect
        first_mm: float | None = None
        for _ in range(settings.probes_per_grip):
            yield PausePoint()
            yield from self._carry_out(bench)
            if not self.todo:
                return
            yield from wait_for_space(
                lambda: no_space_fault(self.recorder.dataset.folder) or bench.store.obstacle()
            )
            item = self.todo[0]
            wanted = planned_displacement_mm(
                self.campaign.pattern, target, self.campaign.seed, item,
                self.campaign.count, self.seen,
            )  # fmt: skip
            pending = yield from self._probe(bench, item, wanted, origin, first_mm)
            first_mm = pending.where.contact_mm if first_mm is None else first_mm
            self._record(pending, replace(context, plan_item=item), settings.tries)
            if self.ask:
                yield from self._settled(bench)
                assert self._last is not None
                yield core.DecisionAwaited(bench.now_s(), self._last[0].uuid, item)
                yield Wait(
                    lambda: bool(self._decisions), motions.OPERATOR_TIMEOUT_S, "the operator"
                )
            slip_mm = pending.pressed.episode.quality.slip_mm
            why = ""
            if not slip_mm <= SLIP_MM:
                why = f"it slipped by {slip_mm:.2f} mm"
            elif not pending.drift_mm <= settings.drift_mm:
                why = f"contact came {pending.drift_mm:.2f} mm off its first height"
            if why:
                yield core.Said(bench.now_s(), f"The piece is gripped again: {why}.")
                return

    def _probe(
        self,
        bench: Bench,
        item: int,
        wanted_mm: tuple[float, float],
        origin: HandPosition,
        first_mm: float | None,
    ) -> Plan[_PendingEpisode]:
        """Move to the displacement, press and lift; the previous probe is settled on the way."""
        self._probes += 1
        probe = bench.settings.probe
        there = (origin.x_mm + wanted_mm[0], origin.y_mm + wanted_mm[1])
        place = motions.descent_start(bench, there)
        if first_mm is None:
            yield from jig.approach_with_piece(bench, place)
        else:
            place = replace(place, z_mm=first_mm + probe.start_height_mm)
            yield from motions.move_to(bench, place, "the arm to shift")
        yield from self._settled(bench)
        drag_mm = self.drag_mm if self._probes % 2 else -self.drag_mm
        pressed = yield from press_once(bench, self._probes, np.array(wanted_mm), drag_mm=drag_mm)
        where = measure_offset(pressed.episode, origin, bench.settings.collect)
        yield from motions.lift(bench, self._probes)
        episode = pressed.episode
        if episode.recording is not None:
            # One more picture of the scene, after lifting.
            scene = (*episode.recording.scene, *scene_pictures(bench))
            recording = replace(episode.recording, scene=scene)
            pressed = replace(pressed, episode=replace(episode, recording=recording))
        drift_mm = 0.0 if first_mm is None else abs(where.contact_mm - first_mm)
        return _PendingEpisode(pressed, item, where, drift_mm)

    def _record(self, pending: _PendingEpisode, context: EpisodeContext, tries: int) -> None:
        """Pass the probe to the recorder; a rejected probe puts its item back into the plan.

        It is retried at once up to ``tries`` probes, then after all others, then dropped.
        """
        self.recorder.record(pending.pressed.episode, pending.where.label(), context)
        self._pending = pending
        item = self.todo.popleft()
        if pending.pressed.episode.quality.accepted:
            self.seen = self.seen.with_offset(xy_mm(pending.where.offset_mm))
            return
        self._rejected[item] += 1
        if self._rejected[item] < tries:
            self.todo.appendleft(item)
        elif self._rejected[item] == tries:
            self.todo.append(item)
        else:
            self.campaign = self.campaign.without(item)

    def _carry_out(self, bench: Bench, *, waits: bool = True) -> Plan[None]:
        """Carry out the operator's decision on the newest recorded episode.

        ``waits`` for space on a full disk; at the end of a run it does not.
        """
        self._decision = decision = self._decisions.pop() if self._decisions else self._decision
        if decision is None or self._last is None:
            self._decision = None
            return
        entry, item = self._last
        try:
            if waits:
                yield from save_or_wait(lambda: self._decide(decision, entry, item))
            else:
                self._decide(decision, entry, item)
        except core.RefusedError as cause:
            self._decision = None
            yield core.Said(bench.now_s(), f"Refused: {cause.detail}")
        except core.FaultError as cause:
            if waits or cause.fault.code != DISK_FULL:
                raise
            fault = not_saved_fault(
                self.recorder.dataset.folder,
                f"'{decision}' for item {item + 1}",
                "The probe stays in the dataset as it was.",
                "press Reset, choose the probe and decide again.",
            )
            raise core.FaultError(fault) from cause
        else:
            self._decision = None
            yield core.EpisodeDecided(bench.now_s(), entry.uuid, item, decision, entry.person)

    def _decide(self, decision: core.EpisodeDecision, entry: EpisodeEntry, item: int) -> None:
        labels = self.recorder.dataset.labels
        if decision == "keep":
            return
        if decision == "flag":
            labels.flag(entry.person, entry.uuid)
            return
        labels.delete(entry.person, entry.uuid, messages.DECISION_WORDS[decision])
        self._last = None
        if entry.quality.accepted:
            self.done -= 1
        if item in self.todo:
            self.todo.remove(item)
        if decision == "discard":
            self.todo.append(item)
        elif decision == "redo":
            self.todo.appendleft(item)
        else:
            self.campaign = self.campaign.without(item)
