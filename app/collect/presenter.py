"""Presenter of the Collect half: orders to the bench, facts and the dataset to views."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime

from app.activity import ACTIVE
from app.cards import refusal_card
from app.collect.decide import decide_stored, words_of
from app.collect.gauge import Pace, RecorderGauge
from app.collect.harvest import Harvest, Held, read_pair, read_probe
from app.collect.origin import OriginNote, residual_words
from app.collect.page import CollectPage
from app.collect.request import request_of
from app.label.commits import Commits
from app.link import Link
from backend.catalogue.dataset import Dataset
from backend.catalogue.review import check_person
from backend.catalogue.values import EpisodeFilter
from backend.core.facts import (
    CampaignBegan,
    Decision,
    DecisionAwaited,
    EpisodeDecided,
    Fact,
    Gripped,
    OriginChecked,
    PhaseEntered,
    ProbeCollected,
    RunFinished,
    RunStarted,
)
from backend.core.faults import InputError, RefusedError, TouchdownError
from backend.dataset.health import examine
from backend.objects.catalogue import Catalogue
from backend.runs.campaign import newest_campaign, read_campaign
from backend.runs.requests import CollectRequest, RunState
from widgets.fault_cards import CardText, FaultCards
from widgets.last_probe_panel import ProbeWords
from widgets.target_panel import TargetButtons

GAUGE_S = 1.0


class CollectPresenter:
    """Follows the campaign that runs, and the probes that the dataset holds of the chosen pair."""

    def __init__(
        self,
        page: CollectPage,
        cards: FaultCards,
        reader: Commits,
        catalogue: Catalogue,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._page, self._cards, self._reader, self._now_s = page, cards, reader, now_s
        self._catalogue = catalogue
        self.person = ""
        self.link: Link | None = None
        self.dataset: Dataset | None = None
        self.harvest: Harvest | None = None
        self.note: OriginNote | None = None
        self.chosen = ""
        self._pair = ("", "")
        self._read_from: Dataset | None = None
        self._last = ""
        self._asking = self._mine = False
        self._campaign, self._go_on = "", ""
        self._pace, self._gauge = Pace(), RecorderGauge()
        self._gauge_s = float("-inf")
        self._buttons: TargetButtons | None = None
        self._stale, self._judging = True, False

    # -- what there is ----------------------------------------------------------------------------

    def attach(self, link: Link) -> None:
        """Take a bench; it collects into the dataset that is open."""
        self.link = link
        link.dataset = self.dataset

    def take_dataset(self, dataset: Dataset) -> None:
        """Take the dataset that was opened, and read what it holds of the pair."""
        self.dataset = dataset
        if self.link is not None:
            self.link.dataset = dataset
        self._read_campaign()
        self.choose_pair()

    def choose_pair(self) -> None:
        """Show the probes of the pair in the form."""
        form = self._page.target.form()
        pair = form.piece, form.bottom
        if pair == self._pair and self.dataset is self._read_from:
            return
        try:
            face, outline = (self._catalogue.piece(name).face for name in pair)
        except InputError:
            return
        self._pair, self._read_from, dataset = pair, self.dataset, self.dataset
        self.harvest, self._stale, self._last, self.chosen = Harvest(face, outline), True, "", ""
        if dataset is None:
            return
        self._page.episodes.detail.setText("reading")

        def done(held: list[Held]) -> None:
            if pair == self._pair and dataset is self._read_from:
                self.harvest = Harvest(face, outline, held)
                self._last, self._stale = self.harvest.newest, True
                self._judge()

        self._reader.submit(lambda: read_pair(dataset, *pair), done, self._failed)

    # -- orders -----------------------------------------------------------------------------------

    def start(self) -> None:
        """F5: answer the question that waits with keep, else begin a new campaign."""
        if self._asking:
            self.decide("keep")
        else:
            self._begin(request_of(self._page.target.form(), self.person))

    def go_on(self) -> None:
        """Go on with the newest campaign."""
        if self._campaign:
            form = self._page.target.form()
            self._begin(request_of(form, self.person, campaign=self._campaign))

    def _begin(self, request: CollectRequest) -> None:
        link = self.link
        if link is None or link.status().state in ACTIVE:
            return
        try:
            check_person(request.person)
            link.dataset = self.dataset
            link.start(request)
        except RefusedError as error:
            self._cards.show_card(refusal_card(error, f"{datetime.now():%H:%M:%S}"))
        except InputError as error:
            self._cards.show_card(
                CardText("INPUT", error.what, f"In {error.where}.", error.fix, reset=False)
            )

    def pause_or_resume(self) -> None:
        """Pause at the next safe place, or go on."""
        if self.link is None or not self._mine:
            return
        if self.link.status().state in (RunState.PAUSED, RunState.PAUSING):
            self.link.engine.resume()
        else:
            self.link.engine.pause()

    def end(self) -> None:
        """End the run in an orderly way; the campaign can go on later."""
        if self.link is not None and self._mine:
            self.link.engine.cancel()

    def decide(self, decision: Decision) -> None:
        """Say what becomes of the probe that is shown: the chosen one, else the last."""
        uuid = self.chosen or self._last
        held = self.harvest.get(uuid) if self.harvest is not None else None
        if self.dataset is None or held is None or not self.person:
            return
        if decision not in self._words(held).allowed:
            return
        if self._mine and uuid == self._last and self.link is not None:
            self._asking = False
            self.link.decide(decision)
        else:
            dataset, person = self.dataset, self.person
            self._reader.submit(
                lambda: decide_stored(dataset, person, uuid, decision), self._put, self._failed
            )
        self._stale = True

    def choose_dot(self, index: int) -> None:
        """Show the probe of a dot."""
        if self.harvest is not None:
            self.choose(self.harvest.shown()[index].entry.uuid)

    def choose(self, uuid: str) -> None:
        """Show one probe; the last one follows the run again."""
        self.chosen = "" if uuid == self._last else uuid
        self._stale = True

    def restyle(self) -> None:
        """Draw maps and table anew: another signal, or deleted ones too."""
        self._stale = True

    def take_origin(self) -> None:
        """Add the residual of the last check to the origin in the form."""
        if self.note is not None and self._buttons is not None and not self._buttons.end:
            x, y = self._page.target.origin
            x.setValue(x.value() + self.note.residual_mm[0])
            y.setValue(y.value() + self.note.residual_mm[1])
            self.show_note(self.note.taken())

    def show_note(self, note: OriginNote | None) -> None:
        """Show what the last check of the origin found."""
        self.note = note
        usable = note is not None and not note.used
        self._page.target.show_residual(residual_words(note), usable=usable)

    # -- facts ------------------------------------------------------------------------------------

    def take(self, fact: Fact) -> None:
        """Follow a run that collects."""
        if isinstance(fact, RunStarted):
            self._mine = fact.activity == "collect"
            if self._mine:
                self._pace.restart(self._now_s())
                self.chosen = ""
                self._show_pair(fact.piece, fact.bottom)
        if not self._mine:
            return
        if isinstance(fact, CampaignBegan):
            self._campaign = fact.campaign
            self._show_done(fact.done, fact.total)
        elif isinstance(fact, ProbeCollected):
            self._collected(fact)
        elif isinstance(fact, DecisionAwaited):
            self._asking, self._last, self._stale = True, fact.uuid, True
        elif isinstance(fact, EpisodeDecided):
            self._asking = False
            self._read(fact.uuid)
        elif isinstance(fact, RunFinished):
            self._ended(fact)
        else:
            self._tell(fact)

    def _tell(self, fact: Fact) -> None:
        """Show where the run is."""
        if isinstance(fact, Gripped):
            text = f"mounting {fact.mounting}, grip {fact.grip}, {fact.mass_g:.1f} g held"
            self._page.live.detail.setText(text)
        elif isinstance(fact, PhaseEntered):
            self._page.target.detail.setText(fact.phase)
        elif isinstance(fact, OriginChecked):
            self.show_note(OriginNote.of(fact, datetime.now()))

    def _show_pair(self, piece: str, bottom: str) -> None:
        """Follow a campaign of another pair: one that goes on has its own plan."""
        target = self._page.target
        target.show_form(replace(target.form(), piece=piece, bottom=bottom))

    def _collected(self, fact: ProbeCollected) -> None:
        self._pace.note(self._now_s())
        self._last = fact.uuid
        self._show_done(fact.done, fact.total)
        self._read(fact.uuid, new=True)

    def _show_done(self, done: int, total: int) -> None:
        self._page.target.show_progress(done, total, self._pace.words(total - done))

    def _ended(self, fact: RunFinished) -> None:
        self._mine = self._asking = False
        self._page.target.detail.setText("")
        self._page.live.detail.setText("")
        self._page.target.eta.setText(fact.reason)
        self._read_campaign()
        self._stale = True

    # -- reading, on a thread of its own ----------------------------------------------------------

    def _read(self, uuid: str, *, new: bool = False) -> None:
        dataset = self.dataset
        if dataset is None:
            return

        def done(held: Held) -> None:
            if new:
                self._gauge.note(self._now_s(), held.entry.bytes)
            self._put(held)

        self._reader.submit(
            lambda: read_probe(dataset, dataset.entry(uuid), signals=new), done, self._failed
        )

    def _put(self, held: Held) -> None:
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

        self._reader.submit(lambda: [f"{f.kind}: {f.text}" for f in examine(rows)], done, failed)

    def _read_campaign(self) -> None:
        """Find out whether there is a campaign to go on with."""
        dataset = self.dataset
        if dataset is None:
            return

        def look() -> tuple[str, int, str]:
            uuid = newest_campaign(dataset.folder)
            if uuid is None:
                return "", 0, ""
            plan = read_campaign(dataset.folder, uuid)
            left = len(plan.todo(dataset.episodes(EpisodeFilter(campaign=uuid))))
            return uuid, left, f"{plan.piece} on {plan.bottom}"

        def done(found: tuple[str, int, str]) -> None:
            uuid, left, what = found
            self._campaign = uuid if left else ""
            self._go_on = f"Go on with {what}: {left} probes are left" if left else ""

        self._reader.submit(look, done, self._failed)

    def _failed(self, error: Exception) -> None:
        what = error.what if isinstance(error, InputError) else str(error)
        fix = error.fix if isinstance(error, InputError) else ""
        code = "DATASET" if not isinstance(error, TouchdownError) else type(error).__name__
        self._cards.show_card(CardText(code.upper(), what, "", fix, reset=False))

    # -- showing ----------------------------------------------------------------------------------

    def draw(self) -> None:
        """Show what changed."""
        self._draw_buttons()
        now_s = self._now_s()
        if now_s - self._gauge_s >= GAUGE_S and self.dataset is not None:
            self._gauge_s = now_s
            self._page.recorder.setText(self._gauge.words(self.dataset.folder, now_s))

    def draw_maps(self) -> None:
        """Show the probes if they changed."""
        if not self._stale or self.harvest is None:
            return
        self._stale, page, chosen = False, self._page, self.chosen or self._last
        seen = self.harvest.covered
        page.coverage.show_scene(self.harvest.bins(chosen))
        page.distribution.show_scene(self.harvest.distribution(page.signal.currentIndex(), chosen))
        possible = int(seen.possible.sum())
        page.coverage_caption.detail.setText(
            f"{possible - seen.holes} of {possible} bins of {seen.bin_mm:g} mm"
        )
        page.table.show_rows(self.harvest.rows(deleted=page.deleted.isChecked()), chosen)
        page.episodes.detail.setText(f"{len(self.harvest)} of {' on '.join(self._pair)}")
        page.probe.show_words(self._words(self.harvest.get(chosen)))

    def _words(self, held: Held | None) -> ProbeWords:
        back = bool(self.chosen)
        return words_of(held, asking=self._asking and not back, running=self._mine, back=back)

    def _draw_buttons(self) -> None:
        link = self.link
        why, state = self._why_not(), RunState.IDLE if link is None else link.status().state
        active = state in ACTIVE
        buttons = TargetButtons(
            start=not why and not active,
            pause=self._mine and state in (RunState.RUNNING, RunState.PAUSING, RunState.PAUSED),
            end=self._mine and active and state is not RunState.CANCELLING,
            paused=state in (RunState.PAUSED, RunState.PAUSING),
            go_on=self._go_on,
            why_not=why,
        )
        if buttons != self._buttons:
            self._buttons = buttons
            self._page.target.show_buttons(buttons)

    def _why_not(self) -> str:
        link = self.link
        if link is None or not link.devices:
            return "The bench is being prepared"
        if link.interlock.latched:
            return "Press Reset first"
        if not self.person:
            return "Say who collects: give your name above (Ctrl+U)"
        if self.dataset is None:
            return "The dataset is being opened"
        if not self.dataset.writable:
            return "The dataset is open for reading only"
        if link.status().state in ACTIVE and not self._mine:
            return "A run is going on"
        return ""
