"""Accepted calibrations of a bench, one small file each; the newest of each kind is in use.

A file holds values, residual, date, devices, expiry and a hash.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, ValidationError

from touchdown.backend import core
from touchdown.backend.calibration.cameras import FINGERPRINT_VALUES
from touchdown.backend.calibration.day_checks import DayChecks
from touchdown.backend.calibration.gels import GelLedger
from touchdown.backend.calibration.result import (
    CALIBRATION_KINDS,
    CALIBRATION_NAMES,
    MIRROR_CODES,
    ON_BOTTOM,
    CalibrationName,
)
from touchdown.backend.config import BenchIdentity, Settings

VERSION = 1
MAX_CHARACTERS = 1_000_000
UNWRITABLE_FIX = "Make room, or name a folder that can be written."
Mode = Literal["simulated", "emulated", "hardware"]


class CalibrationValue(Settings):
    """A number with its standard uncertainty and unit."""

    value: float
    sigma: Annotated[float, Field(ge=0)]
    unit: str


class DeviceName(Settings):
    """Identity reported by a device."""

    maker: str
    model: str
    serial: str


class CalibrationFile(Settings):
    """Content of the file without its hash. Dates are UTC."""

    version: Literal[1] = 1
    what: CalibrationName
    mode: Mode
    values: dict[str, CalibrationValue]
    residual: float
    limit: float
    unit: str
    note: str = ""
    person: str = ""
    date: Annotated[datetime, Field(strict=False)]
    expires_days: Annotated[int, Field(ge=1, le=100_000)]
    devices: dict[str, DeviceName]
    about: str = ""  # piece and bottom, "" where neither matters
    # Gel fingerprints: by camera name as in ``devices``, u and v of the 63 dots at rest. Empty if
    # none was taken.
    gels: dict[str, tuple[float, ...]] = Field(default_factory=dict)

    @property
    def expires(self) -> datetime:
        """End of its validity."""
        return self.date + timedelta(days=self.expires_days)


@dataclass(frozen=True, slots=True)
class CalibrationRecord:
    """A calibration with the SHA-256 of its content."""

    file: CalibrationFile
    sha256: str

    @classmethod
    def of(cls, file: CalibrationFile) -> CalibrationRecord:
        """Return the record of ``file``."""
        return cls(file, content_sha256(file))

    def days_left(self, now: datetime) -> float:
        """Return the remaining days of validity; negative after expiry."""
        return (self.file.expires - now) / timedelta(days=1)

    def foreign(self, devices: Mapping[str, DeviceName]) -> str:
        """Return the first of ``devices`` that differs from the one at calibration, or "".

        Devices without a serial number are identified by the name of their port.
        """
        for name, now in devices.items():
            then = self.file.devices.get(name)
            if then is not None and _device_names(then) != _device_names(now):
                return name
        return ""

    def text(self) -> str:
        """Return the text of the file."""
        content = {**_content(self.file), "sha256": self.sha256}
        return json.dumps(content, indent=2, ensure_ascii=False) + "\n"


def _device_names(device: DeviceName) -> tuple[str, str, str]:
    return device.maker, device.model, device.serial.rpartition("/")[2]


def content_sha256(file: CalibrationFile) -> str:
    """Return the SHA-256 of the canonical JSON of ``file``."""
    content = json.dumps(_content(file), sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return sha256(content.encode()).hexdigest()


def _content(file: CalibrationFile) -> dict[str, object]:
    """Return the hashed content, without empty fields that older files lack."""
    content = file.model_dump(mode="json")
    for later in ("about", "gels"):
        if not content[later]:
            del content[later]
    return content


def read_record(path: Path) -> CalibrationRecord:
    """Read a calibration; raises ``InputError`` if it is damaged, changed or of a newer version."""
    try:
        with path.open(encoding="utf-8") as stream:
            text = stream.read(MAX_CHARACTERS + 1)
        if len(text) > MAX_CHARACTERS:
            raise ValueError(f"it is longer than {MAX_CHARACTERS} characters")
        content = core.parse_json(text)
        given = content.pop("sha256")
        file = CalibrationFile.model_validate(content)
    except (OSError, ValueError, KeyError, AttributeError, TypeError, RecursionError) as error:
        what = f"This is not a calibration of version {VERSION}: {_first_error(error)}."
        fix = "Calibrate again; the damaged file can be deleted."
        raise core.InputError(what, str(path), fix) from error
    if given != content_sha256(file):
        fix = "Calibrate again; a number is never corrected by hand."
        raise core.InputError("The calibration was changed after it was accepted.", str(path), fix)
    if file.date.tzinfo is None or file.date.utcoffset() != datetime.now(UTC).utcoffset():
        fix = "Calibrate again."
        raise core.InputError("The date of the calibration is not UTC.", str(path), fix)
    if flaw := _find_flaw(file):
        raise core.InputError(flaw, str(path), "Calibrate again; the damaged file can be deleted.")
    return CalibrationRecord(file, given)


def _find_flaw(file: CalibrationFile) -> str:
    """Return the reason why a well-formed file cannot be applied, or ""."""
    for name in CALIBRATION_KINDS[file.what].values:
        if name not in file.values:
            return f"The calibration lacks '{name}'."
        if name.endswith("_mm_px") and not file.values[name].value > 0:
            return f"The scale '{name}' of the calibration is not positive."
    for name in ("left_mirror", "right_mirror"):
        if name in file.values and file.values[name].value not in range(len(MIRROR_CODES)):
            return f"The mirror code '{name}' of the calibration is unknown."
    if file.about and len(file.about.split(ON_BOTTOM)) != 2:
        return "The calibration does not name piece and bottom."
    for name, numbers in file.gels.items():
        if len(numbers) != FINGERPRINT_VALUES or name not in file.devices:
            return f"The gel fingerprint '{name}' of the calibration is invalid."
    return ""


def _first_error(error: Exception) -> str:
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        return f"'{where}': {first['msg']}"
    return next(iter(str(error).splitlines()), type(error).__name__)


Condition = Literal["valid", "expired", "missing", "other device", "gel replaced", "damaged"]


@dataclass(frozen=True, slots=True)
class CalibrationStatus:
    """Validity of one calibration: ``record`` if any, ``why`` it is not valid, or "".

    ``step``: clause on how it is measured again on this bench.
    """

    what: CalibrationName
    condition: Condition
    record: CalibrationRecord | None
    why: str
    step: str

    @property
    def fix(self) -> str:
        """Remedy, or "" if it is valid."""
        return "" if self.condition == "valid" else f"{self.step[:1].upper()}{self.step[1:]}."

    @property
    def notice(self) -> str:
        """Limitation of a valid calibration, or ""."""
        if self.what != "camera" or self.record is None or self.record.file.gels:
            return ""
        return "no fingerprint of the gels yet"


class CalibrationStore:
    """Calibration files of one folder and one bench ``mode``.

    ``where``: argument that names the bench on the command line, such as "--bench lab.toml"; None:
    it is calibrated in the window.
    ``gels``: serial numbers of the left and the right gel, if known.
    """

    def __init__(
        self, folder: Path, mode: Mode, where: str | None = "", gels: tuple[str, str] | None = None
    ) -> None:
        self.folder: Path = folder
        self.mode: Mode = mode
        self._where = where
        self.gels: GelLedger = GelLedger(folder, mode, gels)

    def step(self, what: CalibrationName, *more: str) -> str:
        """Return the clause on how to measure a calibration; ``more``: arguments of the command."""
        if self._where is None:
            return f"measure {CALIBRATION_KINDS[what].title} in Calibrate (Ctrl+Shift+K)"
        verb, end = ("check-day", "") if what == "day" else (f"calibrate {what}", "--accept")
        return f"run '{' '.join(filter(None, ('touchdown', verb, self._where, end, *more)))}'"

    def day_checks(self, identity: BenchIdentity, bench_sha256: str = "") -> DayChecks:
        """Return the daily checks of a bench; ``bench_sha256`` names one without identity."""
        path = self.folder / f"day-checks-{self.mode}.jsonl"
        bench, required = identity.sha256 or bench_sha256, identity.daily_check
        gels = self.gels.serials
        return DayChecks(path, bench, self.step("day"), required=required, gels=gels)

    def check_writable(self) -> None:
        """Raise ``InputError`` unless calibrations and daily checks can be stored."""
        with core.disk_errors("The calibration cannot be written", self.folder, UNWRITABLE_FIX):
            core.check_writable(self.folder)
            for path in self.folder.glob(f"day-checks-{self.mode}.jsonl"):
                path.open("ab").close()

    def accept(
        self,
        measured: core.CalibrationMeasured,
        devices: Mapping[str, DeviceName],
        person: str = "",
        now: datetime | None = None,
        gels: Mapping[str, tuple[float, ...]] | None = None,
    ) -> Path:
        """Write a calibration and return its path. ``gels``: fingerprints as in the file.

        Raises ``RefusedError`` "RESIDUAL" or "OBSTACLE" if it is not acceptable, ``InputError`` if
        the folder cannot be written.
        """
        if measured.obstacle:
            raise core.RefusedError("OBSTACLE", measured.obstacle)
        if not measured.acceptable:
            raise core.RefusedError(
                "RESIDUAL",
                f"The residual of {measured.residual:.3g} {measured.unit} exceeds "
                f"{measured.limit:g} {measured.unit}: measure again.",
            )
        kind = next(kind for kind in CALIBRATION_KINDS.values() if kind.what == measured.what)
        date = (now or datetime.now(UTC)).replace(microsecond=0)
        file = CalibrationFile(
            what=kind.what,
            mode=self.mode,
            values={
                name: CalibrationValue(value=value, sigma=sigma, unit=unit)
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
        record = CalibrationRecord.of(file)
        path = self.folder / f"{kind.what}-{date:%Y%m%d-%H%M%S}-{record.sha256[:8]}.json"
        with core.disk_errors("The calibration cannot be written", path, UNWRITABLE_FIX):
            core.write_atomically(path, record.text().encode())
        return path

    def status(
        self, what: CalibrationName, devices: Mapping[str, DeviceName], now: datetime | None = None
    ) -> CalibrationStatus:
        """Return the validity of the newest calibration of a kind with the present ``devices``.

        Devices that are not connected are not compared.
        """
        status = partial(CalibrationStatus, what, step=self.step(what))
        try:
            record = self._newest(what)
            seen = record if what == "camera" else None
            replaced = {} if seen is None else self.gels.replaced_after(seen.file.date)
        except core.InputError as error:
            return status("damaged", None, f"{error.what} [{error.where}]")
        if record is None:
            return status("missing", None, "never calibrated on this bench")
        if other := record.foreign(devices):
            then = record.file.devices[other].serial or "another one"
            return status("other device", record, f"made with {other} {then}")
        if replaced:
            return status("gel replaced", record, " and ".join(replaced.values()))
        days = -record.days_left(now or datetime.now(UTC))
        if days > 0:
            age = f"{days:.0f} days" if days >= 2.0 else f"{math.ceil(24.0 * days)} h"
            return status("expired", record, f"expired {age} ago")
        return status("valid", record, "")

    def statuses(
        self, devices: Mapping[str, DeviceName], now: datetime | None = None
    ) -> list[CalibrationStatus]:
        """Return the validity of all calibrations."""
        return [self.status(what, devices, now) for what in CALIBRATION_NAMES]

    def in_use(
        self, devices: Mapping[str, DeviceName], *, required: bool, now: datetime | None = None
    ) -> dict[CalibrationName, CalibrationRecord]:
        """Return the valid calibrations; if ``required``, refuse an invalid one.

        Its reason is CALIBRATION-MISSING, -EXPIRED, -OTHER-DEVICE, -GEL-REPLACED or -DAMAGED.
        """
        used: dict[CalibrationName, CalibrationRecord] = {}
        for status in self.statuses(devices, now):
            if status.condition == "valid":
                assert status.record is not None
                used[status.what] = status.record
            elif required:
                title = CALIBRATION_KINDS[status.what].title
                raise core.RefusedError(
                    f"CALIBRATION-{status.condition.upper().replace(' ', '-')}",
                    f"{title}: {status.why}.",
                    status.fix,
                )
        return used

    def _newest(self, what: CalibrationName) -> CalibrationRecord | None:
        """Return the newest of this bench's mode; raises ``InputError`` if it is damaged."""
        # The names sort by date.
        for path in sorted(self.folder.glob(f"{what}-*.json"), reverse=True):
            record = read_record(path)
            if record.file.what == what and record.file.mode == self.mode:
                return record
        return None
