"""Which calibrations a bench has, what each is worth and for how long."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

What = Literal["payload", "board", "tool", "wrist", "camera"]
WHATS: tuple[What, ...] = get_args(What)


@dataclass(frozen=True, slots=True)
class Kind:
    """One calibration: ``days`` that it holds; it belongs to ``devices``, by their names."""

    what: What
    title: str
    days: int
    devices: tuple[str, ...]


KINDS: dict[What, Kind] = {
    kind.what: kind
    for kind in (
        Kind("payload", "Payload", 90, ("force_torque", "gripper")),
        Kind("board", "Board", 1, ("arm",)),
        Kind("tool", "Tool and face centre", 30, ("arm", "gripper")),
        Kind("wrist", "Wrist sensor yaw", 180, ("force_torque",)),
        Kind("camera", "Tactile cameras", 90, ("tactile_left", "tactile_right")),
    )
}
