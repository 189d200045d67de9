"""One accepted calibration as a small file: values, residual, date, devices, expiry, hash."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, ValidationError

from backend.calibration.gels import NUMBERS
from backend.calibration.kinds import KINDS, MIRRORS, ON, What
from backend.config.method import Settings
from backend.core.faults import InputError

VERSION = 1
MOST_CHARACTERS = 1_000_000
Finite = Annotated[float, Field(allow_inf_nan=False)]
Mode = Literal["simulated", "emulated", "hardware"]


class Value(Settings):
    """A number with its standard uncertainty and unit."""

    value: Finite
    sigma: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    unit: str


class DeviceName(Settings):
    """Who a device said it is."""

    maker: str
    model: str
    serial: str


class CalibrationFile(Settings):
    """What the file holds, apart from its hash. Dates are UTC."""

    version: Literal[1] = 1
    what: What
    mode: Mode
    values: dict[str, Value]
    residual: Finite
    limit: Finite
    unit: str
    note: str = ""
    person: str = ""
    date: datetime
    expires_days: Annotated[int, Field(ge=1)]
    devices: dict[str, DeviceName]
    about: str = ""
    """Which piece on which bottom, "" where neither matters."""
    gels: dict[str, tuple[Finite, ...]] = Field(default_factory=dict)
    """Of each camera, by its name in ``devices``, u and v of the 63 dots at rest: the fingerprint
    of its gel. Empty where none was taken."""

    @property
    def expires(self) -> datetime:
        """When it stops to hold."""
        return self.date + timedelta(days=self.expires_days)


@dataclass(frozen=True, slots=True)
class Record:
    """A calibration with the SHA-256 of its content."""

    file: CalibrationFile
    sha256: str

    @classmethod
    def of(cls, file: CalibrationFile) -> Record:
        """Return the record of ``file``."""
        return cls(file, content_sha256(file))

    def days_left(self, now: datetime) -> float:
        """Return for how many days it still holds; negative once it has expired."""
        return (self.file.expires - now) / timedelta(days=1)

    def foreign(self, devices: Mapping[str, DeviceName]) -> str:
        """Return the first device of ``devices`` that is not the one it was made with, else "".

        A device that tells no number goes by the name of its port, in whatever folder that is.
        """
        for name, now in devices.items():
            then = self.file.devices.get(name)
            if then is not None and _who(then) != _who(now):
                return name
        return ""

    def text(self) -> str:
        """Return the text of its file."""
        content = {**_content(self.file), "sha256": self.sha256}
        return json.dumps(content, indent=2, ensure_ascii=False) + "\n"


def _who(device: DeviceName) -> tuple[str, str, str]:
    return device.maker, device.model, device.serial.rpartition("/")[2]


def content_sha256(file: CalibrationFile) -> str:
    """Return the SHA-256 of the canonical JSON of ``file``."""
    content = json.dumps(_content(file), sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return sha256(content.encode()).hexdigest()


def _content(file: CalibrationFile) -> dict[str, object]:
    """Return what is written and hashed; files from before ``about``, ``gels`` keep their hash."""
    content = file.model_dump(mode="json")
    for later in ("about", "gels"):
        if not content[later]:
            del content[later]
    return content


def read_record(path: Path) -> Record:
    """Read a calibration; raises ``InputError`` if it is damaged, changed or of a newer version."""
    try:
        content = json.loads(_text(path))
        given = content.pop("sha256")
        file = CalibrationFile.model_validate(content)
    except (OSError, ValueError, KeyError, AttributeError, TypeError, RecursionError) as error:
        raise InputError(
            f"This is no calibration of version {VERSION}: {_first(error)}.",
            str(path),
            "Calibrate again; the damaged file can be deleted.",
        ) from error
    if given != content_sha256(file):
        raise InputError(
            "The calibration was changed after it was accepted.",
            str(path),
            "Calibrate again; a number is never corrected by hand.",
        )
    if file.date.tzinfo is None or file.date.utcoffset() != datetime.now(UTC).utcoffset():
        raise InputError("The date of the calibration is not UTC.", str(path), "Calibrate again.")
    if flaw := _flaw(file):
        raise InputError(flaw, str(path), "Calibrate again; the damaged file can be deleted.")
    return Record(file, given)


def _text(path: Path) -> str:
    with path.open(encoding="utf-8") as file:
        text = file.read(MOST_CHARACTERS + 1)
    if len(text) > MOST_CHARACTERS:
        raise ValueError(f"it is longer than {MOST_CHARACTERS} characters")
    return text


def _flaw(file: CalibrationFile) -> str:
    """Return what keeps a well-formed file from being applied, "" if nothing does."""
    for name in KINDS[file.what].values:
        if name not in file.values:
            return f"The calibration lacks '{name}'."
        if name.endswith("_mm_px") and not file.values[name].value > 0:
            return f"The calibration has no scale above zero: '{name}'."
    for name in ("left_mirror", "right_mirror"):
        if name in file.values and file.values[name].value not in range(len(MIRRORS)):
            return f"The calibration knows no such mirror: '{name}'."
    if file.about and len(file.about.split(ON)) != 2:
        return "The calibration does not say which piece was on which bottom."
    for name, numbers in file.gels.items():
        if len(numbers) != NUMBERS or name not in file.devices:
            return f"The calibration holds no fingerprint of a gel: '{name}'."
    return ""


def _first(error: Exception) -> str:
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        return f"'{where}': {first['msg']}"
    return str(error).splitlines()[0] if str(error) else type(error).__name__
