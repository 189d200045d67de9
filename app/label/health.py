"""From the health of a dataset to queues: the episodes of one kind of finding, one by one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

from app.label.health_panel import HealthPanel
from app.label.page import LabelPage
from app.label.presenter import LabelPresenter
from app.label.sitting import Chosen
from backend.catalogue.data_health import DataHealth
from backend.dataset.health import Finding

DIGITS = 9


@dataclass(frozen=True, slots=True)
class Kind:
    """All findings of one kind: what is said of each episode, and the first in words."""

    name: str
    said: dict[str, str]
    first: str

    @property
    def title(self) -> str:
        """Kind and number of episodes."""
        count = len(self.said)
        return f"{self.name}: {count} {'episode' if count == 1 else 'episodes'}"


class HealthPresenter:
    """Holds what the last look found, as long as the window is open."""

    def __init__(self, page: LabelPage, panel: HealthPanel, presenter: LabelPresenter) -> None:
        self._page, self._panel, self._on = page, panel, presenter
        self.kinds: list[Kind] = []

    def show(self, health: DataHealth) -> None:
        """Show what was found, most important kinds first."""
        self.kinds = by_kind(health.findings)
        self._panel.show_findings(
            health_words(health, len(self.kinds), datetime.now()),
            [f"{kind.title}\n{kind.first}" for kind in self.kinds],
        )

    def choose(self, row: int) -> None:
        """Open the episodes of a finding as a queue."""
        if 0 <= row < len(self.kinds):
            kind = self.kinds[row]
            self._on.open_chosen(Chosen(kind.title, kind.said))

    def ask(self) -> None:
        """Ask for a finding by one digit."""
        if not self.kinds:
            self._page.say("There are no findings: Ctrl+H looks through the dataset.")
            return
        names = [kind.name for kind in self.kinds[:DIGITS]]
        choices = [(str(n), name) for n, name in enumerate(names, start=1)]
        self._page.choice.ask("Which finding?", choices, lambda t: self.choose(names.index(t)))


def by_kind(findings: Sequence[Finding]) -> list[Kind]:
    """Return the findings grouped by kind, in the order in which each kind comes first."""
    said: dict[str, dict[str, str]] = {}
    first: dict[str, str] = {}
    for finding in findings:
        first.setdefault(finding.kind, finding.text)
        for uuid in finding.episodes:
            said.setdefault(finding.kind, {}).setdefault(uuid, finding.text)
    return [Kind(name.capitalize(), texts, first[name]) for name, texts in said.items()]


def health_words(health: DataHealth, kinds: int, at: datetime) -> str:
    """Say how much was looked at, and whether anything is out of order."""
    whole = f"{health.looked:,}" + (f" of {health.count:,}" if health.looked < health.count else "")
    noun = "episode was" if health.looked == 1 else "episodes were"
    found = {0: "nothing is out of order", 1: "1 kind of finding"}.get(
        kinds, f"{kinds} kinds of findings"
    )
    return f"{whole} {noun} looked through at {at:%H:%M}: {found}."
