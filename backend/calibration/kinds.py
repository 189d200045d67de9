"""Which calibrations a bench has, what each is worth and for how long."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

What = Literal["payload", "board", "tool", "wrist", "camera"]
MIRRORS = ("none", "x", "y", "both")
"""How a picture is turned round, by code: 1 for x, 2 for y."""
ON = " on "
"""Between piece and bottom of a board."""
WHATS: tuple[What, ...] = get_args(What)


@dataclass(frozen=True, slots=True)
class Kind:
    """One calibration: ``days`` that it holds; it belongs to ``devices``, by their names.

    ``values``: what is read of it when it is applied; a file without one of them is damaged.
    """

    what: What
    title: str
    days: int
    devices: tuple[str, ...]
    values: tuple[str, ...]


KINDS: dict[What, Kind] = {
    kind.what: kind
    for kind in (
        Kind(
            "payload",
            "Payload",
            90,
            ("force_torque", "gripper"),
            ("mass_kg", "com_x_mm", "com_y_mm"),
        ),
        Kind(
            "board",
            "Board",
            1,
            ("arm",),
            ("x_mm", "y_mm", "z_mm", "slope_x_rad", "slope_y_rad"),
        ),
        Kind("tool", "Tool and face centre", 30, ("arm", "gripper"), ("face_x_mm", "face_y_mm")),
        Kind("wrist", "Wrist sensor yaw", 180, ("force_torque",), ()),
        Kind(
            "camera",
            "Tactile cameras",
            90,
            ("tactile_left", "tactile_right"),
            ("left_u_mm_px", "left_v_mm_px", "right_u_mm_px", "right_v_mm_px"),
        ),
    )
}
