"""Presenter of the collect workspace."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime

from PySide6.QtWidgets import QApplication

from touchdown.app.collect.origin import CampaignPace, OriginCheckNote, RecorderGauge
from touchdown.app.collect.page import CollectPage, OriginField
from touchdown.app.collect.probes import PairProbes, ProbeRecord, read_pair, read_probe
from touchdown.app.collect.requests import (
    CampaignState,
    apply_decision,
    campaign_buttons,
    collect_request,
    probe_text,
)
from touchdown.app.shell import (
    ACTIVE_STATES,
    SaveWorker,
    refusal_card,
)
from touchdown.backend.annotations import Dataset, EpisodeEntry, EpisodeFilter, check_person
from touchdown.backend.bench import Session
from touchdown.backend.core import (
    CampaignBegan,
    DecisionAwaited,
    EpisodeDecided,
    EpisodeDecision,
    Event,
    Gripped,
    HandOverAwaited,
    InputError,
    MountingAwaited,
    OriginChecked,
    PhaseEntered,
    ProbeCollected,
    RefusedError,
    RunFinished,
    RunStarted,
    TouchdownError,
)
from touchdown.backend.episodes import check_quality
from touchdown.backend.geometry import PieceLibrary
from touchdown.backend.runs import (
    Campaign,
    CollectRequest,
    RunState,
    current_campaign,
    newest_campaign,
)
from touchdown.widgets.forms import ProbeText, TargetButtons
from touchdown.widgets.shell import CardText, FaultCards


class ProbesPresenter:
    """Maps, table and findings of one pair. ``chosen``: the probe that is looked at, "" for the
    one that was recorded ``last``. ``failed`` is told what could not be read.
    """

    def __init__(
        self,
        page: CollectPage,
        reader: SaveWorker,
        catalogue: PieceLibrary,
        failed: Callable[[Exception], None],
    ) -> None:
        self._page, self._reader, self._catalogue = page, reader, catalogue
        self._failed = failed
        self.dataset: Dataset | None = None
        self.harvest: PairProbes | None = None
        self.chosen = self.last = ""
        self._pair = ("", "")
        self._read_from: Dataset | None = None
        self._stale, self._judging = True, False

    @property
    def shown(self) -> str:
        """Uuid of the probe that is shown, "" if there is none."""
        return self.chosen or self.last

    def held(self) -> ProbeRecord | None:
        """Return the probe that is shown, None if it is not of this pair."""
        return None if self.harvest is None else self.harvest.get(self.shown)

    def restyle(self) -> None:
        """Draw maps and table anew."""
        self._stale = True

    def choose(self, uuid: str) -> None:
        """Show one probe; the last one follows the run again."""
        self.chosen = "" if uuid == self.last else uuid
        self._stale = True

    def choose_dot(self, index: int) -> None:
        """Show the probe of a dot."""
        if self.harvest is not None:
            self.choose(self.harvest.shown()[index].entry.uuid)

    # -- reading ----------------------------------------------------------------------------------

    def show_pair(self, piece: str, bottom: str) -> None:
        """Read what the dataset holds of a pair, unless it is the one that is shown."""
        pair = piece, bottom
        if pair == self._pair and self.dataset is self._read_from:
            return
        try:
            face, outline = (self._catalogue.piece(name).face for name in pair)
        except InputError:
            return
        self._pair, self._read_from, dataset = pair, self.dataset, self.dataset
        self.harvest, self._stale, self.last, self.chosen = PairProbes(face, outline), True, "", ""
        if dataset is None:
            return
        self._page.episodes.detail.setText("reading")

        def done(held: list[ProbeRecord]) -> None:
            if pair == self._pair and dataset is self._read_from:
                self.harvest = PairProbes(face, outline, held)
                self.last, self._stale = self.harvest.newest, True
                self._judge()

        self._reader.submit(lambda: read_pair(dataset, *pair), done, self._failed)

    def read(self, uuid: str, came: Callable[[ProbeRecord], None] | None = None) -> None:
        """Read a probe again; with ``came`` it is new, read with its signals and handed on."""
        dataset = self.dataset
        if dataset is None:
            return

        def done(held: ProbeRecord) -> None:
            if came is not None:
                came(held)
            self.put(held)

        self._reader.submit(
            lambda: read_probe(dataset, dataset.entry(uuid), signals=came is not None),
            done,
            self._failed,
        )

    def put(self, held: ProbeRecord) -> None:
        """Take a probe, or a later state of one, if it is of the pair."""
        if self.harvest is not None and (held.entry.piece, held.entry.bottom) == self._pair:
            self.harvest.put(held)
            self._stale = True
            self._judge()

    def _judge(self) -> None:
        """Look for findings, one judgement at a time."""
        if self._judging or self.harvest is None:
            return
        rows, self._judging = self.harvest.examined, True

        def done(texts: list[str]) -> None:
            self._judging = False
            self._page.health.show_findings(texts, judged=len(rows))
            if self.harvest is not None and len(self.harvest.examined) != len(rows):
                self._judge()

        def failed(error: Exception) -> None:
            self._judging = False
            self._failed(error)

        self._reader.submit(
            lambda: [f"{f.kind}: {f.text}" for f in check_quality(rows)], done, failed
        )

    # -- showing ----------------------------------------------------------------------------------

    def draw(self, words: Callable[[ProbeRecord | None], ProbeText]) -> None:
        """Show the probes if they changed; ``words`` tells of the one that is shown."""
        if not self._stale or self.harvest is None:
            return
        self._stale, page = False, self._page
        seen = self.harvest.covered
        page.coverage.show_scene(self.harvest.bins(self.shown))
        signal = page.signal.currentIndex()
        page.distribution.show_scene(self.harvest.distribution(signal, self.shown))
        possible = int(seen.possible.sum())
        page.coverage_caption.detail.setText(
            f"{possible - seen.holes} of {possible} bins of {seen.bin_mm:g} mm"
        )
        rows = self.harvest.rows(deleted=page.deleted.isChecked())
        page.table.show_rows(rows, self.shown)
        page.episodes.detail.setText(f"{len(rows)} of {' on '.join(self._pair)}")
        page.probe.show_words(words(self.held()))


DISCARDING_DECISIONS = frozenset(("discard", "redo", "skip"))


class CampaignProgress:
    """Follows the facts of a run, and what is decided beside it about probes of its campaign."""

    def __init__(self) -> None:
        self.campaign, self.total = "", 1
        self._done = 0
        self._accepted: set[str] = set()
        self._taken_back: set[str] = set()
        self._beside: set[str] = set()

    @property
    def done(self) -> int:
        """Accepted probes that are still there."""
        return self._done - len(self._beside)

    def begin(self, fact: CampaignBegan) -> None:
        """Take the count with which a run begins: what the dataset holds."""
        self.campaign, self.total, self._done = fact.campaign, fact.total, fact.done
        self._accepted, self._taken_back, self._beside = set(), set(), set()

    def collected(self, fact: ProbeCollected) -> None:
        """Take one more probe."""
        self._done, self.total = fact.done, fact.total
        if not fact.reasons:
            self._accepted.add(fact.uuid)

    def decided(self, fact: EpisodeDecided) -> None:
        """Take a decision that the run carried out; its next probe tells the same number."""
        if fact.decision in DISCARDING_DECISIONS and fact.uuid in self._accepted - self._taken_back:
            self._taken_back.add(fact.uuid)
            self._done -= 1

    def stored(self, entry: EpisodeEntry) -> None:
        """Take a probe as it is in the dataset now, of which the run knows nothing."""
        if entry.campaign != self.campaign or not entry.quality.accepted:
            return
        if entry.uuid in self._taken_back:
            return
        if entry.deleted:
            self._beside.add(entry.uuid)
        else:
            self._beside.discard(entry.uuid)


GAUGE_S = 1.0
LIFT_MM, LIFT_MM_S = 5.0, 5.0


class CollectPresenter:
    """Follows the campaign that runs, and the probes that the dataset holds of the chosen pair."""

    def __init__(
        self,
        page: CollectPage,
        cards: FaultCards,
        reader: SaveWorker,
        catalogue: PieceLibrary,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._page, self._cards, self._reader, self._now_s = page, cards, reader, now_s
        self.probes = ProbesPresenter(page, reader, catalogue, self._failed)
        self.origin = OriginField(page.target)
        self.person = ""
        self.bench: Session | None = None
        self._asking = self._mine = False
        self._asked: HandOverAwaited | MountingAwaited | None = None
        self._campaign, self._go_on = "", ""
        self._pace, self._gauge, self._progress = (
            CampaignPace(),
            RecorderGauge(),
            CampaignProgress(),
        )
        self._gauge_s = float("-inf")
        self._buttons: TargetButtons | None = None

    # -- what there is ----------------------------------------------------------------------------

    @property
    def dataset(self) -> Dataset | None:
        """The dataset that is open."""
        return self.probes.dataset

    def attach(self, bench: Session) -> None:
        """Take a bench; it collects into the dataset that is open."""
        self.bench = bench
        bench.dataset = self.dataset
        if not bench.simulated:
            self._show_pair(bench.usual.piece, bench.usual.bottoms[-1])

    def take_dataset(self, dataset: Dataset, *, read: bool) -> None:
        """Take the dataset that was opened; ``read`` what it holds of the pair, if it is seen.

        Ten thousand probes take five seconds, in which every turn of the window waits.
        """
        self.probes.dataset = dataset
        if self.bench is not None:
            self.bench.dataset = dataset
        self._read_campaign()
        if read:
            self.choose_pair()

    def choose_pair(self) -> None:
        """Show the probes of the pair in the form."""
        form = self._page.target.form()
        self.probes.show_pair(form.piece, form.bottom)

    # -- orders -----------------------------------------------------------------------------------

    def start(self) -> None:
        """F5: say yes to what waits (keep the probe, the hand at the jaws), else begin anew."""
        if self._asked is not None:
            self._answer(True)
        elif self._asking:
            self.decide("keep")
        else:
            self._begin(collect_request(self._page.target.form(), self.person))

    def go_on(self) -> None:
        """Continue the newest campaign, or say that its mounting is as it was."""
        if isinstance(self._asked, MountingAwaited):
            self._answer(False)
        elif self._campaign:
            form = self._page.target.form()
            self._begin(collect_request(form, self.person, campaign=self._campaign))

    def _answer(self, yes: bool) -> None:
        if self.bench is not None:
            self._asked = None
            self.bench.answer(yes)

    def _begin(self, request: CollectRequest) -> None:
        bench = self.bench
        if bench is None or bench.status().state in ACTIVE_STATES:
            return
        if not request.person:
            # The line below the button says so; here the name can be typed at once.
            self._page.target.ask_person()
            return
        try:
            check_person(request.person)
            bench.dataset = self.dataset
            bench.start(request)
        except RefusedError as error:
            self._refused(error)
        except InputError as error:
            self._cards.show_card(
                CardText("INPUT", error.what, f"In {error.where}.", error.fix, reset=False)
            )

    def lift(self) -> None:
        """Rise off what is below, so that something can be started."""
        if self.bench is None or self.bench.hand is None:
            return
        try:
            self.bench.hand.jog.step("z", "XYZ", LIFT_MM, LIFT_MM_S)
        except RefusedError as error:
            self._refused(error)

    def _refused(self, error: RefusedError) -> None:
        self._cards.show_card(refusal_card(error, f"{datetime.now():%H:%M:%S}"))

    def pause_or_resume(self) -> None:
        """Pause at the next safe place, or go on."""
        if self.bench is None or not self._mine:
            return
        if self.bench.status().state in (RunState.PAUSED, RunState.PAUSING):
            self.bench.engine.resume()
        else:
            self.bench.engine.pause()

    def end(self) -> None:
        """End the run in an orderly way; the campaign can go on later."""
        if self.bench is not None and self._mine:
            self.bench.engine.cancel()

    def decide(self, decision: EpisodeDecision) -> None:
        """Say what becomes of the probe that is shown: the chosen one, else the last."""
        uuid, held = self.probes.shown, self.probes.held()
        if self.dataset is None or held is None or not self.person:
            return
        if decision not in self._words(held).allowed:
            return
        if self._mine and uuid == self.probes.last and self.bench is not None:
            self._asking = False
            self.bench.decide(decision)
        else:
            dataset, person = self.dataset, self.person
            self._reader.submit(
                lambda: apply_decision(dataset, person, uuid, decision),
                self._decided_beside,
                self._failed,
            )
        self.probes.restyle()

    def _decided_beside(self, held: ProbeRecord) -> None:
        """Have the bar and *Continue* follow a decision that is in the dataset by now."""
        self.probes.put(held)
        if self._mine:
            self._progress.stored(held.entry)
            self._show_done()
        else:
            self._read_campaign()

    def set_origin_here(self) -> None:
        """Take the place of the arm as the origin."""
        if self._buttons is not None and not self._buttons.end:
            self.origin.set_here(self.bench)

    def take_origin(self) -> None:
        """Add the residual of the last check to the origin in the form."""
        if self._buttons is not None and not self._buttons.end:
            self.origin.take_residual()

    # -- facts ------------------------------------------------------------------------------------

    def take(self, fact: Event) -> None:
        """Follow a run that collects."""
        if isinstance(fact, RunStarted):
            self._mine = fact.activity == "collect"
            if self._mine:
                self._pace.restart(self._now_s())
                self.probes.chosen = ""
                self._show_pair(fact.piece, fact.bottom)
        if not self._mine:
            return
        if isinstance(fact, CampaignBegan):
            self._campaign = fact.campaign
            self._progress.begin(fact)
            self._show_done()
        elif isinstance(fact, ProbeCollected):
            self._collected(fact)
        elif isinstance(fact, DecisionAwaited):
            self._asking, self.probes.last = True, fact.uuid
            self.probes.restyle()
        elif isinstance(fact, EpisodeDecided):
            self._asking = False
            self._progress.decided(fact)
            self._show_done()
            self.probes.read(fact.uuid)
        elif isinstance(fact, RunFinished):
            self._ended(fact)
        else:
            self._tell(fact)

    def _tell(self, fact: Event) -> None:
        """Show where the run is."""
        if isinstance(fact, HandOverAwaited | MountingAwaited):
            self._asked = fact
        elif isinstance(fact, Gripped):
            text = f"mounting {fact.mounting}, grip {fact.grip}, {fact.mass_g:.1f} g held"
            self._page.live.detail.setText(text)
        elif isinstance(fact, PhaseEntered):
            self._asked = None
            self._page.target.detail.setText(fact.phase)
        elif isinstance(fact, OriginChecked):
            self.origin.show_note(OriginCheckNote.of(fact, datetime.now()))

    def _show_pair(self, piece: str, bottom: str) -> None:
        """Follow a campaign of another pair: one that goes on has its own plan."""
        target = self._page.target
        target.show_form(replace(target.form(), piece=piece, bottom=bottom))

    def _collected(self, fact: ProbeCollected) -> None:
        self._pace.note(self._now_s())
        self.probes.last = fact.uuid
        self._progress.collected(fact)
        self._show_done()
        self.probes.read(fact.uuid, lambda held: self._gauge.note(self._now_s(), held.entry.bytes))

    def _show_done(self) -> None:
        done, total = self._progress.done, self._progress.total
        self._page.target.show_progress(done, total, self._pace.words(total - done))

    def _ended(self, fact: RunFinished) -> None:
        self._mine = self._asking = False
        self._asked = None
        self._page.target.detail.setText("")
        self._page.live.detail.setText("")
        self._page.target.eta.setText(fact.reason)
        self._read_campaign()
        self.probes.restyle()

    def _read_campaign(self) -> None:
        """Find out how far the last campaign came, and whether it can go on."""
        dataset = self.dataset
        if dataset is None:
            return

        def look() -> tuple[Campaign, int] | None:
            uuid = newest_campaign(dataset.folder)
            if uuid is None:
                return None
            plan = current_campaign(dataset, uuid)
            return plan, len(plan.todo(dataset.episodes(EpisodeFilter(campaign=uuid))))

        def done(found: tuple[Campaign, int] | None) -> None:
            if found is None or self._mine:
                return
            plan, left = found
            what = "1 probe is" if left == 1 else f"{left} probes are"
            self._campaign = plan.uuid if left else ""
            self._go_on = f"Continue {plan.piece} on {plan.bottom}: {what} left" if left else ""
            target = self._page.target
            came = plan.count - left - len(plan.skipped)
            target.show_progress(came, plan.count, target.eta.text())

        self._reader.submit(look, done, self._failed)

    def _failed(self, error: Exception) -> None:
        what = error.what if isinstance(error, InputError) else str(error)
        fix = error.fix if isinstance(error, InputError) else ""
        code = "DATASET" if not isinstance(error, TouchdownError) else type(error).__name__
        self._cards.show_card(CardText(code.upper(), what, "", fix, reset=False))

    # -- showing ----------------------------------------------------------------------------------

    def draw(self) -> None:
        """Show what changed."""
        now = CampaignState(self.person, self.dataset, self._mine, self._go_on, self._asked)
        wanted = campaign_buttons(self.bench, now)
        if wanted != self._buttons:
            self._buttons = wanted
            focused = QApplication.focusWidget()
            self._page.target.show_buttons(wanted)
            if focused is not None and not focused.isEnabled():
                # Qt would have handed the focus on to some field.
                self._page.setFocus()
        now_s = self._now_s()
        if now_s - self._gauge_s >= GAUGE_S and self.dataset is not None:
            self._gauge_s = now_s
            self._page.recorder.setText(self._gauge.words(self.dataset.folder, now_s))

    def draw_maps(self) -> None:
        """Show the probes if they changed."""
        self.probes.draw(self._words)

    def _words(self, held: ProbeRecord | None) -> ProbeText:
        back = bool(self.probes.chosen)
        return probe_text(held, asking=self._asking and not back, running=self._mine, back=back)
