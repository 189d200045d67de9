"""The lab file: devices of a bench, their addresses, and the limits of motion and force.

Emulated devices run on this computer; a real arm never does. The window shows the declared kind of
bench, so a file whose kind and addresses disagree is refused. Editing keeps comments and order, and
the new file is read back before it replaces the old one.
"""

from __future__ import annotations

import ipaddress
import json
import math
import re
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from touchdown.backend.config.bench_description import (
    BenchDescription,
    BenchIdentity,
    sha256_of_json,
    wrist_frame,
)
from touchdown.backend.config.hardware import LAB_FILE_KEYS, DeviceSettings, HardwareSettings
from touchdown.backend.config.method import Force, NonNegative, Positive, Settings, Speed
from touchdown.backend.config.toml_file import parse_settings, read_toml
from touchdown.backend.core import InputError, write_atomically

ADDRESS_URL = re.compile(r"(?:socket|udp|tcp)://(?:[^@/]*@)?(?P<host>\[[^\]]+\]|[^:/]+)")
TERMINALS = Path("/dev/pts")
# MEMORY holds temporary files, not devices.
DEVICES, MEMORY = Path("/dev"), Path("/dev/shm")  # noqa: S108 - only compared
# Setting with the address of the arm, by driver.
ARM_HOSTS = {"melfa": "melfa.host", "ur": "ur.host"}


def _require_matching_addresses(settings: HardwareSettings, kind: str, where: str) -> None:
    """Raise ``InputError`` where ``kind`` ("hardware" or "emulated") and an address disagree."""
    for key, here in _addresses(settings):
        if kind == "emulated" and not here:
            raise InputError(
                f"Bad value for 'kind': the bench is declared emulated, but '{key}' is not the "
                "address of an emulated device.",
                where,
                f"Write kind = \"hardware\", or correct '{key}': an absolute path, or 127.0.0.1.",
            )
        if kind == "hardware" and here and key == ARM_HOSTS.get(settings.melfa.driver):
            raise InputError(
                "Bad value for 'kind': the bench is declared hardware, but its arm is on this "
                "computer, like an emulated one.",
                where,
                f"Write kind = \"emulated\", or correct '{key}'.",
            )


def _addresses(settings: HardwareSettings) -> Iterator[tuple[str, bool]]:
    """Yield (key, True if it is a possible address of an emulated device)."""
    arm = "ur" if settings.melfa.driver == "ur" else "melfa"
    yield f"{arm}.host", is_loopback(getattr(settings, arm).host)
    yield "wsg.host", is_loopback(settings.wsg.host)
    # Without an address these two are read through the controller of their arm.
    if settings.ft.driver not in ("melfa", "ur") or settings.ft.address:
        yield "ft.address", _is_here(settings.ft.address)
    gelsight = settings.gelsight
    if gelsight.driver != "gelsight":
        # Addresses of other cameras are known to their drivers only.
        return
    filmed = bool(gelsight.left.file and gelsight.right.file)
    yield "gelsight.by_id", filmed or not _is_device(Path(gelsight.by_id))


def is_loopback(host: str) -> bool:
    """Return True if ``host`` is a loopback address."""
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"


def _is_here(address: str) -> bool:
    found = ADDRESS_URL.match(address)
    if found:
        return is_loopback(found["host"])
    path = Path(address)
    if not path.is_absolute():
        return False
    target = path.resolve()
    # For a dangling link the path of the link itself decides.
    return _is_below(target, TERMINALS) or not _is_device(target)


def _is_device(path: Path) -> bool:
    return _is_below(path, DEVICES) and not _is_below(path, MEMORY)


def _is_below(path: Path, folder: Path) -> bool:
    return path == folder or folder in path.parents


LAB_FILE_VERSION = 1
Age = Annotated[float, Field(gt=0, le=10)]  # s
LabKind = Literal["hardware", "emulated"]


class Limits(DeviceSettings):
    """Limits of motion and force in the bench frame; commands beyond them are refused.

    The workspace is the part of the box within ``reach_mm`` of its vertical axis.
    """

    retired = frozenset({"press_n"})

    reach_mm: Positive = 150.0
    least_x_mm: float = -150.0
    most_x_mm: float = 150.0
    least_y_mm: float = -150.0
    most_y_mm: float = 150.0
    lowest_mm: float = 0.0
    highest_mm: float = 400.0
    speed_mm_s: Speed = 50.0
    contact_speed_mm_s: Speed = 2.0
    contact_n: Force = 1.0
    trip_n: Force = 40.0
    trip_at_once_n: Force = 60.0
    trip_nm: Annotated[float, Field(gt=0, le=50)] = 1.5
    probe_n: Force = 30.0
    jog_mm_s: Speed = 50.0
    jog_guard_n: Force = 15.0
    near_mm: NonNegative = 10.0
    recovery_mm_s: Speed = 5.0
    tilt_rad: Annotated[float, Field(gt=0, le=math.pi / 2)] = math.radians(15.0)
    turn_rad_s: Positive = math.radians(15.0)
    turn_clear_mm: NonNegative = 20.0
    wrench_age_s: Age = 0.3
    frame_age_s: Age = 0.5

    @model_validator(mode="after")
    def _in_order(self) -> Limits:
        for low, high in ORDERED_LIMITS:
            if not getattr(self, low) <= getattr(self, high):
                raise ValueError(f"'{low}' is above '{high}'")
        return self


# The first of each pair must not exceed the second.
ORDERED_LIMITS = (
    ("least_x_mm", "most_x_mm"),
    ("least_y_mm", "most_y_mm"),
    ("lowest_mm", "highest_mm"),
    ("contact_speed_mm_s", "jog_mm_s"),
    ("recovery_mm_s", "jog_mm_s"),
    ("jog_mm_s", "speed_mm_s"),
    ("contact_n", "jog_guard_n"),
    ("jog_guard_n", "trip_n"),
    ("probe_n", "trip_n"),
    ("trip_n", "trip_at_once_n"),
)


class MountingSettings(Settings):
    """Payload and position of the wrist sensor."""

    sensor_height_mm: Positive = 120.0  # sensor above the grasp pivot
    sensor_yaw_rad: float = 0.0  # remaining yaw after ``ft.rotation``
    payload_kg: NonNegative = 1.5  # gripper and fingers
    # Their centre of mass relative to the grasp pivot.
    payload_com_mm: tuple[float, float, float] = (0.0, 0.0, 60.0)


class SerialNumbers(Settings):
    """Required serial numbers; empty: any. Cameras are identified by ``gelsight.*.serial``."""

    force_torque: str = ""
    gripper: str = ""
    arm: str = ""


class LabSettings(HardwareSettings):
    """One bench: its name, its limits, its devices (one table each)."""

    version: Literal[1]
    # Shown in the window frame and stored in every recording.
    name: Annotated[str, Field(min_length=1, max_length=32)]
    kind: LabKind
    piece: str = "pot"
    bottom: str = "short"  # on the bench at the start; bottom-up and joined by + for a tower
    calibrations: str = "calibrations"  # folder of the calibrations, relative to this file
    daily_check: bool = False  # ask before each release on a day without a daily check
    limits: Limits = Limits()
    mounting: MountingSettings = MountingSettings()
    serials: SerialNumbers = SerialNumbers()


@dataclass(frozen=True, slots=True)
class Lab:
    """A lab file and its settings."""

    path: Path
    settings: LabSettings

    @property
    def calibrations(self) -> Path:
        """Folder of its calibrations."""
        return self.path.parent / self.settings.calibrations

    @property
    def identity(self) -> BenchIdentity:
        """Bench as named by a certificate; the file decides, not later calibrations."""
        facts = self.facts
        sha256 = sha256_of_json([facts.sha256, *facts.gels]) if facts.gels else facts.sha256
        settings = self.settings
        return BenchIdentity(settings.name, sha256, self.calibrations, settings.daily_check)

    @property
    def facts(self) -> BenchDescription:
        """Description of the bench, on which the numbers of an observation depend."""
        settings = self.settings
        mounting, gelsight, ft = settings.mounting, settings.gelsight, settings.ft
        fingers = gelsight.left, gelsight.right
        gels = gelsight.left.gel, gelsight.right.gel
        scale = 0.5 * (gelsight.mm_per_px_x + gelsight.mm_per_px_y)
        kept = {
            "name": settings.name,
            "ft": [ft.driver, ft.rotation, ft.sign],
            "mounting": mounting.model_dump(mode="json"),
            "gelsight": [gelsight.mm_per_px_x, gelsight.mm_per_px_y, gelsight.crop_fraction],
            "fingers": [f.model_dump(mode="json", exclude={"gel"}) for f in fingers],
        }
        return BenchDescription(
            mode=settings.kind,
            sha256=sha256_of_json(kept),
            mm_per_px=(scale, scale),
            ft_frame=wrist_frame(mounting.sensor_height_mm, mounting.sensor_yaw_rad),
            sensor_height_mm=mounting.sensor_height_mm,
            gels=gels if any(gels) else None,
        )


def is_lab_file(path: Path) -> bool:
    """Return True if ``path`` is a lab file, not a simulated bench; raises ``InputError``."""
    return bool(LAB_FILE_KEYS & read_toml(path).keys())


def load_lab(path: Path) -> Lab:
    """Read a lab file; raises ``InputError`` naming file, key and reason."""
    return Lab(path, _parsed(read_toml(path), path))


def _parsed(content: dict[str, Any], path: Path) -> LabSettings:
    """Return the settings of a lab file; raises ``InputError``, also for another version."""
    version = content.get("version")
    if version != LAB_FILE_VERSION or isinstance(version, bool):
        what = f"Bad value for 'version': {version!r} is not known here ({LAB_FILE_VERSION})."
        fix = f"Write 'version = {LAB_FILE_VERSION}', or use the Touchdown that wrote the file."
        raise InputError(what, str(path), fix)
    settings = parse_settings(LabSettings, content, str(path))
    _require_matching_addresses(settings, settings.kind, str(path))
    return settings


LabValue = str | int
_KEY = r"\s*{}\s*="
_SECTION = re.compile(r"\s*\[\s*([^\[\]]+?)\s*\]\s*(#.*)?$")


def save_lab(path: Path, values: Mapping[str, LabValue]) -> bool:
    """Set ``values`` by dotted key in the lab file ``path``; return True if it changed.

    Raises ``InputError``, without a change, if the result would not be a valid lab file.
    """
    before = path.read_text("utf-8") if read_toml(path) else ""
    after = edit_toml(before, values, str(path))
    if after == before:
        return False
    _parsed(tomllib.loads(after), path)
    write_atomically(path, after.encode())
    return True


def edit_toml(text: str, values: Mapping[str, LabValue], where: str) -> str:
    """Return the TOML ``text`` with ``values`` set; raises ``InputError`` if not possible."""
    content = tomllib.loads(text)
    lines = text.splitlines()
    for key, value in values.items():
        if _get(content, key) == value:
            continue
        _set(content, key, value)
        lines = _edit_line(lines, key, content)
    after = "\n".join(lines) + "\n"
    try:
        same = tomllib.loads(after) == content
    except tomllib.TOMLDecodeError:
        same = False
    if not same:
        fix = f"Set {', '.join(values)} by hand."
        raise InputError("The layout of the file is not supported by the editor.", where, fix)
    return after if after.strip() != text.strip() else text


def _edit_line(lines: list[str], key: str, content: dict[str, Any]) -> list[str]:
    """Return the lines with ``key`` as in ``content``: replaced, or in a new line."""
    table, _, name = key.rpartition(".")
    while table:
        begin, end = _section(lines, table)
        for at in range(begin, end):
            if re.match(_KEY.format(re.escape(name)), lines[at]):
                written = f"{name} = {_toml(_get(content, f'{table}.{name}'))}"
                return [*lines[:at], written + _comment(lines[at]), *lines[at + 1 :]]
        outer, _, inner = table.rpartition(".")
        begin, end = _section(lines, outer)
        if not any(re.match(_KEY.format(re.escape(inner)), line) for line in lines[begin:end]):
            break
        # An inline table is written again as a whole.
        table, name = outer, inner
    table, _, name = key.rpartition(".")
    written = f"{name} = {_toml(_get(content, key))}"
    begin, end = _section(lines, table)
    if begin == end == 0:
        return [*lines, "", f"[{table}]", written]
    while end > begin and not lines[end - 1].strip():
        end -= 1
    return [*lines[:end], written, *lines[end:]]


def _section(lines: list[str], table: str) -> tuple[int, int]:
    """Return begin and end of the lines of ``table``; (0, 0) without a header."""
    heads = [(at, match[1]) for at, line in enumerate(lines) if (match := _SECTION.match(line))]
    ends = [at for at, _ in heads[1:]] + [len(lines)]
    for (at, name), end in zip(heads, ends, strict=False):
        if re.sub(r"\s", "", name) == table:
            return at + 1, end
    return 0, 0


def _comment(line: str) -> str:
    """Return the comment after a value with its leading space, or ""."""
    quoted = re.sub(r'"(?:[^"\\]|\\.)*"|\'[^\']*\'', lambda m: "_" * len(m[0]), line)
    at = quoted.find("#")
    return "" if at < 0 else line[len(quoted[:at].rstrip()) :]


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {_toml(v)}" for k, v in value.items()) + " }"
    return json.dumps(value, ensure_ascii=False)


def _get(content: dict[str, Any], key: str) -> Any:
    found: Any = content
    for part in key.split("."):
        found = found.get(part) if isinstance(found, dict) else None
    return found


def _set(content: dict[str, Any], key: str, value: LabValue) -> None:
    *tables, name = key.split(".")
    for part in tables:
        content = content.setdefault(part, {})
    content[name] = value
