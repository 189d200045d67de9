"""Diagnostics of a bench at rest: identity of each device, timing of each sensor.

Nothing moves and the arm stays off; no rig process is needed. All time stamps use the clock of this
computer. Wrist samples are stamped by the sensor's own count, pictures and arm positions on
arrival.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
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
    """Answer of a device; ``fix`` is the remedy if there was none."""

    device: str
    ok: bool
    detail: str
    fix: str


def examine_devices(settings: HardwareSettings) -> Iterator[DeviceFinding]:
    """Yield a finding per device and close it again; raises ``InputError`` for bad settings."""
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
    with closing(device):
        device.connect(LIMIT_S, threading.Event())
        threading.Event().wait(LISTEN_S)
        identity, health = device.identity, device.health
    named = "" if identity is None else f"{identity.maker} {identity.model}, {identity.serial}; "
    return f"{named}{health.received / LISTEN_S:.0f} Hz"


LOOK_S = 0.002
LEAST = 5  # minimum number of stamps for a result

NewestStamp = Callable[[], float]  # stamp of the newest sample, s; NaN before the first
StampsSince = Callable[[float], FloatArray]  # stamps (n,) of all samples after a time, s


@dataclass(frozen=True, slots=True)
class SensorTiming:
    """Timing of one sensor: rate; in ms, the 99th percentile of the deviation from the median
    interval, the longest interval, and the age on arrival (median, 99th percentile). NaN for too
    few samples.
    """

    name: str
    samples: int
    rate_hz: float
    spread_ms: float
    gap_ms: float
    age_ms: float
    late_ms: float


def timing_of(name: str, stamps_s: FloatArray, ages_s: FloatArray) -> SensorTiming:
    """Return the timing of samples taken at ``stamps_s`` (n,), ``ages_s`` (m,) old on arrival."""
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
    """Observe all sensors for a time; ``wait`` sleeps for seconds."""
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
