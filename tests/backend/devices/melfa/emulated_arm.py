"""The driver of the arm on an emulated controller, on a hand-wound clock: no socket, no thread."""

import random
from collections.abc import Callable

import numpy as np

from touchdown.backend.config import HardwareSettings, MelfaSettings, ProbeSettings
from touchdown.backend.core.clock import ManualClock
from touchdown.backend.core.faults import Fault, FaultError
from touchdown.backend.core.rotations import IDENTITY_ROTATION, LEVEL_TOLERANCE_RAD, rotation_vector
from touchdown.backend.core.streams import SampleStream
from touchdown.backend.core.values import FloatArray
from touchdown.backend.devices.melfa import READY_RAD, EmulatedMelfa
from touchdown.backend.devices.melfa.command_channel import (
    CycleFunction,
    CycleTimes,
    PendingRequest,
    R3Client,
)
from touchdown.backend.devices.melfa.driver import MelfaArm, MelfaPrograms
from touchdown.backend.devices.melfa.r3_protocol import R3Request, encode_request
from touchdown.backend.simulation import ArmCycle as Cycle10
from touchdown.backend.simulation import World
from touchdown.backend.simulation.devices.bench import SimulatedBench

CYCLE_US = 3500
STIFF_N_MM = 1000.0


def settings(**more: object) -> MelfaSettings:
    """Those of a bench whose controller ends a silent stream, and whose servo is quick."""
    content = {
        "servo_delay_s": 0.3,
        "realtime_priority": 0,
        "sensor_lag_ms": 0.0,
        "idle_check_s": 0.0,
        "mxt": {"mxttout": 57},
        **more,
    }
    return HardwareSettings.model_validate({"melfa": content}).melfa


class Link:
    """What may happen to a datagram on its way; seeded."""

    def __init__(self) -> None:
        self.rng = random.Random(5)
        self.loss = self.duplicate = self.garbage = 0.0
        self.late: Callable[[], int] = lambda: 0  # cycles that a reply is late
        self.cut = False
        self._waiting: list[tuple[int, bytes]] = []
        self._cycle = 0

    def forth(self, packet: bytes) -> bytes | None:
        return None if self.cut or self.rng.random() < self.loss else packet

    def back(self, reply: bytes | None) -> tuple[bytes, ...]:
        """Return what comes in the next cycle."""
        self._cycle += 1
        if reply is not None and not self.cut and self.rng.random() >= self.loss:
            due = self._cycle + self.late()
            self._waiting.append((due, reply))
            if self.rng.random() < self.duplicate:
                self._waiting.append((due, reply))
        if self.rng.random() < self.garbage:
            size = self.rng.choice((0, 12, 196, 197))
            self._waiting.append((self._cycle, self.rng.randbytes(size)))
        come = tuple(data for due, data in self._waiting if due <= self._cycle)
        self._waiting = [item for item in self._waiting if item[0] > self._cycle]
        return come


class SteppedWires:
    """The wires of an ``EmulatedMelfa``; time passes by ``advance`` only."""

    def __init__(self, device: EmulatedMelfa, clock: ManualClock | None = None) -> None:
        self.device, self.clock = device, clock or ManualClock()
        self.link = Link()
        self.times = CycleTimes()
        self.packets: list[tuple[float, bytes]] = []
        self.also: Callable[[int], None] = self.clock.advance
        """Moves everything else, the clock included, on by so many microseconds."""
        self.meanwhile: Callable[[], None] = lambda: None
        """What goes on while an order waits for its answer."""
        self.stalled = False  # the driver itself is stopped, as by a signal; the controller is not
        self.unplugged = False
        """The cable is out: nothing goes to the controller, nothing comes from it."""
        self.stops = 0
        self._late_us = 0
        self._next_us = self.clock.now_us + CYCLE_US
        self._came: tuple[bytes, ...] = ()
        self._cycle: CycleFunction | None = None
        self._client = R3Client(0.03)
        self._out = b""

    @property
    def bad_replies(self) -> int:
        return self._client.bad_replies

    # -- Wires ------------------------------------------------------------------------------------

    def open(self, cycle: CycleFunction, lost: Callable[[Fault], None]) -> None:
        self._session, self._lane = self.device.session(), self.device.session()
        self._client, self._came, self._out = R3Client(0.03), (), b""
        self._cycle, self._lost = cycle, lost

    def ask(self, request: R3Request, timeout_s: float) -> PendingRequest:
        return self._client.ask(request, timeout_s)

    def finish(self, ticket: PendingRequest) -> None:
        while not ticket.done() and self._cycle is not None:
            self.advance(CYCLE_US)
            self.meanwhile()

    def pause(self, seconds: float) -> None:
        self.advance(round(seconds * 1e6))
        self.meanwhile()

    def restart_timing(self) -> None:
        self.times, self._late_us = CycleTimes(), 0

    def pace(self, running: bool) -> None:
        self._client.paced = running

    def stop_now(self, packet: bytes) -> None:
        if self._cycle is None:
            return
        self.stops += 1
        if self.unplugged:
            return
        now_s = self.clock.now_s()
        self._send(now_s, packet)
        self._lane.receive(now_s, encode_request(R3Request("STOP")) + b"\r")

    def close(self) -> None:
        if self._cycle is not None:
            self._session.closed(self.clock.now_s())
            self._lane.closed(self.clock.now_s())
        self._cycle = None

    # -- time -------------------------------------------------------------------------------------

    def advance(self, step_us: int) -> None:
        """Move everything on."""
        end_us = self.clock.now_us + step_us
        while self._next_us <= end_us:
            self.also(self._next_us - self.clock.now_us)
            self._next_us += CYCLE_US
            self._one_cycle(self.clock.now_s())
        self.also(end_us - self.clock.now_us)

    def _one_cycle(self, now_s: float) -> None:
        self.device.controller.advance(now_s)
        if self._cycle is None or self.stalled:
            self._late_us += CYCLE_US
            return
        self.times, self._late_us = self.times.after(1e-6 * self._late_us), 0
        try:
            come = b"" if self.unplugged else self._session.receive(now_s, self._out)
            self._out = self._client.step(now_s, come)
        except FaultError as error:
            self._lost(error.fault)
        packet = self._cycle(now_s, self._came)
        self._came = self._send(now_s, packet)

    def _send(self, now_s: float, packet: bytes | None) -> tuple[bytes, ...]:
        if packet is None:
            return self.link.back(None)
        self.packets.append((now_s, packet))
        arrived = self.link.forth(packet)
        return self.link.back(
            None if arrived is None else self.device.stream.receive(now_s, arrived)
        )


class Rig:
    """Driver, wires, controller and a wrist sensor that is fed from ``press``."""

    def __init__(self, start_mm: tuple[float, float, float] = (0.0, 0.0, 60.0), **more: object):
        self.settings = settings(**more)
        placing = MelfaPrograms(self.settings).placing
        self.device = EmulatedMelfa(
            self.settings, start_rad=placing.joints(np.array(start_mm), READY_RAD)
        )
        self.wires = SteppedWires(self.device)
        self.wrench = SampleStream("force_torque", 6, 32_768)
        self.placing = placing
        self.contact: Callable[[FloatArray], FloatArray] = lambda pivot_mm: np.zeros(3)
        """Force on the tool (3,) where ``G`` truly is."""
        self.noise_n = 0.0
        self._rng = np.random.default_rng(3)
        self.wires.also = self._pass
        self.arm = MelfaArm(self.wires, self.wrench, self.settings, self.wires.clock.now_s)

    @property
    def true_mm(self) -> FloatArray:
        return self.placing.pivot_mm(self.device.controller.joints.true_rad)

    def rest(self, seconds: float) -> None:
        self.wires.advance(round(seconds * 1e6))

    def _pass(self, step_us: int) -> None:
        """Wind the clock; the sensor has delivered a sample at every whole millisecond."""
        clock = self.wires.clock
        first_us = clock.now_us // 1000 * 1000 + 1000
        clock.advance(step_us)
        stamps_s = 1e-6 * np.arange(first_us, clock.now_us + 1, 1000)
        if len(stamps_s):
            wrench = np.zeros((len(stamps_s), 6))
            # The arm moves in cycles: in between it is where it was.
            wrench[:, :3] = self.contact(self.true_mm)
            if self.noise_n:
                wrench += self._rng.normal(0.0, self.noise_n, wrench.shape)
            self.wrench.put(stamps_s, wrench)


class _Follow:
    """The simulated world goes where the emulated arm is; it gives way in the arm, not here."""

    done = False
    failure = None

    def __init__(
        self, rig_mm: Callable[[], FloatArray], turn: Callable[[], FloatArray], world: World
    ) -> None:
        self._rig_mm, self._turn, self._world = rig_mm, turn, world

    @property
    def turn(self) -> FloatArray:
        turn = self._turn()
        return (
            IDENTITY_ROTATION
            if np.linalg.norm(rotation_vector(turn)) <= LEVEL_TOLERANCE_RAD
            else turn
        )

    def next_mm(self, command_mm: FloatArray, cycle: Cycle10) -> FloatArray:
        holding = self._world.holding
        if holding is not None and holding.probe == 0:
            holding.begin_probe(ProbeSettings(stiffness_n_mm=(STIFF_N_MM,) * 3))
        return self._rig_mm()


def on_bench(bench: SimulatedBench, **more: object) -> tuple[MelfaArm, SteppedWires]:
    """Return the driver of an emulated arm that carries the gripper of ``bench``."""
    world, wanted = bench._world, settings(**more)
    placing = MelfaPrograms(wanted).placing
    device = EmulatedMelfa(wanted, start_rad=placing.joints(world.drive.command_mm, READY_RAD))
    wires = SteppedWires(device, bench.clock)
    wires.also = bench.advance
    joints = device.controller.joints
    felt = bench.force_torque.samples
    device.controller.felt = lambda: felt.latest(bench.clock.now_s(), 1.0)[1]
    world.drive.run(
        _Follow(
            lambda: placing.pivot_mm(joints.true_rad), lambda: placing.turn(joints.true_rad), world
        )
    )
    return MelfaArm(wires, bench.force_torque.samples, wanted, bench.clock.now_s), wires
