"""Annotation session on one dataset."""

from __future__ import annotations

from dataclasses import dataclass, field

from touchdown.app.shell import LabelDraft, LabelItem
from touchdown.backend.annotations import Revision, Verdict


@dataclass(frozen=True, slots=True)
class FindingQueue:
    """A queue that is no standing one: these episodes, and what is said of each of them."""

    title: str
    said: dict[str, str]


@dataclass(slots=True)
class AnnotationSession:
    """Who labels, and how. ``sigma_mm``: what the person last said of their own displacements.

    ``chosen``: what the queue named ``finding`` holds, as long as the window is open.
    """

    person: str = ""
    queue: str = "unlabelled"
    seed: int = 0
    sigma_mm: float | None = None
    blind: bool = False
    hidden: bool = False
    chosen: FindingQueue | None = None

    @property
    def opines(self) -> bool:
        """Whether answers are opinions for the figures of agreement: no label changes."""
        return self.queue == "gold" or (self.blind and self.queue == "audit")

    @property
    def hides(self) -> bool:
        """Whether model and other sources are out of sight."""
        return self.blind or self.hidden or self.opines


@dataclass(slots=True)
class PresentEpisode:
    """The episode in front. ``verdict``: what is said blind, kept with the opinion."""

    item: LabelItem
    edit: LabelDraft
    history: list[Revision] = field(default_factory=list)
    verdict: Verdict | None = None
