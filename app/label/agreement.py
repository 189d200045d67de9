"""How well people agree with each other: the figures of every two persons, in words."""

from __future__ import annotations

import math
from itertools import combinations

from backend.catalogue.comparison import Comparison, Sway, against_gold, sway
from backend.catalogue.dataset import Dataset
from backend.catalogue.values import PROGRAM

LEAST = 2
"""One common episode is no agreement."""


def agreement_words(dataset: Dataset) -> str:
    """Return the figures of a dataset as text; slow, not for the window's thread."""
    people = sorted(name for name in dataset.people() if name != PROGRAM)
    parts = []
    for first, second in combinations(people, 2):
        found = dataset.compare(first, second)
        if found.episodes >= LEAST:
            parts.append(in_words(first, second, found))
    for person in people:
        gold = against_gold(dataset.database, dataset.geometry, person)
        if gold.episodes:
            parts.append(in_words(f"{person} on gold", "approved label", gold))
    swayed = sway(dataset.database, people)
    if swayed.episodes >= LEAST:
        parts.append(sway_in_words(swayed))
    return "\n\n".join(parts) or (
        "No two people have answered the same episodes yet.\n\n"
        "One episode in 20 of what is to be labelled is gold: an approved label of others, not "
        "told from the rest. What you decide there is an opinion, as in the queue 'Gold': no "
        "label changes."
    )


def in_words(first: str, second: str, c: Comparison) -> str:
    """Return the figures of two persons; what is not known is left out."""
    count = "1 episode" if c.episodes == 1 else f"{c.episodes} episodes"
    lines = [f"{first} minus {second}, {count}"]
    for axis, bias, icc in (("x", c.bias_x_mm, c.icc_x), ("y", c.bias_y_mm, c.icc_y)):
        if not math.isnan(bias.mean):
            limits = f", 95 % limits {_signed(bias.lower)} to {_signed(bias.upper)}"
            known = "" if math.isnan(bias.lower) else limits
            lines.append(f"{axis}: bias {_signed(bias.mean)} mm{known}{_figure(', ICC', icc)}")
    rest = [
        _figure("RMS", c.rms_mm, " mm"),
        _figure("patch IoU", c.patch_iou),
        _figure("verdicts: kappa", c.kappa),
        _figure("alpha", c.alpha),
    ]
    lines.append(", ".join(part for part in rest if part))
    if not any(map(math.isnan, c.drift_mm)):
        lines.append(f"drift x {_signed(c.drift_mm[0])}, y {_signed(c.drift_mm[1])} mm")
    times = [f"{seconds:.1f} s" for seconds in c.seconds if not math.isnan(seconds)]
    if times and not math.isnan(c.seconds[0]):
        lines.append(f"time {' and '.join(times)} an episode")
    return "\n".join(line for line in lines if line)


def sway_in_words(s: Sway) -> str:
    """Return how far labels made blind lie from those made with the model in sight."""
    lines = [f"Blind minus shown, {s.episodes} episodes"]
    for axis, bias in (("x", s.x_mm), ("y", s.y_mm)):
        limits = f", 95 % limits {_signed(bias.lower)} to {_signed(bias.upper)}"
        known = "" if math.isnan(bias.lower) else limits
        lines.append(f"{axis}: mean difference {_signed(bias.mean)} mm{known}")
    return "\n".join(lines)


def _figure(name: str, value: float, unit: str = "") -> str:
    return "" if math.isnan(value) else f"{name} {value:.2f}{unit}"


def _signed(value: float) -> str:
    return f"{value:+.2f}".replace("-", "\N{MINUS SIGN}")
