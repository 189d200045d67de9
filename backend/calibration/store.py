"""The calibrations of one bench: a folder of files, of which the newest of each kind holds."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from backend.calibration.kinds import KINDS, WHATS, What
from backend.calibration.record import (
    CalibrationFile,
    DeviceName,
    Mode,
    Record,
    Value,
    read_record,
)
from backend.core.facts import CalibrationMeasured
from backend.core.faults import InputError, RefusedError
from backend.core.files import write_atomically

Condition = Literal["valid", "expired", "missing", "other device", "damaged"]


@dataclass(frozen=True, slots=True)
class Standing:
    """How one calibration stands: ``record`` if there is one, ``why`` it does not hold else "".

    ``command``: what measures it anew on this bench.
    """

    what: What
    condition: Condition
    record: Record | None
    why: str
    command: str

    @property
    def fix(self) -> str:
        """What to do about it."""
        return "" if self.condition == "valid" else f"Run '{self.command}'."

    @property
    def notice(self) -> str:
        """What one that holds does not tell, "" for nothing."""
        if self.what != "camera" or self.record is None or self.record.file.gels:
            return ""
        return "no fingerprint of the gels yet"


def _ago(days: float) -> str:
    return f"{days:.0f} days" if days >= 2.0 else f"{math.ceil(24.0 * days)} h"


class CalibrationStore:
    """The files of one folder; only those of the same ``mode`` of bench count.

    ``where``: how the command line names the bench, such as "--bench lab.toml".
    """

    def __init__(self, folder: Path, mode: Mode, where: str = "") -> None:
        self.folder, self.mode, self._where = folder, mode, where

    def command(self, what: What) -> str:
        """Return the command that measures a calibration of this bench, and keeps it."""
        return " ".join(filter(None, ("touchdown calibrate", what, self._where, "--accept")))

    def accept(
        self,
        measured: CalibrationMeasured,
        devices: Mapping[str, DeviceName],
        person: str = "",
        now: datetime | None = None,
        gels: Mapping[str, tuple[float, ...]] | None = None,
    ) -> Path:
        """Write a calibration; returns its path. ``gels``: fingerprints, as the file has them.

        Raises ``RefusedError`` "RESIDUAL" or "OBSTACLE" for what is not acceptable, ``InputError``
        where the folder cannot be written.
        """
        if measured.obstacle:
            raise RefusedError("OBSTACLE", measured.obstacle)
        if not measured.acceptable:
            raise RefusedError(
                "RESIDUAL",
                f"The residual of {measured.residual:.3g} {measured.unit} exceeds "
                f"{measured.limit:g} {measured.unit}: measure again.",
            )
        kind = next(kind for kind in KINDS.values() if kind.what == measured.what)
        date = (now or datetime.now(UTC)).replace(microsecond=0)
        file = CalibrationFile(
            what=kind.what,
            mode=self.mode,
            values={
                name: Value(value=value, sigma=sigma, unit=unit)
                for name, value, sigma, unit in zip(
                    measured.names, measured.values, measured.sigmas, measured.units, strict=True
                )
            },
            residual=measured.residual,
            limit=measured.limit,
            unit=measured.unit,
            note=measured.note,
            person=person,
            date=date,
            expires_days=kind.days,
            devices={name: devices[name] for name in kind.devices if name in devices},
            about=measured.about,
            gels=dict(gels or {}),
        )
        record = Record.of(file)
        path = self.folder / f"{kind.what}-{date:%Y%m%d-%H%M%S}-{record.sha256[:8]}.json"
        try:
            write_atomically(path, record.text().encode())
        except OSError as error:
            raise InputError(
                f"The calibration cannot be written: {error.strerror or error}.",
                str(path),
                "Make room, or name a folder that can be written.",
            ) from error
        return path

    def standing(
        self, what: What, devices: Mapping[str, DeviceName], now: datetime | None = None
    ) -> Standing:
        """Return how the newest calibration of a kind stands with the present ``devices``.

        Devices that are not connected yet are not compared.
        """
        command = self.command(what)
        try:
            record = self._newest(what)
        except InputError as error:
            return Standing(what, "damaged", None, f"{error.what} [{error.where}]", command)
        if record is None:
            return Standing(what, "missing", None, "never calibrated on this bench", command)
        other = record.foreign(devices)
        if other:
            then = record.file.devices[other].serial or "another one"
            return Standing(what, "other device", record, f"made with {other} {then}", command)
        left = record.days_left(now or datetime.now(UTC))
        if left < 0:
            return Standing(what, "expired", record, f"expired {_ago(-left)} ago", command)
        return Standing(what, "valid", record, "", command)

    def standings(
        self, devices: Mapping[str, DeviceName], now: datetime | None = None
    ) -> list[Standing]:
        """Return how all stand."""
        return [self.standing(what, devices, now) for what in WHATS]

    def in_use(
        self, devices: Mapping[str, DeviceName], *, required: bool, now: datetime | None = None
    ) -> dict[What, Record]:
        """Return those that hold; raises ``RefusedError`` naming the first that is ``required``.

        The names: CALIBRATION-MISSING, -EXPIRED, -OTHER-DEVICE, -DAMAGED.
        """
        used: dict[What, Record] = {}
        for standing in self.standings(devices, now):
            if standing.condition == "valid":
                assert standing.record is not None
                used[standing.what] = standing.record
            elif required:
                title = KINDS[standing.what].title
                raise RefusedError(
                    f"CALIBRATION-{standing.condition.upper().replace(' ', '-')}",
                    f"{title}: {standing.why}.",
                    standing.fix,
                )
        return used

    def _newest(self, what: What) -> Record | None:
        """Return the newest of this bench's mode; raises ``InputError`` if it is damaged."""
        # The names sort by date.
        for path in sorted(self.folder.glob(f"{what}-*.json"), reverse=True):
            record = read_record(path)
            if record.file.what == what and record.file.mode == self.mode:
                return record
        return None
