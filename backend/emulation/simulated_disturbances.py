"""Scheduled disturbances of the devices of the simulated bench, parsed from text.

Written as ``device:kind@start`` or ``device:kind@start+length`` in seconds of the bench clock, for
example ``tactile_right:stop@2.5+1.0``. A sensor that slows down needs the rate as well, in Hz:
``force_torque:slow=300@30+5``; one that drifts its drift, in N/s: ``force_torque:drift=0.05@30``; a
piece that turns in the grasp its angle, in degrees: ``gripper:turn=3@12``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass

from touchdown.backend.core import InputError

# freeze: the picture does not change; stop: nothing arrives; slow: limited sample rate; dark: the
# light fails; flicker: the brightness swings by 25 %; nan: samples are NaN; drift: Fz changes at a
# constant rate and keeps its last value; jump: +50 N on Fz; stall: commanded but not moving;
# silent: no positions or widths arrive; turn: the held piece turns in the grasp, visible in
# contact.
DISTURBANCE_KINDS: dict[str, tuple[str, ...]] = {
    "tactile_left": ("freeze", "stop", "slow", "dark", "flicker"),
    "tactile_right": ("freeze", "stop", "slow", "dark", "flicker"),
    "force_torque": ("nan", "stop", "slow", "drift", "jump"),
    "arm": ("stall", "silent"),
    "gripper": ("stall", "silent", "turn"),
}

# Unit of the amount of each kind that has one.
AMOUNT_UNITS = {"slow": "samples a second", "drift": "N a second", "turn": "degrees"}

FAULT_FORM = re.compile(
    r"(?P<device>[a-z_]+):(?P<kind>[a-z_]+)(=(?P<much>\d+(\.\d+)?))?@(?P<start>\d+(\.\d+)?)(\+(?P<length>\d+(\.\d+)?))?"
)


@dataclass(frozen=True, slots=True)
class Disturbance:
    """One fault; ``length_s`` is infinite if it does not end, ``much`` is its amount."""

    device: str
    kind: str
    start_s: float
    length_s: float = float("inf")
    # Amount: samples per second (slow), N per second (drift), degrees (turn).
    much: float | None = None

    def holds(self, device: str, kind: str, t_s: float) -> bool:
        """Return True if the fault ``kind`` of ``device`` is active at ``t_s``."""
        meant = self.device == device and self.kind == kind
        return meant and self.start_s <= t_s < self.start_s + self.length_s


@dataclass(frozen=True, slots=True)
class DisturbanceScript:
    """All faults of a scene."""

    disturbances: tuple[Disturbance, ...] = ()

    def active(self, device: str, kind: str, t_s: float) -> bool:
        """Return True if a fault ``kind`` of ``device`` is active at ``t_s``."""
        # Called eight times per cycle; usually there is none.
        return bool(self.disturbances) and any(
            d.holds(device, kind, t_s) for d in self.disturbances
        )

    def rate_hz(self, device: str, t_s: float) -> float | None:
        """Return the limit of the sample rate of ``device`` at ``t_s``, Hz, or None."""
        return next((d.much for d in self.disturbances if d.holds(device, "slow", t_s)), None)

    def turn_rad(self, start_s: float, end_s: float) -> float:
        """Return the turn of the held piece in the grasp in ``start_s <= t < end_s``, rad."""
        return math.radians(
            sum(
                d.much or 0.0
                for d in self.disturbances
                if d.kind == "turn" and start_s <= d.start_s < end_s
            )
        )

    def drift_n(self, t_s: float) -> float:
        """Return the drift of the wrist sensor at ``t_s``, N."""
        return sum(
            (d.much or 0.0) * min(max(t_s - d.start_s, 0.0), d.length_s)
            for d in self.disturbances
            if d.kind == "drift"
        )


def parse_disturbance(text: str) -> Disturbance:
    """Return the disturbance that ``text`` describes; raises ``InputError``."""
    match = FAULT_FORM.fullmatch(text.strip())
    if match is None:
        fix = "Write device:kind@seconds or device:kind@seconds+seconds; device:slow=rate@seconds."
        raise InputError(f"'{text}' is not a disturbance.", text, fix)
    device, kind = match["device"], match["kind"]
    if device not in DISTURBANCE_KINDS:
        fix = f"Use one of {', '.join(DISTURBANCE_KINDS)}."
        raise InputError(f"There is no device '{device}'.", text, fix)
    if kind not in DISTURBANCE_KINDS[device]:
        fix = f"Use one of {', '.join(DISTURBANCE_KINDS[device])}."
        raise InputError(f"'{device}' has no fault '{kind}'.", text, fix)
    much = None if match["much"] is None else float(match["much"])
    unit = AMOUNT_UNITS.get(kind)
    if bool(much) != (unit is not None):
        raise InputError(
            f"'{text}' needs an amount above 0, in {unit}." if unit else f"'{kind}' takes no rate.",
            text,
            f"Write {device}:slow=10@3 for ten samples a second, force_torque:drift=0.05@3 for "
            "0.05 N a second; other faults without a number.",
        )
    length = match["length"]
    length_s = float("inf") if length is None else float(length)
    return Disturbance(device, kind, float(match["start"]), length_s, much)


def parse_script(texts: Iterable[str]) -> DisturbanceScript:
    """Return the script of several disturbances; raises ``InputError`` for the first bad one."""
    return DisturbanceScript(tuple(parse_disturbance(text) for text in texts))
