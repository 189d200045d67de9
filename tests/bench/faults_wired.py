"""Faults of the emulated devices while whole trials run over the wires, in real time.

Drivers, rig process, sockets, terminals and pipes are those of a lab day; a fault strikes one
device at a random instant, from connecting to the retreat after the release. What the driver sent
is judged by the emulated devices themselves, which know nothing of what it meant.
"""

from __future__ import annotations

import random
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np

from tests.bench.registry import Figure, figure
from touchdown.backend.bench.assembly import SimulatedBenchChoice
from touchdown.backend.bench.emulated import EmulatedBench
from touchdown.backend.bench.emulated_scene import DriverObservations
from touchdown.backend.core.events import (
    EpisodeRecorded,
    Event,
    FaultRaised,
    Paused,
    PhaseEntered,
    RunFinished,
    TrialFinished,
)
from touchdown.backend.core.faults import FaultError, RefusedError
from touchdown.backend.emulation.fault_plan import FaultPlan
from touchdown.backend.episodes.episode_file import read_episode
from touchdown.backend.runs.recorder import RecordingOptions
from touchdown.backend.runs.requests import StackRequest

FIRST = 20_000
EARLIEST_S, LATEST_S = 0.5, 16.0
"""When a fault begins, after the devices are there: from the first step of connecting on."""
SETTLE_S, SURELY_S = 1.0, 4.0
"""An arm stands so long after a trial; a trial that goes on for so long after its fault met it."""
MOST_SHARE, MOST_LATE_S, MOST_N, STANDS_MM = 0.5, 0.15, 60.0, 0.05
"""Step share of `melfa.mxt.step_fraction`; a stream may go on for 29 cycles before its end is
known; the highest force of reliability section 4.7; an arm that stands."""

ARM = {"MXT-LOST", "MXT-ENDED", "MXT-START", "ARM-LINK", "ARM-STALE", "HW-STOP", "CONTROLLER"} | {
    *("NOT-READY", "REJECTED", "SERVO-OFF", "OUT-OF-RANGE", "PRESS-VOID", "RIG-STARVED"),
}
WRIST = {"FT-LINK", "FT-STALE", "FT-SENSOR", "FT-OVERLOAD", "FT-TRIP", "TARE-REFUSED"} | {
    *("PRESS-VOID", "NO-WRIST", "PROBE-REJECTED", "DEGRADED"),
}
GRIPPER = {"WSG-LINK", "WSG-FAST-STOP", "WSG-DEVICE", "WSG-TIMEOUT", "WSG-ABORTED"} | {
    *("PIECE-LOST", "GRIP-STALE", "NOT-HOMED", "NO-PIECE"),
}
CAMERA = {
    *("CAMERA-LINK", "CAMERA-STALE", "CAMERA-FROZEN", "CAMERA-DARK", "NO-REFERENCE"),
    *("PROBE-REJECTED", "DEGRADED"),
}
LOAD = {
    *("BACKEND-SILENT", "LEASE-LAPSED", "MXT-LOST", "PRESS-VOID", "FT-STALE", "CAMERA-STALE"),
    *("PROBE-REJECTED", "DEGRADED"),
}
"""What a computer that is busy elsewhere brings about (docs/hardware.md): counted apart."""
CODES = {
    "arm": ARM,
    "force_torque": WRIST,
    "gripper": GRIPPER,
    "tactile_left": CAMERA,
    "tactile_right": CAMERA,
}


@dataclass(frozen=True)
class Kind:
    """One kind of fault of one device; ``ends``: no trial goes on with it."""

    device: str
    kind: str
    for_s: float
    ends: bool = False
    more: dict[str, float] = field(default_factory=dict)


def of_wire(device: str, share: float, for_s: float, *kinds: str) -> tuple[Kind, ...]:
    return tuple(Kind(device, kind, for_s, more={"share": share}) for kind in kinds)


KINDS = (
    *of_wire("arm", 0.2, 2.0, "lost", "duplicate", "reorder", "garbage"),
    *(Kind("arm", "late", 2.0, more={"share": 0.2, "by_s": 0.02}), Kind("arm", "silent", 0.06)),
    *(Kind("arm", "silent", 1.0, True), Kind("arm", "unplug", 1.0, True)),
    *(Kind("arm", kind, 1.0, True) for kind in ("alarm", "estop", "servo_off")),
    *of_wire("force_torque", 0.05, 1.0, "lost", "duplicate", "flip", "garbage", "cut"),
    *(Kind("force_torque", "silent", 0.06), Kind("force_torque", "silent", 1.0, True)),
    *(Kind("force_torque", "unplug", 1.0, True), Kind("force_torque", "freeze", 1.0, True)),
    *(Kind("force_torque", "saturate", 0.6, True), Kind("force_torque", "slow", 3.0)),
    *of_wire("gripper", 0.1, 1.0, "duplicate", "garbage"),
    *(Kind("gripper", "silent", 0.2), Kind("gripper", "silent", 2.0), Kind("gripper", "unplug", 1)),
    *(Kind("gripper", kind, 1.0, True) for kind in ("part_lost", "fast_stop", "power")),
    *(
        Kind(camera, kind, for_s, ends, more)
        for camera in ("tactile_left", "tactile_right")
        for kind, for_s, ends, more in (
            ("lost", 2.0, False, {"share": 0.2}),
            ("cut", 2.0, False, {"share": 0.2}),
            ("silent", 0.2, False, {}),
            ("silent", 1.5, True, {}),
            ("unplug", 1.5, True, {}),
            ("freeze", 1.0, True, {}),
            ("dark", 1.5, False, {}),
            ("slow", 3.0, False, {"hz": 8.0}),
        )
    ),
)
SLOW_HZ = 300.0


Told = TypeVar("Told", bound=Event)


@dataclass
class Heard:
    """What a trial told, and when its arm first moved (monotonic)."""

    facts: list[Event] = field(default_factory=list)
    moved_s: float = float("inf")

    def codes(self) -> set[str]:
        """Return the faults that ended it or made it pause."""
        return {f.fault.code for f in self.facts if isinstance(f, FaultRaised | Paused)}

    def of(self, kind: type[Told]) -> list[Told]:
        """Return the facts of one kind."""
        return [fact for fact in self.facts if isinstance(fact, kind)]


@dataclass(frozen=True)
class Struck:
    """One trial: what struck it when, how it ended, and which rows do not hold."""

    seed: int
    kind: Kind
    at_s: float
    ended: str
    broken: tuple[str, ...]
    loaded: bool = False
    """Ended by what the load of the computer brings about, not by the fault."""

    def __str__(self) -> str:
        what = f"{self.kind.device} {self.kind.kind} {self.kind.for_s:g} s"
        return f"seed {self.seed}, {what} at {self.at_s:.1f} s, {self.ended}: {self.broken}"


class Campaign:
    """Trials on one emulated bench, one after the other; each begins from Reset and a new scene."""

    def __init__(self, folder: Path) -> None:
        self.bench = EmulatedBench(SimulatedBenchChoice(), keep=RecordingOptions(folder))
        self.bench.session.events.subscribe(self._hear)
        self._heard = Heard()

    def _hear(self, fact: Event) -> None:
        heard = self._heard
        heard.facts.append(fact)
        if isinstance(fact, PhaseEntered):
            heard.moved_s = min(heard.moved_s, time.monotonic())

    def trial(self, seed: int) -> Struck:
        """Run one; a fault that strikes while its devices are connected ends it there."""
        rng = random.Random(seed)
        kind = KINDS[seed % len(KINDS)]
        at_s = rng.uniform(EARLIEST_S, LATEST_S)
        more = {"hz": SLOW_HZ} | kind.more if kind.kind == "slow" else kind.more
        strike = {"at_s": at_s, "device": kind.device, "kind": kind.kind, "for_s": kind.for_s}
        self.bench.plan = FaultPlan.model_validate({"seed": seed, "fault": [strike | more]})
        session, self._heard = self.bench.session, Heard()
        begun_s, code = time.monotonic(), ""
        try:
            session.run(StackRequest("pot", ("short",), seed))
        except FaultError as error:
            code = error.fault.code
        except RefusedError as error:
            code = error.reason
        lasted_s = time.monotonic() - begun_s
        codes = self._heard.codes() | ({code} - {""})
        met = begun_s + at_s > self._heard.moved_s
        met = met and lasted_s > at_s + kind.for_s + SURELY_S
        self._settle()
        broken = self._broken(kind, codes, met=met)
        loaded = bool(codes) and not codes & CODES[kind.device]
        ends = self._heard.of(TrialFinished)
        ended = ends[-1].outcome.value if ends else code or "nothing told"
        why = ends[-1].reason if ends else ""
        session.reset()
        return Struck(
            seed, kind, at_s, f"{ended} after {lasted_s:.0f} s ({why})", tuple(broken), loaded
        )

    def _broken(self, kind: Kind, codes: set[str], *, met: bool) -> list[str]:
        """Return what does not hold; ``met``: the fault surely struck a trial that went on."""
        heard, session = self._heard, self.bench.session
        seen = self.bench.witnessed()
        assert seen is not None
        # A fault may strike while the jaws open by right: then nothing more tells of the release.
        released = len([f for f in heard.of(PhaseEntered) if f.phase == "release"])
        connected = bool(heard.facts)
        allowed = CODES[kind.device] | LOAD
        rows = {
            f"fault {codes - allowed}": codes <= allowed,
            "no fault told": not (kind.ends and met) or bool(codes),
            "nothing says how the run ended": not connected or bool(heard.of(RunFinished)),
            "goes on": not session.engine.busy,
            **witnessed(seen, released),
            **{f"episode {name} is lost": False for name in self._lost()},
        }
        return [name for name, holds in rows.items() if not holds]

    def _settle(self) -> None:
        """Let a motion that the trial began with its last breath come to its end."""
        session = self.bench.session
        end_s = session.clock_s() + SETTLE_S
        while session.clock_s() < end_s:
            session.advance()

    def _lost(self) -> list[str]:
        """Return the acknowledged episodes that are not there as they were told."""
        folder, lost = self.bench.session.run_folder, []
        for fact in self._heard.of(EpisodeRecorded):
            assert folder is not None
            kept = read_episode(folder / "episodes" / Path(fact.path).name)
            if not np.array_equal(kept.observation, fact.episode.observation, equal_nan=True):
                lost.append(fact.path)
        return lost


def witnessed(seen: DriverObservations, released: int) -> dict[str, bool]:
    """Return by row whether the devices saw no unsafe command; NaN holds none."""
    return {
        f"a step of {seen.step_share:.2f} of the top speed": seen.step_share <= MOST_SHARE,
        f"a command {seen.late_command_s:.3f} s after the end": seen.late_command_s <= MOST_LATE_S,
        f"still moving: {seen.moving_mm:.2f} mm": seen.moving_mm <= STANDS_MM,
        f"{seen.openings} openings, {released} releases": seen.openings <= released,
        f"{seen.barred} motions of a gripper in a fault": seen.barred == 0,
        f"{seen.force_n:.0f} N": seen.force_n <= MOST_N,
    }


def campaign(trials: int = len(KINDS), first: int = FIRST) -> list[Struck]:
    """Run trials and return how each ended."""
    with tempfile.TemporaryDirectory() as folder:
        struck = Campaign(Path(folder))
        try:
            return [struck.trial(seed) for seed in range(first, first + trials)]
        finally:
            struck.bench.close()


@figure("wired-faults")
def faults_over_the_wires() -> list[Figure]:
    """How many trials did not end as documented when a device failed in them."""
    return [of(campaign())]


def of(ended: Sequence[Struck]) -> Figure:
    """Return the figure of so many trials."""
    broken = [one for one in ended if one.broken]
    endings = Counter(one.ended.split()[0] for one in ended)
    kinds = len({(one.kind.device, one.kind.kind) for one in ended})
    note = f"{len(ended)} faults of {kinds} kinds; ends: "
    note += ", ".join(f"{count} {name}" for name, count in endings.most_common())
    note += f"; {sum(one.loaded for one in ended)} by a busy computer"
    note += "".join(f"; {one}" for one in broken[:3])
    name = "faults over the wires, in real time: not ended as documented, or an unsafe command"
    return Figure(name, len(broken), f"of {len(ended)}", "0", not broken, note)
