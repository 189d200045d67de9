"""What the frame calls the bench: a simulation, an emulation or a lab, and never another one."""

from __future__ import annotations

from dataclasses import dataclass

from app.link import Link


@dataclass(frozen=True, slots=True)
class BenchWords:
    """``title`` of the window; ``banner`` in the foot, ``striped`` unless it is hardware."""

    title: str
    banner: str
    tip: str
    striped: bool
    note: str
    """Small second line of the pill; "" with hardware."""


def words_of(link: Link) -> BenchWords:
    """Return what to call the bench of ``link``, by the facts that its recordings carry too."""
    mode = link.facts.mode
    if mode == "simulated":
        return BenchWords(
            "Touchdown (SIMULATED)",
            "SIMULATED BENCH",
            "No hardware is connected. Everything you see is computed.",
            True,
            "simulated",
        )
    if mode == "emulated":
        return BenchWords(
            f"Touchdown (EMULATED: {link.name})",
            "EMULATED BENCH",
            "Real drivers and wires, emulated devices: no hardware moves.",
            True,
            "emulated",
        )
    return BenchWords(
        f"Touchdown ({link.name})",
        link.name,
        "Real devices: the arm of this lab moves.",
        False,
        "",
    )
