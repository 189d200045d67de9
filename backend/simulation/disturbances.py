"""Faults on demand: what goes wrong on the simulated bench, when, and for how long.

Written as ``device:kind@start`` or ``device:kind@start+length`` in seconds of the bench clock, for
example ``tactile_right:stop@2.5+1.0``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

from backend.core.faults import InputError

KINDS: dict[str, tuple[str, ...]] = {
    "tactile_left": ("freeze", "stop", "dark", "flicker"),
    "tactile_right": ("freeze", "stop", "dark", "flicker"),
    "force_torque": ("nan", "stop", "jump"),
    "arm": ("stall", "silent"),
    "gripper": ("stall",),
}
"""freeze: the same picture for ever; stop: nothing arrives; dark: the light fails; flicker: the
brightness swings by 25 %; nan: samples are not numbers; jump: +50 N on Fz; stall: commanded but not
moving; silent: no positions arrive."""

_FORM = re.compile(
    r"(?P<device>[a-z_]+):(?P<kind>[a-z]+)@(?P<start>\d+(\.\d+)?)(\+(?P<length>\d+(\.\d+)?))?"
)


@dataclass(frozen=True, slots=True)
class Disturbance:
    """One fault; ``length_s`` infinite if it does not end."""

    device: str
    kind: str
    start_s: float
    length_s: float = float("inf")


@dataclass(frozen=True, slots=True)
class Script:
    """All faults of a scene."""

    disturbances: tuple[Disturbance, ...] = ()

    def active(self, device: str, kind: str, t_s: float) -> bool:
        """Return whether ``device`` suffers from ``kind`` at ``t_s``."""
        # Asked eight times a cycle, and almost always there is none.
        return bool(self.disturbances) and any(
            d.device == device and d.kind == kind and d.start_s <= t_s < d.start_s + d.length_s
            for d in self.disturbances
        )


def parse_disturbance(text: str) -> Disturbance:
    """Return the disturbance that ``text`` describes; raises ``InputError``."""
    match = _FORM.fullmatch(text.strip())
    if match is None:
        raise InputError(
            f"'{text}' is not a disturbance.",
            text,
            "Write device:kind@seconds or device:kind@seconds+seconds.",
        )
    device, kind = match["device"], match["kind"]
    if device not in KINDS:
        raise InputError(f"There is no device '{device}'.", text, f"Use one of {', '.join(KINDS)}.")
    if kind not in KINDS[device]:
        raise InputError(
            f"'{device}' has no fault '{kind}'.", text, f"Use one of {', '.join(KINDS[device])}."
        )
    length = match["length"]
    return Disturbance(
        device, kind, float(match["start"]), float("inf") if length is None else float(length)
    )


def parse_script(texts: Iterable[str]) -> Script:
    """Return the script of several disturbances; raises ``InputError`` for the first bad one."""
    return Script(tuple(parse_disturbance(text) for text in texts))
