"""Annotation session on one dataset."""

from __future__ import annotations

from dataclasses import dataclass, field

from touchdown.app.shell import LabelDraft, LabelItem
from touchdown.backend.annotations import Revision, Verdict


@dataclass(frozen=True, slots=True)
class FindingQueue:
    """A temporary queue: a title, and the text of the finding by episode."""

    title: str
    said: dict[str, str]


@dataclass(slots=True)
class AnnotationSession:
    """Person and settings of the labelling.

    ``sigma_mm`` is the uncertainty that the person stated last. ``chosen`` is the content of the
    queue ``finding``; it is not stored.
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
        """True if answers are stored as opinions and change no label."""
        return self.queue == "gold" or (self.blind and self.queue == "audit")

    @property
    def hides(self) -> bool:
        """True if model and other sources are hidden."""
        return self.blind or self.hidden or self.opines


@dataclass(slots=True)
class PresentEpisode:
    """The shown episode. ``verdict``: blind verdict, stored with the opinion."""

    item: LabelItem
    edit: LabelDraft
    history: list[Revision] = field(default_factory=list)
    verdict: Verdict | None = None
