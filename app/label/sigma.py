"""How sure a person is of what they set: the one question that labelling asks by itself."""

from __future__ import annotations

from collections.abc import Callable

from app.label.page import LabelPage

OFFERED_MM = (0.05, 0.1, 0.2, 0.3, 0.5, 1.0)
USUAL_MM = 0.2
"""What is marked when a person is asked for the first time."""


def ask_sigma(page: LabelPage, known_mm: float | None, take: Callable[[float], None]) -> None:
    """Offer uncertainties, the present one marked; ``take`` gets mm.

    Digits are no answers: what is typed meanwhile begins a displacement, whole.
    """
    marked_mm = known_mm or USUAL_MM
    words = {_word(mm): mm for mm in sorted({*OFFERED_MM, marked_mm})}
    page.choice.offer(
        "How sure are you of what you set (sigma)?",
        list(words),
        list(words).index(_word(marked_mm)),
        lambda word: take(words[word]),
        page.open_entry,
    )


def _word(sigma_mm: float) -> str:
    exact = f"{sigma_mm:g}"
    return f"{sigma_mm:.2f} mm" if len(exact) <= 4 else f"{exact} mm"
