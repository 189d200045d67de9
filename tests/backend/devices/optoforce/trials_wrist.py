"""A wrist sensor of any make that streams, and one fault at a random instant, by hand-wound clock.

The reader runs as it does on its thread, but on a wire whose reading lets the time pass.
"""

import random
import threading

import numpy as np

from tests.backend.devices.trials import Ended
from touchdown.backend.config.hardware import HardwareSettings
from touchdown.backend.core import FaultError, ManualClock
from touchdown.backend.devices.bota.emulator import EmulatedBota
from touchdown.backend.devices.dynpick.emulator import EmulatedDynpick
from touchdown.backend.devices.force_torque.reader import ForceTorqueReader
from touchdown.backend.devices.ft300.emulator import EmulatedFt300
from touchdown.backend.devices.leptrino.emulator import EmulatedLeptrino
from touchdown.backend.devices.melfa.emulated_channels import TYPE_FORCE, EmulatedMonitor
from touchdown.backend.devices.netft.emulator import PER_UNIT, EmulatedNetFt
from touchdown.backend.devices.optoforce.emulator import CAPACITY, COUNTS, EmulatedOptoforce
from touchdown.backend.devices.protocols import DeviceState
from touchdown.backend.devices.registry import load_driver
from touchdown.backend.emulation.fault_plan import Faults, add_noise, apply_faults

EMULATED = {
    "dynpick": EmulatedDynpick,
    "leptrino": EmulatedLeptrino,
    "ft300": EmulatedFt300,
    "bota": EmulatedBota,
    "optoforce": EmulatedOptoforce,
    "netft": EmulatedNetFt,
    "melfa": EmulatedMonitor,
}
SETTINGS = HardwareSettings.model_validate(
    {
        "optoforce": {"counts": COUNTS, "capacity": CAPACITY},
        "netft": {"counts": (PER_UNIT, PER_UNIT), "http_port": 1, "tcp_port": 1},
        "melfa": {"monitor": {"type_force": TYPE_FORCE}},
    }
)
LOAD = (1.0, -2.0, -10.5, 0.1, -0.2, 0.05)
TREMBLE = (0.03, 0.03, 0.03, 0.003, 0.003, 0.003)
NEAR_N, FAR_N = 0.5, 50.0
"""How near a number must be to the load; without a checksum, how far at most (reliability S2)."""
WIRE = ("lost", "flip", "garbage", "cut", "duplicate", "late")
KINDS = (*WIRE, "silent", "mute", "freeze", "saturate", "unplug", "stalled")
DATAGRAMS = ("netft", "melfa")
DATAGRAM_KINDS = (*(kind for kind in KINDS if kind != "flip"), "reorder")
"""The network's own checksum drops a datagram with a wrong bit."""
SHORT_S, LONG_S = 0.1, 0.5
STALL_S = 0.12
BUFFER = 4096  # bytes that the system keeps of a serial port that nobody reads


class Impatient:
    """Stands for the cancelling event: a pause winds the clock."""

    def __init__(self, clock: ManualClock) -> None:
        self._clock = clock

    def is_set(self) -> bool:
        return False

    def wait(self, seconds: float) -> bool:
        self._clock.advance(round(seconds * 1e6))
        return False


class SteppedLink:
    """Wire of an emulated sensor: time passes by reading, until ``end_s``."""

    host = ""

    def __init__(self, sensor, faults: Faults, clock: ManualClock, rng: random.Random) -> None:
        self._sensor, self._faults, self._clock, self._rng = sensor, faults, clock, rng
        self._held: list[bytes] = []
        self.chunk = 0
        self.stall_s = 0.0
        self.end_s, self.at_end = float("inf"), lambda: None
        self.written: list[bytes] = []

    def read(self, limit_s: float) -> bytes:
        if self._clock.now_s() >= self.end_s:
            self.at_end()
            return b""
        if not self._held:
            step_s = self.stall_s or self._rng.uniform(0.0005, 0.004)
            self.stall_s = 0.0
            self._clock.advance(round(step_s * 1e6))
        now_s = self._clock.now_s()
        if self._faults.active("unplug", now_s):
            raise OSError("the device is gone")
        due = self._sensor.due(now_s)
        self._keep(self._faults.outgoing(now_s, due if isinstance(due, list) else [due]))
        if isinstance(due, list):
            return self._held.pop(0) if self._held else b""
        content = b"".join(self._held)[-BUFFER:]
        out, rest = content[: self.chunk], content[self.chunk :]
        self._held = [rest] if rest else []
        return out

    def _keep(self, messages: list[bytes]) -> None:
        self._held += [message for message in messages if message]

    def write(self, data: bytes) -> None:
        self.written.append(data)
        answer = self._sensor.receive(self._clock.now_s(), data)
        self._keep(answer if isinstance(answer, list) else [answer])

    def drain(self) -> None:
        self._held.clear()
        self._sensor.due(self._clock.now_s())

    def close(self) -> None:
        """Nothing."""


class WristTrial:
    """Draws everything from ``seed``."""

    def __init__(self, seed: int, kind: str | None = None, load=lambda now_s: LOAD) -> None:
        self.seed, self.rng = seed, random.Random(seed)
        self.kind = kind or self.rng.choice(sorted(EMULATED))
        self.clock, self.faults = ManualClock(), Faults("force_torque")
        self.faults.begin(0.0)
        felt = apply_faults(add_noise(load, TREMBLE, seed), self.faults)
        self.sensor = EMULATED[self.kind](felt)
        self.link = SteppedLink(self.sensor, self.faults, self.clock, self.rng)
        chosen = SETTINGS.ft.model_copy(update={"driver": self.kind})
        make_driver = load_driver("force_torque", SETTINGS.model_copy(update={"ft": chosen}))
        self.reader = ForceTorqueReader(
            lambda: make_driver(SETTINGS, "a port"), self._open, SETTINGS.ft, self.clock.now_s
        )

    def run(self) -> Ended:
        """Stream, break, wait, and look."""
        reader, clock = self.reader, self.clock
        link, language = reader._begin(Impatient(clock))
        reader._forget()
        reader._state = DeviceState.READY
        fault = self.rng.choice(DATAGRAM_KINDS if self.kind in DATAGRAMS else KINDS)
        begun_s = clock.now_s() + self.rng.uniform(0.3, 0.6)
        self._plan(fault, begun_s)
        link.end_s, link.at_end = begun_s + 1.2, reader._stop.set
        reader._read(link, language)
        return Ended(self.seed, self.kind, fault, tuple(self._broken(fault, begun_s)))

    def listen(self, seconds: float) -> np.ndarray:
        """Stream without a fault as in a connection; return the samples, or raise its refusal."""
        reader, clock = self.reader, self.clock
        link, driver = reader._begin(Impatient(clock))
        reader._forget()
        link.end_s, link.at_end = clock.now_s() + seconds, reader._stop.set
        reader._read(link, driver)
        reader._stop.clear()
        reader._check_still(0.0, threading.Event())
        return reader.samples.since(0).values

    def _open(self, language) -> SteppedLink:
        self.link.chunk = language.chunk
        return self.link

    def _plan(self, fault: str, begun_s: float) -> None:
        share = {"share": 0.2} if fault in (*WIRE, "reorder") else {}
        kind = {"mute": "silent"}.get(fault, fault)
        for_s = SHORT_S if fault == "silent" else LONG_S
        if fault != "stalled":
            self.faults.inject(begun_s, kind, for_s, by_s=0.02, **share)
            return
        read = self.link.read

        def stalling(limit_s: float) -> bytes:
            if self.clock.now_s() >= begun_s:
                self.link.stall_s, self.link.read = STALL_S, read
            return read(limit_s)

        self.link.read = stalling

    def _broken(self, fault: str, begun_s: float) -> list[str]:
        reader = self.reader
        run = reader.samples.since(0)
        code = reader.fault.code if reader.fault else ""
        far = np.abs(run.values - LOAD)[np.isfinite(run.values).all(axis=1)]
        worst_n = float(far[:, :3].max()) if len(far) else 0.0
        unsummed = self.kind == "dynpick" and fault in ("flip", "cut", "garbage")
        rows = {
            f"fault {code}": code in self._allowed(fault),
            f"a number {worst_n:.2f} N off": worst_n <= (FAR_N if unsummed else NEAR_N),
            "time goes back": bool(np.all(np.diff(run.t_s) > 0)),
            "stamped later than it came": run.t_s[-1] <= self.clock.now_s() + 1e-6,
            "the sensor was zeroed": not self._zeroed(),
            "left streaming": fault == "unplug" or not self.sensor.pace.running,
        }
        during = (run.t_s > begun_s + 0.1) & (run.t_s < begun_s + LONG_S)
        if fault in ("freeze", "saturate"):
            rows["numbers of a sensor that has none"] = bool(np.isnan(run.values[during]).all())
        if fault in ("stalled", "silent"):
            step_s = float(np.diff(run.t_s[run.t_s > begun_s - 0.1]).max())
            rows[f"a gap of {1e3 * step_s:.0f} ms"] = fault == "silent" or step_s < 0.03
        if not code:
            newest_s = float(run.t_s[-1])
            rows["old or no numbers at the end"] = bool(
                self.clock.now_s() - newest_s < 0.05 and np.isfinite(run.values[-1]).all()
            )
        return [name for name, holds in rows.items() if not holds]

    def _allowed(self, fault: str) -> set[str]:
        if fault in ("mute", "unplug"):
            return {"FT-LINK"}
        if fault == "saturate":
            return {"FT-OVERLOAD", "FT-SENSOR"}
        if fault not in (*WIRE, "reorder"):
            return {""}
        # A flipped bit of a record without checksum may be that of the end of the range.
        return {"", "FT-LINK", *({"FT-OVERLOAD"} if self.kind == "dynpick" else ())}

    def _zeroed(self) -> bool:
        offsets = getattr(self.sensor, "_offset", None) or getattr(self.sensor, "_bias", (0,))
        return any(offsets)


def trial(seed: int, kind: str | None = None) -> Ended:
    """Run one."""
    try:
        return WristTrial(seed, kind).run()
    except FaultError as error:
        return Ended(seed, kind or "", "start", (error.fault.what,))
