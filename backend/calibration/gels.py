"""Presses and replacements of the gels of a laboratory, by serial number.

Each finger has a text file beside the calibrations with one line per mounting: time (UTC), serial
number, one dot per press. The system has the dot before the run goes on, so that the end of the
program, in any way, loses none.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from touchdown.backend.core import FINGERS, Event, Finger, InputError, PhaseEntered, disk_errors


@dataclass(frozen=True, slots=True)
class GelLife:
    """Gel of a finger: ``presses`` with this serial number, mounted there by ``since``.

    ``since``: first press, now if there was none. ``before``: the gel that it replaced, "" if none.
    """

    finger: Finger
    serial: str
    presses: int
    since: datetime
    before: str

    @property
    def text(self) -> str:
        """Presses and date, as a sentence."""
        day = f"{self.since.astimezone():%Y-%m-%d}"
        return f"{self.finger.capitalize()} gel {self.serial}: {self.presses:,} presses since {day}"


class GelLedger:
    """Counts of one bench ``mode`` in ``folder``; ``gels``: left and right one, "" if unknown.

    ``serials``: those known, by finger.
    """

    def __init__(self, folder: Path, mode: str, gels: tuple[str, str] | None) -> None:
        self._paths = {finger: folder / f"gel-{finger}-{mode}.txt" for finger in FINGERS}
        pairs = zip(FINGERS, gels or (), strict=False)
        self.serials: dict[Finger, str] = {finger: gel for finger, gel in pairs if gel}

    def take(self, event: Event) -> None:
        """Count the press that ``event`` begins; a disk that refuses it does not end the run."""
        if isinstance(event, PhaseEntered) and event.phase == "press":
            for finger, serial in self.serials.items():
                with suppress(OSError, InputError):
                    _count(self._paths[finger], serial)

    def lives(self) -> list[GelLife]:
        """Return the known gels; raises ``InputError`` if the counts cannot be read."""
        found, every = [], {finger: _mountings(path) for finger, path in self._paths.items()}
        counts = [(name, presses) for rows in every.values() for _, name, presses in rows]
        for finger, serial in self.serials.items():
            rows, since = every[finger], datetime.now(UTC)
            while rows and rows[-1][1] == serial:
                since = rows.pop()[0]
            presses = sum(n for name, n in counts if name == serial)
            found.append(GelLife(finger, serial, presses, since, rows[-1][1] if rows else ""))
        return found

    def texts(self) -> dict[str, str]:
        """Return the life of each gel by the name of its camera, or why it cannot be read."""
        try:
            return {f"tactile_{life.finger}": life.text for life in self.lives()}
        except InputError as error:
            return dict.fromkeys(("tactile_left", "tactile_right"), error.what)

    def replaced_after(self, date: datetime) -> dict[Finger, str]:
        """Return the replacement of each gel after ``date``, as the end of a sentence."""
        return {
            life.finger: f"the {life.finger} gel was replaced on {life.since.astimezone():%Y-%m-%d}"
            f" ({life.before} by {life.serial})"
            for life in self.lives()
            if life.before and life.since > date
        }

    def replaced_ns(self) -> int:
        """Return the time of the last replacement, ns since 1970; 0 without one."""
        times = [life.since.timestamp() for life in self.lives() if life.before]
        return round(1e9 * max(times, default=0.0))


def _count(path: Path, serial: str) -> None:
    rows, line = _mountings(path), "."
    if not rows or rows[-1][1] != serial or not path.read_bytes().endswith(b"."):
        line = f"\n{datetime.now(UTC).isoformat(timespec='seconds')} {serial} ."
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("ab") as file:
        file.write(line.encode())


def _mountings(path: Path) -> list[tuple[datetime, str, int]]:
    """Return time, serial number and presses of each mounting; damaged lines are skipped."""
    with disk_errors("The presses of the gels cannot be read", path, "Check its permissions."):
        content = path.read_bytes() if path.exists() else b""
    found = []
    for line in content.decode("utf-8", "replace").splitlines():
        date, serial, dots = (*line.split(" "), "", "")[:3]
        with suppress(ValueError):
            at = datetime.fromisoformat(date)
            if at.tzinfo and serial and dots and not dots.strip("."):
                found.append((at, serial, len(dots)))
    return found
