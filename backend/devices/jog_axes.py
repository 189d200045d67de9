"""What a jog can go along or about: three axes, three turns, six joints, in three frames."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from backend.core.flow import FloatArray
from backend.core.turning import UNTURNED
from backend.devices.jog_limits import Way

Axis = Literal["x", "y", "z", "rx", "ry", "rz", "j1", "j2", "j3", "j4", "j5", "j6"]
Frame = Literal["XYZ", "TOOL", "JOINT"]
AXES: tuple[Axis, ...] = ("x", "y", "z")
TURNS: tuple[Axis, ...] = ("rx", "ry", "rz")
JOINTS: tuple[Axis, ...] = ("j1", "j2", "j3", "j4", "j5", "j6")
FRAMES: tuple[Frame, ...] = ("XYZ", "TOOL", "JOINT")
TOOL_SIGNS: Way = (1.0, -1.0, -1.0)
"""The tool's axes in the bench frame while the hand points down: z is the direction of approach."""


@dataclass(frozen=True, slots=True)
class Room:
    """How far a jog may go: mm, or rad for what turns. ``why`` it may not go at all: a reason."""

    left: float
    why: str = ""


def axes_of(frame: Frame) -> tuple[Axis, ...]:
    """Return what can be jogged in a frame."""
    return JOINTS if frame == "JOINT" else (*AXES, *TURNS)


def turns(axis: Axis) -> bool:
    """Whether speeds and ways of this axis are angles."""
    return axis not in AXES


def way_of(axis: Axis, frame: Frame, signed: float, turn: FloatArray = UNTURNED) -> Way:
    """Return the unit vector in the bench frame for a signed value along or about an axis.

    ``turn`` (3, 3) of the hand: the axes of TOOL turn with it.
    """
    at = (AXES if axis in AXES else TURNS).index(axis)
    sign = 1.0 if signed > 0 else -1.0
    if frame == "TOOL":
        sign *= TOOL_SIGNS[at]
    unit = np.zeros(3)
    unit[at] = sign
    x, y, z = (turn @ unit if frame == "TOOL" and turn is not UNTURNED else unit).tolist()
    return x, y, z


def joint_speeds(axis: Axis, speed_rad_s: float) -> tuple[float, ...]:
    """Return the speeds of all six joints while one of them is driven."""
    return tuple(speed_rad_s if axis == joint else 0.0 for joint in JOINTS)


def signed_name(axis: Axis, signed: float) -> str:
    """Return the name of a way such as "+X" or "-J4", with a true minus."""
    return f"{'+' if signed > 0 else chr(0x2212)}{axis.upper()}"


def amount(axis: Axis, value: float) -> str:
    """Return a way in words: mm along an axis, degrees of a turn."""
    return f"{math.degrees(value):.1f}\N{DEGREE SIGN}" if turns(axis) else f"{value:.1f} mm"
