"""Diagnostics of a bench at rest: identity of each device, timing of each sensor.

Nothing moves and the arm stays off; no rig process is needed. All time stamps use the clock of this
computer. Wrist samples are stamped by the sensor's own count, pictures and arm positions on
arrival.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from touchdown.backend import core
from touchdown.backend.config import HardwareSettings
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
        make_tactile(finger, settings, time.monotonic, core.Stream(f"tactile_{finger}", 8))
        for finger in core.FINGERS
    ]
    for device in (made.force_torque, *cameras, made.gripper, made.arm):
        name = device.name
        try:
            detail = _device_detail(device)
        except core.FaultError as error:
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
LEAST = 5  # minimum number of samples for a result

_SensorStream = core.SampleStream | core.Stream[core.TactileFrame]


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


def measure_timing(
    raw: core.RawStreams, now_s: Callable[[], float], wait: Callable[[float], object], for_s: float
) -> list[SensorTiming]:
    """Observe all sensors for a time; ``wait`` sleeps for seconds."""
    streams: list[_SensorStream] = [raw.samples, raw.poses, *raw.frames.values()]
    begun_s = now_s()
    seen_s = {stream.name: begun_s for stream in streams}
    ages_s: dict[str, list[float]] = {name: [] for name in seen_s}
    while now_s() - begun_s < for_s:
        wait(LOOK_S)
        for stream in streams:
            fresh_s = _stamps_s(stream, np.nextafter(seen_s[stream.name], math.inf))
            if len(fresh_s):
                seen_s[stream.name] = float(fresh_s[-1])
                ages_s[stream.name].append(now_s() - seen_s[stream.name])
    return [_timing_of(one.name, _stamps_s(one, begun_s), ages_s[one.name]) for one in streams]


def _stamps_s(stream: _SensorStream, begin_s: float) -> core.FloatArray:
    if isinstance(stream, core.SampleStream):
        return stream.window(begin_s, math.inf).t_s
    return np.array([frame.t_s for frame in stream.between(begin_s, math.inf)])


def _timing_of(name: str, stamps_s: core.FloatArray, ages_s: list[float]) -> SensorTiming:
    if min(len(stamps_s), len(ages_s)) < LEAST:
        return SensorTiming(name, len(stamps_s), *(5 * (math.nan,)))
    steps_ms = 1e3 * np.diff(stamps_s)
    spread_ms = np.percentile(np.abs(steps_ms - np.median(steps_ms)), 99)
    age_ms, late_ms = 1e3 * np.percentile(ages_s, (50, 99))
    figures = (1e3 / steps_ms.mean(), spread_ms, steps_ms.max(), age_ms, late_ms)
    return SensorTiming(name, len(stamps_s), *map(float, figures))
