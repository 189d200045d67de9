"""The probes of the chosen pair: read on a thread of their own, judged, and drawn."""

from __future__ import annotations

from collections.abc import Callable

from app.collect.harvest import Harvest, Held, read_pair, read_probe
from app.collect.page import CollectPage
from app.label.commits import Commits
from backend.catalogue.dataset import Dataset
from backend.core.faults import InputError
from backend.dataset.health import examine
from backend.objects.catalogue import Catalogue
from widgets.last_probe_panel import ProbeWords


class Probes:
    """Maps, table and findings of one pair. ``chosen``: the probe that is looked at, "" for the
    one that was recorded ``last``. ``failed`` is told what could not be read.
    """

    def __init__(
        self,
        page: CollectPage,
        reader: Commits,
        catalogue: Catalogue,
        failed: Callable[[Exception], None],
    ) -> None:
        self._page, self._reader, self._catalogue = page, reader, catalogue
        self._failed = failed
        self.dataset: Dataset | None = None
        self.harvest: Harvest | None = None
        self.chosen = self.last = ""
        self._pair = ("", "")
        self._read_from: Dataset | None = None
        self._stale, self._judging = True, False

    @property
    def shown(self) -> str:
        """Uuid of the probe that is shown, "" if there is none."""
        return self.chosen or self.last

    def held(self) -> Held | None:
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
        self.harvest, self._stale, self.last, self.chosen = Harvest(face, outline), True, "", ""
        if dataset is None:
            return
        self._page.episodes.detail.setText("reading")

        def done(held: list[Held]) -> None:
            if pair == self._pair and dataset is self._read_from:
                self.harvest = Harvest(face, outline, held)
                self.last, self._stale = self.harvest.newest, True
                self._judge()

        self._reader.submit(lambda: read_pair(dataset, *pair), done, self._failed)

    def read(self, uuid: str, came: Callable[[Held], None] | None = None) -> None:
        """Read a probe again; with ``came`` it is new, read with its signals and handed on."""
        dataset = self.dataset
        if dataset is None:
            return

        def done(held: Held) -> None:
            if came is not None:
                came(held)
            self.put(held)

        self._reader.submit(
            lambda: read_probe(dataset, dataset.entry(uuid), signals=came is not None),
            done,
            self._failed,
        )

    def put(self, held: Held) -> None:
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

        self._reader.submit(lambda: [f"{f.kind}: {f.text}" for f in examine(rows)], done, failed)

    # -- showing ----------------------------------------------------------------------------------

    def draw(self, words: Callable[[Held | None], ProbeWords]) -> None:
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
