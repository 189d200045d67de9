"""Diagnostics of a bench at rest: identity of each device, timing of each sensor.

Nothing moves, the arm stays off; no rig process is needed. All stamps are on the clock of this
computer. A wrist sensor is stamped by its own count along the line of least delay, a picture or an
arm position on arrival.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from touchdown.backend.config import HardwareSettings
from touchdown.backend.core import FINGERS, FaultError, FloatArray, Stream
from touchdown.backend.devices import Device, make_tactile
from touchdown.backend.devices.melfa import MelfaArm
from touchdown.backend.rig.process import make_devices

LIMIT_S = 5.0
LISTEN_S = 0.5


@dataclass(frozen=True, slots=True)
class DeviceFinding:
    """What a device answered; ``fix`` says what to do where it did not."""

    device: str
    ok: bool
    detail: str
    fix: str


def examine_devices(settings: HardwareSettings) -> Iterator[DeviceFinding]:
    """Yield a finding per device; each is closed again. Raises ``InputError`` for bad settings."""
    made = make_devices(settings, time.monotonic)
    cameras = [
        make_tactile(finger, settings, time.monotonic, Stream(f"tactile_{finger}", 8))
        for finger in FINGERS
    ]
    for device in (made.force_torque, *cameras, made.gripper, made.arm):
        name = device.name
        try:
            detail = _device_detail(device)
        except FaultError as error:
            yield DeviceFinding(name, False, error.fault.what, error.fault.next_step)
        else:
            yield DeviceFinding(name, True, detail, "")


def _device_detail(device: Device) -> str:
    if isinstance(device, MelfaArm):
        who = device.examine()
        return f"{who.maker} {who.model}, {who.firmware}; not switched on"
    try:
        device.connect(LIMIT_S, threading.Event())
        threading.Event().wait(LISTEN_S)
        identity, health = device.identity, device.health
    finally:
        device.close()
    named = "" if identity is None else f"{identity.maker} {identity.model}, {identity.serial}; "
    return f"{named}{health.received / LISTEN_S:.0f} Hz"


LOOK_S = 0.002
LEAST = 5  # with fewer stamps nothing is told of a sensor

NewestStamp = Callable[[], float]  # stamp of the newest sample, s; NaN before the first
StampsSince = Callable[[float], FloatArray]  # stamps (n,) of all samples after a time, s


@dataclass(frozen=True, slots=True)
class SensorTiming:
    """Of one sensor: ``rate_hz``; in ms the 99 % limit of an interval's distance from the usual
    one, the longest interval, and how old a sample is when it comes (median, 99 %). NaN: too few.
    """

    name: str
    samples: int
    rate_hz: float
    spread_ms: float
    gap_ms: float
    age_ms: float
    late_ms: float


def timing_of(name: str, stamps_s: FloatArray, ages_s: FloatArray) -> SensorTiming:
    """Return the timing of ``stamps_s`` (n,) that were ``ages_s`` (m,) old when they came."""
    if len(stamps_s) < LEAST or len(ages_s) < LEAST:
        return SensorTiming(name, len(stamps_s), *(5 * (math.nan,)))
    steps_ms = 1e3 * np.diff(stamps_s)
    usual_ms = float(np.median(steps_ms))
    return SensorTiming(
        name,
        len(stamps_s),
        1e3 * len(steps_ms) / float(steps_ms.sum()),
        float(np.percentile(np.abs(steps_ms - usual_ms), 99)),
        float(steps_ms.max()),
        1e3 * float(np.median(ages_s)),
        1e3 * float(np.percentile(ages_s, 99)),
    )


def measure_timing(
    sensors: Mapping[str, tuple[NewestStamp, StampsSince]],
    now_s: Callable[[], float],
    wait: Callable[[float], object],
    for_s: float,
) -> list[SensorTiming]:
    """Watch all sensors for a time; ``wait`` lets seconds pass."""
    begun_s = now_s()
    seen_s = {name: newest() for name, (newest, _) in sensors.items()}
    ages_s: dict[str, list[float]] = {name: [] for name in sensors}
    while now_s() - begun_s < for_s:
        wait(LOOK_S)
        for name, (newest, _) in sensors.items():
            stamp_s = newest()
            if stamp_s != seen_s[name] and math.isfinite(stamp_s):
                seen_s[name] = stamp_s
                ages_s[name].append(now_s() - stamp_s)
    return [
        timing_of(name, since(begun_s), np.array(ages_s[name]))
        for name, (_, since) in sensors.items()
    ]
