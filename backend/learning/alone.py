"""May a model decide without being asked on this bench? Each field that speaks against it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from backend.config.bench_facts import BenchFacts
from backend.core.faults import InputError
from backend.learning.checkpoint import Card

HARDWARE_PROBES = 50
"""A model trained on simulation alone needs so many evaluated hardware probes."""


@dataclass(frozen=True, slots=True)
class Misfit:
    """A field of the card that the bench contradicts."""

    field: str
    card: str
    bench: str

    def __str__(self) -> str:
        return f"{self.field}: the model {self.card}, the bench {self.bench}"


def misfits(
    card: Card, bench: BenchFacts, piece: str, grid_mm: float, hardware_probes: int
) -> tuple[Misfit, ...]:
    """Return what keeps a model from running alone; what either side does not tell is passed over.

    ``piece`` is the hash of the grasped piece, ``grid_mm`` the pitch of its face points,
    ``hardware_probes`` on how many the model was evaluated.
    """
    found = []
    if card.geometry != piece:
        found.append(Misfit("piece hash", _short(card.geometry), _short(piece)))
    if card.grid_mm != grid_mm:
        found.append(Misfit("grid", f"{card.grid_mm:g} mm", f"{grid_mm:g} mm"))
    # An emulated bench rehearses a day on hardware: the same rule holds there.
    transfer = card.simulated and bench.mode in ("hardware", "emulated")
    if transfer and hardware_probes < HARDWARE_PROBES:
        evaluated = f"{hardware_probes} of {HARDWARE_PROBES} hardware probes evaluated"
        found.append(Misfit("bench mode", "simulated only", f"{bench.mode}, {evaluated}"))
    names = {"mm_per_px": "mm/px", "ft_frame": "F/T frame"}
    if not transfer:
        # A simulated bench and a real one never have these in common.
        names = {"mode": "bench mode", "sha256": "bench hash", **names}
    found += [
        m for name, text in names.items() if (m := _compared(card.benches, bench, name, text))
    ]
    return tuple(found)


def check_alone(card: Card, found: Sequence[Misfit], where: str) -> None:
    """Raise ``InputError`` naming the fields that do not fit."""
    if found:
        fields = "; ".join(str(one) for one in found)
        raise InputError(
            f"The model of '{card.piece}' must not run in auto mode here: {fields}.",
            where,
            "Choose approve or step mode, or a model trained for this bench.",
        )


def _compared(
    benches: Sequence[BenchFacts], bench: BenchFacts, name: str, text: str
) -> Misfit | None:
    """Compare one field with those of all benches that the training data came from."""
    told = [value for one in benches if (value := getattr(one, name))]
    here = getattr(bench, name)
    if not told or not here or here in told:
        return None
    return Misfit(text, " or ".join(sorted({_short(v) for v in told})), _short(here))


def _short(value: object) -> str:
    """Write a value as short as it is still told apart."""
    if isinstance(value, tuple):
        return " / ".join(f"{v:g}" for v in value)
    text = str(value)
    hexadecimal = len(text) == 64 and all(c in "0123456789abcdef" for c in text)
    return text[:12] if hexadecimal else f"'{text}'"
