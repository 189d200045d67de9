"""Presenter of the collect workspace."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime

from PySide6.QtWidgets import QApplication

from touchdown.app import shell
from touchdown.app.collect import requests
from touchdown.app.collect.origin import CampaignPace, OriginCheckNote, RecorderGauge
from touchdown.app.collect.page import CollectPage, OriginField
from touchdown.app.collect.probes import PairProbes, ProbeRecord, read_pair, read_probe
from touchdown.backend import core
from touchdown.backend.annotations import Dataset, EpisodeEntry, EpisodeFilter, check_person
from touchdown.backend.bench import Session
from touchdown.backend.episodes import check_quality
from touchdown.backend.geometry import PieceLibrary
from touchdown.backend.runs import Campaign, CollectRequest, current_campaign, newest_campaign
from touchdown.widgets.base import count_noun, tr
from touchdown.widgets.forms import ProbeText, TargetButtons
from touchdown.widgets.shell import FaultCards


class ProbesPresenter:
    """Maps, table and findings of the probes of one pair.

    ``chosen`` is the selected probe, "" to follow ``last``, the newest one. ``failed`` receives
    read errors.
    """

    def __init__(
        self,
        page: CollectPage,
        reader: shell.SaveWorker,
        catalogue: PieceLibrary,
        failed: Callable[[Exception], None],
    ) -> None:
        self._page, self._reader, self._catalogue = page, reader, catalogue
        self._failed = failed
        self.dataset: Dataset | None = None
        self.harvest: PairProbes | None = None
        self.chosen = self.last = ""
        self.awaits_first = False  # a run has started and has not probed yet
        self._pair = ("", "")
        self._read_from: Dataset | None = None
        self._stale, self._judging = True, False

    @property
    def shown(self) -> str:
        """Uuid of the shown probe, "" for none."""
        return self.chosen or self.last

    def held(self) -> ProbeRecord | None:
        """Return the shown probe, None if it is not of this pair."""
        return None if self.harvest is None else self.harvest.get(self.shown)

    def restyle(self) -> None:
        """Redraw maps and table."""
        self._stale = True

    def begin_run(self) -> None:
        """Show no probe until the run that starts has made one."""
        self.chosen = self.last = ""
        self.awaits_first = self._stale = True

    def follow(self, uuid: str) -> None:
        """Show the newest probe of the run."""
        self.last, self.awaits_first, self._stale = uuid, False, True

    def end_run(self) -> None:
        """Show the newest probe of the pair after a run without one."""
        if self.awaits_first:
            self.follow("" if self.harvest is None else self.harvest.newest)
        self._stale = True

    def choose(self, uuid: str) -> None:
        """Select a probe; selecting the newest one follows the run again."""
        self.chosen = "" if uuid == self.last else uuid
        self._stale = True

    def choose_dot(self, index: int) -> None:
        """Select the probe of a dot."""
        if self.harvest is not None:
            self.choose(self.harvest.shown()[index].entry.uuid)

    # -- reading ----------------------------------------------------------------------------------

    def show_pair(self, piece: str, bottom: str) -> None:
        """Read the probes of a pair from the dataset, unless it is shown already."""
        pair = piece, bottom
        if pair == self._pair and self.dataset is self._read_from:
            return
        try:
            face, outline = (self._catalogue.piece(name).face for name in pair)
        except core.InputError:
            return
        self._pair, self._read_from, dataset = pair, self.dataset, self.dataset
        self.harvest, self._stale, self.last, self.chosen = PairProbes(face, outline), True, "", ""
        if dataset is None:
            return
        self._page.episodes.detail.setText(tr("reading"))

        def done(held: list[ProbeRecord]) -> None:
            if pair == self._pair and dataset is self._read_from:
                self.harvest = PairProbes(face, outline, held)
                self.last, self._stale = "" if self.awaits_first else self.harvest.newest, True
                self._judge()

        self._reader.submit(lambda: read_pair(dataset, *pair), done, self._failed)

    def read(self, uuid: str, came: Callable[[ProbeRecord], None] | None = None) -> None:
        """Read a probe again. With ``came`` it is new: read its signals and report it."""
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
        """Add or update a probe, if it is of this pair."""
        if self.harvest is not None and (held.entry.piece, held.entry.bottom) == self._pair:
            self.harvest.put(held)
            self._stale = True
            self._judge()

    def _judge(self) -> None:
        """Check the quality of the pair, one check at a time."""
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
        """Redraw the probes if they changed; ``words`` describes the shown one."""
        if not self._stale or self.harvest is None:
            return
        self._stale, page = False, self._page
        seen = self.harvest.covered
        page.coverage.show_scene(self.harvest.bins(self.shown))
        signal = page.signal.currentIndex()
        page.distribution.show_scene(self.harvest.distribution(signal, self.shown))
        possible = int(seen.possible.sum())
        page.coverage_caption.detail.setText(
            tr("{}/{} bins, {:g} mm", possible - seen.holes, possible, seen.bin_mm)
        )
        rows = self.harvest.rows(deleted=page.deleted.isChecked())
        page.table.show_rows(rows, self.shown)
        page.episodes.detail.setText(count_noun(len(rows), "episode"))
        page.probe.show_words(words(self.held()))


DISCARDING_DECISIONS = frozenset(("discard", "redo", "skip"))


class CampaignProgress:
    """Counts the probes of a campaign from run events and from later decisions."""

    def __init__(self) -> None:
        self.campaign, self.total = "", 1
        self._done = 0
        self._accepted: set[str] = set()
        self._taken_back: set[str] = set()
        self._beside: set[str] = set()

    @property
    def done(self) -> int:
        """Number of accepted probes that were not deleted."""
        return self._done - len(self._beside)

    def begin(self, event: core.CampaignBegan) -> None:
        """Take the number of probes in the dataset at the start of a run."""
        self.campaign, self.total, self._done = event.campaign, event.total, event.done
        self._accepted, self._taken_back, self._beside = set(), set(), set()

    def collected(self, event: core.ProbeCollected) -> None:
        """Count one more probe."""
        self._done, self.total = event.done, event.total
        if not event.reasons:
            self._accepted.add(event.uuid)

    def decided(self, event: core.EpisodeDecided) -> None:
        """Count a decision of the run. The next probe repeats the number."""
        if (
            event.decision in DISCARDING_DECISIONS
            and event.uuid in self._accepted - self._taken_back
        ):
            self._taken_back.add(event.uuid)
            self._done -= 1

    def stored(self, entry: EpisodeEntry) -> None:
        """Update a probe from the dataset that the run does not know about."""
        if entry.campaign != self.campaign or not entry.quality.accepted:
            return
        if entry.uuid in self._taken_back:
            return
        if entry.deleted:
            self._beside.add(entry.uuid)
        else:
            self._beside.discard(entry.uuid)


GAUGE_S = 1.0


class CollectPresenter:
    """Follows the running campaign and shows the stored probes of the chosen pair."""

    def __init__(
        self,
        page: CollectPage,
        cards: FaultCards,
        reader: shell.SaveWorker,
        catalogue: PieceLibrary,
    ) -> None:
        self._page, self._cards, self._reader = page, cards, reader
        self.probes = ProbesPresenter(page, reader, catalogue, self._failed)
        self.origin = OriginField(page.target)
        self.person = ""
        self.bench: Session | None = None
        self._asking = self._mine = False
        self._asked: core.HandOverAwaited | core.MountingAwaited | None = None
        self._campaign, self._go_on, self._gave = "", "", ""
        # Gets what a campaign that ended gave, and the number of probes left.
        self.ended: Callable[[str, int], None] = lambda *_: None
        self.dataset_trouble = ""  # why the dataset could not be opened
        self._pace, self._gauge = CampaignPace(), RecorderGauge()
        self._progress = CampaignProgress()
        self._gauge_s = float("-inf")
        self._buttons: TargetButtons | None = None

    # -- what there is ----------------------------------------------------------------------------

    @property
    def dataset(self) -> Dataset | None:
        """The open dataset."""
        return self.probes.dataset

    def attach(self, bench: Session) -> None:
        """Connect to a bench; it records into the open dataset."""
        self.bench = bench
        bench.dataset = self.dataset
        if not bench.simulated:
            self._show_pair(bench.usual.piece, bench.usual.bottoms[-1])

    def take_dataset(self, dataset: Dataset, *, read: bool) -> None:
        """Use a dataset that was opened; with ``read``, read its probes of the pair.

        Reading ten thousand probes takes five seconds and slows the window down.
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
        """Confirm what the run waits for, or start a campaign (F5)."""
        if self._asked is not None:
            self._answer(True)
        elif self._asking:
            self.decide("keep")
        else:
            self._begin(requests.collect_request(self._page.target.form(), self.person))

    def go_on(self) -> None:
        """Continue the newest campaign, or confirm that its mounting is unchanged."""
        if isinstance(self._asked, core.MountingAwaited):
            self._answer(False)
        elif self._campaign:
            form = self._page.target.form()
            self._begin(requests.collect_request(form, self.person, campaign=self._campaign))

    def _answer(self, yes: bool) -> None:
        if self.bench is not None:
            self._asked = None
            self.bench.answer(yes)

    def _begin(self, request: CollectRequest) -> None:
        bench = self.bench
        if bench is None or shell.is_run_active(bench):
            return
        if not request.person:
            # The line below the button shows the reason; focus the name.
            self._page.target.ask_person()
            return

        def start() -> None:
            check_person(request.person)
            bench.dataset = self.dataset
            bench.start(request)

        shell.carry_out(start, self._cards)

    def lift(self) -> None:
        """Lift the arm out of contact, so that a run can start."""
        if self.bench is not None:
            shell.lift_hand(self.bench, self._cards)

    def pause_or_resume(self) -> None:
        """Pause at the next safe place, or resume."""
        if self.bench is not None and self._mine:
            shell.pause_or_resume(self.bench)

    def end(self) -> None:
        """End the run in order; the campaign can be continued later."""
        if self.bench is not None and self._mine:
            self.bench.engine.cancel()

    def decide(self, decision: core.EpisodeDecision) -> None:
        """Decide on the selected probe, or on the last one if none is selected."""
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
                lambda: requests.apply_decision(dataset, person, uuid, decision),
                self._decided_beside,
                self._failed,
            )
        self.probes.restyle()

    def _decided_beside(self, held: ProbeRecord) -> None:
        """Update progress bar and *Continue* after a decision that the dataset already holds."""
        self.probes.put(held)
        if self._mine:
            self._progress.stored(held.entry)
            self._show_done()
        else:
            self._read_campaign()

    def set_origin_here(self) -> None:
        """Set the origin to the position of the arm."""
        if self._buttons is not None and not self._buttons.end:
            self.origin.set_here(self.bench)

    def take_origin(self) -> None:
        """Add the residual of the last check to the origin in the form."""
        if self._buttons is not None and not self._buttons.end:
            self.origin.take_residual()

    # -- facts ------------------------------------------------------------------------------------

    def take(self, event: core.Event) -> None:
        """Follow the events of a collecting run."""
        if isinstance(event, core.RunStarted):
            self._mine = event.activity == "collect"
            if self._mine:
                self._pace.restart(time.monotonic())
                self.probes.begin_run()
                self._show_pair(event.piece, event.bottom)
        if not self._mine:
            return
        if isinstance(event, core.CampaignBegan):
            self._campaign = event.campaign
            self._progress.begin(event)
            self._show_done()
        elif isinstance(event, core.ProbeCollected):
            self._collected(event)
        elif isinstance(event, core.DecisionAwaited):
            self._asking = True
            self.probes.follow(event.uuid)
        elif isinstance(event, core.EpisodeDecided):
            self._asking = False
            self._progress.decided(event)
            self._show_done()
            self.probes.read(event.uuid)
        elif isinstance(event, core.RunFinished):
            self._ended(event)
        else:
            self._tell(event)

    def _tell(self, event: core.Event) -> None:
        if isinstance(event, core.HandOverAwaited | core.MountingAwaited):
            self._asked = event
        elif isinstance(event, core.Gripped):
            held = "mounting {}, grip {}, {:.1f} g held"
            text = tr(held, event.mounting, event.grip, event.mass_g)
            self._page.live.detail.setText(text)
        elif isinstance(event, core.PhaseEntered):
            self._asked = None
            self._page.target.detail.setText(tr(event.phase))
        elif isinstance(event, core.OriginChecked):
            found = event.residual_mm, event.sigma_mm, event.agrees
            self.origin.show_note(OriginCheckNote(*found, f"{datetime.now():%Y-%m-%d %H:%M}"))

    def _show_pair(self, piece: str, bottom: str) -> None:
        target = self._page.target
        target.show_form(replace(target.form(), piece=piece, bottom=bottom))

    def _collected(self, event: core.ProbeCollected) -> None:
        self._pace.note(time.monotonic())
        self.probes.follow(event.uuid)
        self._progress.collected(event)
        self._show_done()
        self.probes.read(
            event.uuid, lambda held: self._gauge.note(time.monotonic(), held.entry.bytes)
        )

    def _show_done(self) -> None:
        done, total = self._progress.done, self._progress.total
        self._page.target.show_progress(done, total, self._pace.words(total - done))

    def _ended(self, event: core.RunFinished) -> None:
        self._mine = self._asking = False
        self._asked = None
        self._page.target.detail.setText("")
        self._page.live.detail.setText("")
        self._page.target.eta.setText(event.reason)
        self._gave = event.reason if event.ending in ("finished", "cancelled") else ""
        self._read_campaign()
        self.probes.end_run()

    def _read_campaign(self) -> None:
        """Read the progress of the last campaign and decide if it can be continued."""
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
            self._campaign = plan.uuid if left else ""
            pair = tr("{} on {}", plan.piece, plan.bottom)
            more = tr("Continue {}: {} left", pair, count_noun(left, "probe"))
            self._go_on = more if left else ""
            target = self._page.target
            came = plan.count - left - len(plan.skipped)
            target.show_progress(came, plan.count, target.eta.text())
            if self._gave:
                self.ended(tr("Collection of {}: {}", pair, self._gave), left)
                self._gave = ""

        self._reader.submit(look, done, self._failed)

    def _failed(self, error: Exception) -> None:
        code = type(error).__name__.upper() if isinstance(error, core.TouchdownError) else "DATASET"
        self._cards.show_card(shell.error_card(code, error))

    # -- showing ----------------------------------------------------------------------------------

    def draw(self) -> None:
        """Redraw what changed."""
        now = requests.CampaignState(
            self.person, self.dataset, self._mine, self._go_on, self._asked, self.dataset_trouble
        )
        wanted = requests.campaign_buttons(self.bench, now)
        if wanted != self._buttons:
            self._buttons = wanted
            focused = QApplication.focusWidget()
            self._page.target.show_buttons(wanted)
            if focused is not None and not focused.isEnabled():
                # Otherwise Qt moves the focus to another field.
                self._page.setFocus()
        now_s = time.monotonic()
        if now_s - self._gauge_s >= GAUGE_S and self.dataset is not None:
            self._gauge_s = now_s
            self._page.recorder.setText(self._gauge.words(self.dataset.folder, now_s))

    def draw_maps(self) -> None:
        """Redraw the probes if they changed."""
        self.probes.draw(self._words)

    def _words(self, held: ProbeRecord | None) -> ProbeText:
        back = bool(self.probes.chosen)
        return requests.probe_text(
            held, asking=self._asking and not back, running=self._mine, back=back
        )
