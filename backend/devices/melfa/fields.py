"""What the inspector shows of the arm: the commanded place and the counts of the link."""

from __future__ import annotations

from collections.abc import Mapping

from backend.config.hardware import MelfaSettings
from backend.devices.melfa.console import Console
from backend.devices.melfa.stream import StreamCore
from backend.devices.melfa.wires import Wires


def raw_fields(
    core: StreamCore, wires: Wires, settings: MelfaSettings, console: Console
) -> Mapping[str, str | float]:
    """Return them by name; ``command_mm`` is of ``G`` in the bench."""
    counts, times = core.replies.counts, wires.times
    x, y, z = core.command_mm.tolist()
    return {
        "kind": "melfa",
        "host": settings.host,
        "stream": core.phase.value,
        "x_mm": x,
        "y_mm": y,
        "z_mm": z,
        "holds": core.holds,
        "refused": counts.refused,
        "repeated": counts.repeated,
        "old": counts.old,
        "skipped": counts.skipped,
        "controller_missed": core.timeouts,
        "bad_replies": wires.bad_replies,
        "late_cycles": times.late,
        "latest_ms": 1e3 * times.latest_s,
        "realtime": "yes" if times.realtime else "no",
        "time_limit": "none" if console.unlimited else "set",
    }
