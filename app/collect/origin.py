"""What the last check of the origin found, and when: shown, remembered, used once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from datetime import datetime

from backend.core.facts import OriginChecked


@dataclass(frozen=True, slots=True)
class OriginNote:
    """Felt centre of the bottom minus the origin, in mm; ``used``: the origin was moved there."""

    residual_mm: tuple[float, float]
    sigma_mm: float
    agrees: bool
    at: str
    used: bool = False

    @classmethod
    def of(cls, fact: OriginChecked, at: datetime) -> OriginNote:
        """Return the note of a check made at ``at``."""
        return cls(fact.residual_mm, fact.sigma_mm, fact.agrees, f"{at:%Y-%m-%d %H:%M}")

    def taken(self) -> OriginNote:
        """Return the note once the origin was moved by it."""
        return replace(self, used=True)

    def memory(self) -> dict[str, object]:
        """Return it JSON-ready."""
        return asdict(self)


def note_of(memory: object) -> OriginNote | None:
    """Return a remembered note; None for none. Raises ``ValueError`` for what makes no sense."""
    if memory is None:
        return None
    if not isinstance(memory, Mapping):
        raise ValueError("no note")
    try:
        x, y = (float(v) for v in memory["residual_mm"])
        sigma_mm = float(memory["sigma_mm"])
        at = str(memory["at"])
        return OriginNote((x, y), sigma_mm, bool(memory["agrees"]), at, bool(memory["used"]))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError("no note") from error


def residual_words(note: OriginNote | None) -> str:
    """Write residual, uncertainty, judgement and date."""
    if note is None:
        return "Origin not checked yet."
    x, y = (f"{v:+.2f}".replace("-", "\N{MINUS SIGN}") for v in note.residual_mm)
    spread = f"\N{PLUS-MINUS SIGN} {note.sigma_mm:.2f} mm"
    said = "agrees with the origin" if note.agrees else "does not agree with the origin"
    if note.used:
        said = "the origin was moved there"
    return f"Residual x {x}, y {y} {spread}: {said}. {note.at}"
