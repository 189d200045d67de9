"""The probes of a campaign on one bench: grip after grip, each probe recorded with its label."""

from __future__ import annotations

import json
from collections import Counter, deque
from dataclasses import dataclass, replace

import numpy as np

from backend.catalogue.values import EpisodeContext, EpisodeEntry
from backend.core.facts import (
    Decision,
    DecisionAwaited,
    EpisodeDecided,
    EpisodeRecorded,
    Fact,
    FaultRaised,
    Gripped,
    ProbeCollected,
    Said,
)
from backend.core.faults import FaultError, RefusedError
from backend.core.flow import Episode
from backend.dataset.coverage import Coverage
from backend.runs import words
from backend.runs.bench import Bench
from backend.runs.campaign import Campaign
from backend.runs.collect_plan import Target, planned_mm
from backend.runs.collected import (
    EpisodeRecorder,
    Measured,
    Origin,
    last_signals,
    measured,
)
from backend.runs.descents import place_over
from backend.runs.gate import Decisions
from backend.runs.jig import approach, handed, pick, put_back
from backend.runs.judged import Felt
from backend.runs.motions import go, lift, rest
from backend.runs.origin_check import check_origin
from backend.runs.plan import Checkpoint, Plan, Waiting
from backend.runs.probe import press_once, scene_pictures
from backend.runs.room import (
    FULL,
    no_room,
    not_decided,
    refused_episode,
    room_awaited,
    saved,
    writing,
)
from backend.sensing.episode import EpisodeLimits

OPERATOR_S = 24 * 3600.0
SLIP_MM = EpisodeLimits().slip_mm
FIRST_POSES_S = 0.1
"""A scene that was just set has no pose of the arm yet."""


@dataclass(frozen=True, slots=True)
class _Taken:
    """A probe on its way to the disk."""

    felt: Felt
    item: int
    where: Measured
    drift_mm: float


class Collector:
    """Works off the items of a campaign; lives as long as its run, whatever the mounting."""

    def __init__(
        self,
        campaign: Campaign,
        recorder: EpisodeRecorder,
        decisions: Decisions,
        seen: Coverage,
        entries: list[EpisodeEntry],
    ) -> None:
        self.campaign, self.recorder, self._decisions = campaign, recorder, decisions
        self.seen = seen
        self.todo = deque(campaign.todo(entries))
        self.done = sum(e.quality.accepted and not e.deleted for e in entries)
        self.ask = self.check_origin = self.hand_over = False
        self._rejected: Counter[int] = Counter()
        self._probes = 0
        self._taken: _Taken | None = None
        self._last: tuple[EpisodeEntry, int] | None = None
        self._said: Decision | None = None
        """What was decided about the last one, until it is carried out."""
        self._untold: deque[Fact] = deque()
        """Facts about a probe that is durable, in their order."""

    def mounting(
        self, bench: Bench, target: Target, origin: Origin, context: EpisodeContext, after: int = 0
    ) -> Plan[bool]:
        """Grip and probe until nothing is left to do, or the bottom is due to be fitted anew.

        ``after`` so many grips that were made on it before; one more at least is made.
        """
        if self.hand_over or bench.jig is None:
            yield from rest(bench, FIRST_POSES_S)
            bench = handed(bench)
        first = after + 1
        most = max(first, bench.settings.collect.grips_per_mounting)
        for grip in range(first, most + 1):
            if not self.todo:
                break
            mass_g = yield from pick(bench)
            yield Gripped(bench.now_s(), grip, self.campaign.mountings, mass_g)
            if self.check_origin and grip == first:
                context = yield from self._checked(bench, origin, context)
            held = replace(context, grip_id=f"{context.mounting_id}/grip-{grip}")
            yield from self._grip(bench, target, origin, held)
            yield from put_back(bench)
            yield from self._settled(bench)
            yield from self._carry_out(bench)
        return True

    def settle(self, bench: Bench) -> Plan[None]:
        """Announce the probe on which a mounting ended early; a disk that refuses it is a fault.

        Whatever ended it: what is in the dataset is told, also where only part of it was told yet,
        and what was decided before the end is carried out.
        """
        yield from self._tell()
        for rest_of in (self._carry_out, self._settled):
            try:
                yield from rest_of(bench, waits=False)
            except FaultError as cause:
                bench.interlock.raise_fault(cause.fault)
                yield FaultRaised(bench.now_s(), cause.fault)

    def _settled(self, bench: Bench, *, waits: bool = True) -> Plan[None]:
        """Announce the probe before, once it is durable; ``waits`` for room on a full disk."""
        taken = self._taken
        if taken is None:
            return
        entry = yield from self._durable(bench, waits=waits)
        self._taken = None
        episode, where = taken.felt.episode, taken.where
        if entry.quality.accepted:
            self.done += 1
        self._last = (entry, taken.item)
        now_s = bench.now_s()
        shown = replace(episode, episode_id=entry.uuid, recording=None)
        self._untold.append(EpisodeRecorded(now_s, shown, taken.felt.probe, entry.path))
        self._untold.append(ProbeCollected(
            now_s,
            uuid=entry.uuid,
            item=taken.item,
            probe=taken.felt.probe,
            done=self.done,
            total=self.campaign.count,
            commanded_mm=_pair(episode.offset_mm),
            measured_mm=_pair(where.offset_mm),
            sigma_mm=where.sigma_mm,
            signals=last_signals(episode.observation),
            slip_mm=episode.quality.slip_mm,
            drift_mm=taken.drift_mm,
            reasons="; ".join(episode.quality.reasons),
        ))  # fmt: skip
        yield from self._tell()

    def _tell(self) -> Plan[None]:
        """Announce what is durable; a stop between two facts leaves the second for later."""
        while self._untold:
            yield self._untold.popleft()

    def _checked(
        self, bench: Bench, origin: Origin, context: EpisodeContext
    ) -> Plan[EpisodeContext]:
        """Feel the edges of the bottom; the result goes with every episode of the mounting."""
        check = yield from check_origin(bench, origin)
        x_mm, y_mm = check.residual_mm.tolist()
        yield Said(bench.now_s(), words.origin(x_mm, y_mm, check.sigma_mm, check.agrees))
        found = {"residual_mm": [x_mm, y_mm], "sigma_mm": check.sigma_mm}
        return replace(context, bench={**context.bench, "origin_check": json.dumps(found)})

    # -- inside -----------------------------------------------------------------------------------

    def _durable(self, bench: Bench, *, waits: bool) -> Plan[EpisodeEntry]:
        """Return the entry of the last probe; a full disk pauses the campaign until it is there."""
        while True:
            if waits:
                yield from writing(bench, lambda: self.recorder.written)
            try:
                return self.recorder.settle()
            except FaultError as error:
                if error.fault.code != FULL or not waits:
                    self._taken = None
                    raise
                obstacle = refused_episode(error.fault)
            yield Checkpoint(obstacle)

    def _grip(
        self, bench: Bench, target: Target, origin: Origin, context: EpisodeContext
    ) -> Plan[None]:
        """Probe until this grip is used up: too many probes, slipped, or drifted."""
        settings = bench.settings.collect
        first_mm: float | None = None
        for _ in range(settings.probes_per_grip):
            yield Checkpoint()
            yield from self._carry_out(bench)
            if not self.todo:
                return
            yield from room_awaited(
                lambda: no_room(self.recorder.dataset.folder) or bench.store.obstacle()
            )
            item = self.todo[0]
            wanted = planned_mm(
                self.campaign.pattern, target, self.campaign.seed, item,
                self.campaign.count, self.seen,
            )  # fmt: skip
            taken = yield from self._probe(bench, item, wanted, origin, first_mm)
            first_mm = taken.where.contact_mm if first_mm is None else first_mm
            self._enter(taken, replace(context, plan_item=item))
            if self.ask:
                yield from self._settled(bench)
                yield from self._asked(bench)
            slip_mm = taken.felt.episode.quality.slip_mm
            if not slip_mm <= SLIP_MM:
                yield Said(bench.now_s(), words.regrip(f"it slipped by {slip_mm:.2f} mm"))
                return
            if not taken.drift_mm <= settings.drift_mm:
                drifted = f"contact came {taken.drift_mm:.2f} mm off its first height"
                yield Said(bench.now_s(), words.regrip(drifted))
                return

    def _probe(
        self,
        bench: Bench,
        item: int,
        wanted_mm: tuple[float, float],
        origin: Origin,
        first_mm: float | None,
    ) -> Plan[_Taken]:
        """Go there, press, and lift off again; the probe before is settled on the way."""
        self._probes += 1
        probe = bench.settings.probe
        there = (origin.x_mm + wanted_mm[0], origin.y_mm + wanted_mm[1])
        place = place_over(bench, there)
        if first_mm is not None:
            place = replace(place, z_mm=first_mm + probe.start_height_mm)
        if first_mm is None:
            yield from approach(bench, place)
        else:
            yield from go(bench, place, "the arm to shift")
        yield from self._settled(bench)
        felt = yield from press_once(bench, self._probes, np.array(wanted_mm))
        where = measured(felt.episode, origin, bench.settings.collect)
        yield from lift(bench, self._probes)
        felt = replace(felt, episode=_with_outcome(felt.episode, bench))
        drift_mm = 0.0 if first_mm is None else abs(where.contact_mm - first_mm)
        return _Taken(felt, item, where, drift_mm)

    def _enter(self, taken: _Taken, context: EpisodeContext) -> None:
        """Give the probe to the recorder, and the item back to the plan if it is none."""
        self.recorder.record(taken.felt.episode, taken.where.label(), context)
        self._taken = taken
        item = self.todo.popleft()
        if taken.felt.episode.quality.accepted:
            self.seen = self.seen.with_offset(_pair(taken.where.offset_mm))
            return
        self._rejected[item] += 1
        # Once more at once, then after all others, then never: one bad place holds up nothing.
        if self._rejected[item] == 1:
            self.todo.appendleft(item)
        elif self._rejected[item] == 2:
            self.todo.append(item)
        else:
            self.campaign = self.campaign.without(item)

    def _asked(self, bench: Bench) -> Plan[None]:
        assert self._last is not None
        entry, item = self._last
        yield DecisionAwaited(bench.now_s(), entry.uuid, item)
        yield Waiting(lambda: self._decisions.given, OPERATOR_S, "the operator")

    def _carry_out(self, bench: Bench, *, waits: bool = True) -> Plan[None]:
        """Carry out what the operator decided about the newest recorded episode.

        ``waits`` for room on a full disk; what the end of the run cuts short is done at its end.
        """
        self._said = decision = self._decisions.take() or self._said
        if decision is None or self._last is None:
            self._said = None
            return
        entry, item = self._last
        try:
            if waits:
                yield from saved(lambda: self._decide(decision, entry, item))
            else:
                self._decide(decision, entry, item)
        except RefusedError as cause:
            self._said = None
            yield Said(bench.now_s(), f"Refused: {cause.detail}")
        except FaultError as cause:
            if waits or cause.fault.code != FULL:
                raise
            folder = self.recorder.dataset.folder
            raise FaultError(not_decided(folder, decision, item)) from cause
        else:
            self._said = None
            yield EpisodeDecided(bench.now_s(), entry.uuid, item, decision, entry.person)

    def _decide(self, decision: Decision, entry: EpisodeEntry, item: int) -> None:
        labels = self.recorder.dataset.labels
        if decision == "keep":
            return
        if decision == "flag":
            labels.flag(entry.person, entry.uuid)
            return
        labels.delete(entry.person, entry.uuid, words.DECIDED[decision])
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


def _with_outcome(episode: Episode, bench: Bench) -> Episode:
    """Return the episode with one more picture of the scene: after lifting."""
    if episode.recording is None:
        return episode
    scene = (*episode.recording.scene, *scene_pictures(bench))
    return replace(episode, recording=replace(episode.recording, scene=scene))


def _pair(place: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> tuple[float, float]:
    return float(place[0]), float(place[1])
