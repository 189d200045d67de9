"""Planned faults of emulated devices, applied to their wires, signals, sample rates.

A fault plan is TOML::

    seed = 7
    [[fault]]
    at_s = 2.0
    device = "force_torque"
    kind = "flip"
    for_s = 1.5       # without it: until the end
    share = 0.1       # of the messages; default all
"""

from __future__ import annotations

import math
import random
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

from pydantic import Field, ValidationError, model_validator

from touchdown.backend import config
from touchdown.backend.core import Decimator, InputError
from touchdown.backend.emulation.simulated_disturbances import FAULT_FORM

# lost: a message is missing; flip: one bit is wrong; garbage: random bytes before a message; cut:
# its end is missing; duplicate: sent twice; late: sent ``by_s`` later; silent: nothing is sent, the
# wire stays open; unplug: the wire is gone until the end of the fault.
WIRE_KINDS = ("lost", "flip", "garbage", "cut", "duplicate", "late", "silent", "unplug")
DATAGRAM_KINDS = ("reorder",)  # two datagrams are swapped
# fade: the brightness halves each second; other_gel, small_dots: another gel is fitted, of the same
# kind or with 8 x 10 dots.
CAMERA_KINDS = ("freeze", "dark", "slow", "fade", "other_gel", "small_dots")
# Kinds by device. slow: at most ``hz`` samples per second; drift: Fz changes by ``n_per_s`` and
# keeps its last value; stall: the motors of the arm do not move.
DEVICE_KINDS: dict[str, tuple[str, ...]] = {
    "force_torque": ("freeze", "saturate", "slow", "drift"),
    "gripper": ("part_lost", "fast_stop", "power"),
    "tactile_left": CAMERA_KINDS,
    "tactile_right": CAMERA_KINDS,
    "arm": ("alarm", "estop", "servo_off", "stall"),
}
# Fault kind -> required field, its meaning; not allowed for other kinds.
AMOUNTS = {
    "slow": ("hz", "how many samples a second"),
    "drift": ("n_per_s", "by how many N a second"),
}

FaultShare = Annotated[float, Field(gt=0, le=1)]
LONGEST_GARBAGE = 64


class PlannedFault(config.Settings):
    """One fault; ``at_s`` counts from the start of the emulator."""

    at_s: config.NonNegative
    device: str
    kind: str
    for_s: config.Positive | None = None
    share: FaultShare = 1.0
    by_s: config.Positive = 0.1
    hz: config.Positive | None = None
    n_per_s: float | None = None

    @model_validator(mode="after")
    def _known(self) -> PlannedFault:
        if self.device not in DEVICE_KINDS:
            raise ValueError(f"no device '{self.device}': use one of {', '.join(DEVICE_KINDS)}")
        kinds = (*WIRE_KINDS, *DATAGRAM_KINDS, *DEVICE_KINDS[self.device])
        if self.kind not in kinds:
            raise ValueError(
                f"'{self.device}' has no fault '{self.kind}': use one of {', '.join(kinds)}"
            )
        for kind, (amount, what) in AMOUNTS.items():
            if (self.kind == kind) != (getattr(self, amount) is not None):
                raise ValueError(f"'{amount}', {what}, belongs to '{kind}' and to no other")
        return self

    def holds(self, t_s: float) -> bool:
        """Return True if the fault is active ``t_s`` after the start."""
        return self.at_s <= t_s < self.at_s + (float("inf") if self.for_s is None else self.for_s)


class FaultPlan(config.Settings):
    """All planned faults; ``seed`` makes random faults reproducible."""

    seed: int = 0
    fault: tuple[PlannedFault, ...] = ()


def load_faults(path: Path) -> FaultPlan:
    """Read a fault plan; raises ``InputError`` naming the first bad entry."""
    return config.read_settings(FaultPlan, path)


def parse_fault(text: str) -> PlannedFault:
    """Return the fault of a text such as ``gripper:fast_stop@5`` or ``arm:silent@3+0.5``.

    An amount follows the kind: ``force_torque:slow=300@3``. Raises ``InputError``.
    """
    match = FAULT_FORM.fullmatch(text.strip())
    if match is None:
        fix = "Write device:kind@seconds or device:kind@seconds+seconds."
        raise InputError(f"'{text}' is not a fault.", text, fix)
    values: dict[str, object] = {"device": match["device"], "kind": match["kind"]}
    values["at_s"] = float(match["start"])
    if match["length"]:
        values["for_s"] = float(match["length"])
    if match["much"]:
        name, _ = AMOUNTS.get(match["kind"], AMOUNTS["slow"])
        values[name] = float(match["much"])
    try:
        return PlannedFault.model_validate(values)
    except ValidationError as error:
        what = f"This is no fault of the emulated bench: {config.first_error_message(error)}."
        raise InputError(what, text, "Choose another device or kind.") from error


class Faults:
    """Faults of one running device; ``inject`` may be called from any thread."""

    def __init__(self, device: str, plan: FaultPlan | None = None) -> None:
        plan = plan or FaultPlan()
        self.device = device
        self._planned = [fault for fault in plan.fault if fault.device == device]
        self._rng = random.Random(plan.seed)  # noqa: S311
        self._begun_s: float | None = None
        self._lock = threading.Lock()
        self._held: list[tuple[float, bytes]] = []

    def begin(self, now_s: float) -> None:
        """Start the time of the plan."""
        self._begun_s = now_s

    def inject(self, now_s: float, kind: str, for_s: float | None = None, **more: float) -> None:
        """Start a fault now; raises ``ValueError`` for a kind that this device does not have."""
        at_s = max(0.0, self._since(now_s))
        fault = PlannedFault.model_validate(
            {"at_s": at_s, "device": self.device, "kind": kind, "for_s": for_s, **more}
        )
        with self._lock:
            self._planned.append(fault)

    def clear(self) -> None:
        """Remove all faults, active and planned."""
        with self._lock:
            self._planned.clear()

    def find(self, kind: str, now_s: float) -> PlannedFault | None:
        """Return the active fault of this kind."""
        t_s = self._since(now_s)
        with self._lock:
            return next((f for f in self._planned if f.kind == kind and f.holds(t_s)), None)

    def active(self, kind: str, now_s: float) -> bool:
        """Return True if a fault of this kind is active."""
        return bool(self._planned) and self.find(kind, now_s) is not None

    def drift_n(self, now_s: float) -> float:
        """Return the drift of the sensor, N."""
        if not self._planned:
            return 0.0
        t_s = self._since(now_s)
        with self._lock:
            drifts = [f for f in self._planned if f.n_per_s is not None]
        return sum(
            (f.n_per_s or 0.0) * min(max(t_s - f.at_s, 0.0), f.for_s or math.inf) for f in drifts
        )

    def names(self, now_s: float) -> tuple[str, ...]:
        """Return the active kinds, for display."""
        t_s = self._since(now_s)
        with self._lock:
            return tuple(dict.fromkeys(f.kind for f in self._planned if f.holds(t_s)))

    def outgoing(self, now_s: float, messages: Sequence[bytes]) -> list[bytes]:
        """Return the messages that are sent in place of ``messages``."""
        if not self._planned and not self._held:
            return list(messages)
        if self.active("silent", now_s) or self.active("unplug", now_s):
            self._held.clear()
            return []
        sent = [piece for message in messages for piece in self._damaged(now_s, message)]
        if len(sent) > 1 and self._occurs("reorder", now_s):
            sent[-2:] = sent[:-3:-1]
        due = [message for at_s, message in self._held if at_s <= now_s]
        self._held = [item for item in self._held if item[0] > now_s]
        return due + sent

    def _damaged(self, now_s: float, message: bytes) -> list[bytes]:
        if not message or self._occurs("lost", now_s):
            return []
        if self._occurs("flip", now_s):
            at = self._rng.randrange(len(message))
            spoilt = message[at] ^ (1 << self._rng.randrange(8))
            message = message[:at] + bytes((spoilt,)) + message[at + 1 :]
        if self._occurs("cut", now_s):
            message = message[: self._rng.randrange(len(message))]
        if self._occurs("garbage", now_s):
            message = self._rng.randbytes(self._rng.randint(1, LONGEST_GARBAGE)) + message
        late = self.find("late", now_s)
        if late is not None and self._rng.random() < late.share:
            self._held.append((now_s + late.by_s, message))
            return []
        return [message, message] if self._occurs("duplicate", now_s) else [message]

    def _occurs(self, kind: str, now_s: float) -> bool:
        fault = self.find(kind, now_s)
        return fault is not None and self._rng.random() < fault.share

    def _since(self, now_s: float) -> float:
        return now_s - self._begun_s if self._begun_s is not None else -1.0


NOISE = (0.1, 0.1, 0.1, 0.004, 0.004, 0.004)  # standard deviation of one sample, N and N·m
GRIPPER_N = -14.7  # a gripper of 1.5 kg hangs below the sensor
BEYOND = 1e5  # a load beyond the range of every sensor, N and N·m


def add_noise(
    wrench: Callable[[float], Sequence[float]], noise: Sequence[float] = NOISE, seed: int = 0
) -> Callable[[float], tuple[float, ...]]:
    """Return ``wrench`` with independent noise on every sample."""
    rng = random.Random(seed)  # noqa: S311

    def felt(now_s: float) -> tuple[float, ...]:
        pairs = zip(wrench(now_s), noise, strict=True)
        return tuple(rng.gauss(value, sigma) for value, sigma in pairs)

    return felt


def hanging_gripper(now_s: float, swing_n: float = 0.3, period_s: float = 4.0) -> tuple[float, ...]:
    """Return the wrench of a slowly swaying gripper, (6,) N and N·m."""
    sway_n = swing_n * math.sin(2 * math.pi * now_s / period_s)
    return sway_n, 0.5 * sway_n, GRIPPER_N, 0.0, 0.05 * sway_n, 0.0


def apply_faults(
    wrench: Callable[[float], Sequence[float]], faults: Faults
) -> Callable[[float], tuple[float, ...]]:
    """Return ``wrench`` as measured by a sensor with these faults: freeze, saturate, drift."""
    last: tuple[float, ...] | None = None

    def felt(now_s: float) -> tuple[float, ...]:
        nonlocal last
        if faults.active("saturate", now_s):
            return (BEYOND,) * 6
        if last is None or not faults.active("freeze", now_s):
            x, y, z, *moments = wrench(now_s)
            last = (x, y, z + faults.drift_n(now_s), *moments)
        return last

    return felt


# Maximum number of samples sent after a pause; older ones are lost, as in an adapter's buffer.
MOST_DUE = 200


class SampleSchedule:
    """Schedule of the samples of one stream; none are due before ``begin`` and after ``end``."""

    def __init__(self) -> None:
        self._start_s: float | None = None
        self._period_s = 1.0
        self._sent = 0
        self._decimator = Decimator()
        # Faults of the sensor: ``slow`` reduces the number of samples due.
        self.faults: Faults | None = None

    @property
    def running(self) -> bool:
        """True while the stream runs."""
        return self._start_s is not None

    def begin(self, now_s: float, period_s: float) -> None:
        """Start or restart the stream; the first sample is due now."""
        self._start_s, self._period_s, self._sent = now_s, period_s, 0

    def end(self) -> None:
        """End the stream."""
        self._start_s = None

    def due(self, now_s: float) -> tuple[int, list[float]]:
        """Return the number of lost samples and the times of those due by now, s."""
        if self._start_s is None:
            return 0, []
        end = math.floor((now_s - self._start_s) / self._period_s + 1e-6) + 1
        late = max(0, end - self._sent - MOST_DUE)
        first, self._sent = self._sent + late, max(end, self._sent)
        times_s = [self._start_s + k * self._period_s for k in range(first, end)]
        return late, [t_s for t_s in times_s if self._taken(t_s)]

    def _taken(self, t_s: float) -> bool:
        slow = None if self.faults is None else self.faults.find("slow", t_s)
        return slow is None or slow.hz is None or self._decimator.takes(t_s, slow.hz)
