"""What each command and reply of the WSG binary protocol carries, as ``struct`` layouts.

Source: command set reference manual, firmware 2.2.0.
"""

from __future__ import annotations

from backend.wire.wsg_words import Command

LONGEST_UNKNOWN = 64
"""Payload of a command not in the tables; longer ones are taken for noise."""
TEXT: dict[int, int] = {Command.LOOP: 256, Command.SET_TAG: 64, Command.GET_TAG: 64}
"""Commands whose content is bytes of any length up to this."""

_UPDATE, NOTHING = "<BH", "<"
REQUESTS: dict[int, str] = {
    **dict.fromkeys(Command, NOTHING),
    Command.HOME: "<B",
    Command.PREPOSITION: "<Bff",
    Command.ACKNOWLEDGE: "<3s",
    Command.GRASP: "<ff",
    Command.RELEASE: "<ff",
    Command.SET_ACCELERATION: "<f",
    Command.SET_FORCE_LIMIT: "<f",
    Command.SET_SOFT_LIMITS: "<ff",
    Command.OVERDRIVE: "<B",
    Command.STATISTICS: "<B",
    Command.SYSTEM_STATE: _UPDATE,
    Command.GRASP_STATE: _UPDATE,
    Command.WIDTH: _UPDATE,
    Command.SPEED: _UPDATE,
    Command.FORCE: _UPDATE,
}
"""Layout of the payload of each request."""

REPLIES: dict[int, tuple[str, ...]] = {
    **dict.fromkeys(Command, (NOTHING,)),
    Command.SET_ACCELERATION: (NOTHING, "<f"),
    Command.GET_ACCELERATION: ("<f",),
    Command.GET_FORCE_LIMIT: ("<f",),
    Command.GET_SOFT_LIMITS: ("<ff",),
    Command.SYSTEM_STATE: ("<I",),
    Command.GRASP_STATE: ("<B",),
    Command.STATISTICS: ("<IHH",),
    Command.WIDTH: ("<f",),
    Command.SPEED: ("<f",),
    Command.FORCE: ("<f",),
    Command.TEMPERATURE: ("<h",),
    Command.SYSTEM_INFO: ("<BBHI",),
    Command.SYSTEM_LIMITS: ("<8f",),
}
"""Layouts of what follows status 0 in each reply; the manual prints 30h with a value."""
