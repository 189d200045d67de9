"""Figures of the arm over real sockets: cycle times beside a busy interpreter, gaps of the stream,
STOP in every state.

Backend, rig process and wires are those of a lab day. The emulated controller, whose clock is that
of this computer, records when STOP reached it.
"""

import contextlib
import json
import math
import random
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from socket import socket

import numpy as np

from tests.backend.devices.waiting import until
from tests.backend.rig.served import Backend, Served
from tests.bench.children.arm import UP, driver, front
from tests.bench.figures import Figure, at_most, failures, figure, stated
from tests.busy_computer import STARVED
from touchdown.backend.core import Fault, FaultError, FloatArray, Pose, RefusedError
from touchdown.backend.devices.melfa.driver import MelfaPrograms
from touchdown.backend.devices.melfa.emulated_channels import EmulatedCommands
from touchdown.backend.devices.melfa.emulator import EmulatedMelfa, MelfaServer
from touchdown.backend.devices.melfa.realtime_protocol import CYCLE_S
from touchdown.backend.devices.protocols import DeviceState, PressCommand
from touchdown.backend.emulation.fault_plan import hanging_gripper

STATE_UP = Pose(0.0, 0.0, 150.0)
# start of a press; height and stiffness of the surface
ABOVE_MM, FLOOR_MM, GEL_N_MM = 60.0, 58.0, 5.0
STATE_PRESS = PressCommand(1.5, 1.5, 20.0, 2.0, 1.0, 6.0, (30.0, 30.0, 15.0))
STATE_SPEED_MM_S, JOINT_RAD_S = 10.0, 0.05
SOON_S, LIMIT_S, NEVER_S, TRIES = 0.08, 20.0, 2.0, 10
BRAKED_S, WATCHED_S, STILL_RAD, TROUBLED_S = 0.2, 0.1, 1e-4, 0.9
LATE_S, SPLIT_S, LONG_BYTES = 2.0, 0.003, 300
ALARM = 2601


class TroubledFront(MelfaServer):
    """Whose command channel, and nothing else, can be silent, late, split or too long."""

    def __init__(self, device: EmulatedMelfa) -> None:
        super().__init__(device)
        self.trouble = ""
        self._later: deque[tuple[float, socket, EmulatedCommands, bytes]] = deque()

    def _reply(self, client: socket, session: EmulatedCommands, out: bytes) -> None:
        now_s = self._clock.now_s()
        while self._later and self._later[0][0] <= now_s:
            _, to, of, piece = self._later.popleft()
            if not of.gone:
                super()._reply(to, of, piece)
        if not out or self.trouble == "silent":
            return
        if self.trouble == "late":
            self._later.append((now_s + LATE_S, client, session, out))
        elif self.trouble == "split":
            pieces = enumerate(out[k : k + 1] for k in range(len(out)))
            self._later += [(now_s + SPLIT_S * k, client, session, one) for k, one in pieces]
        else:
            long = b"QoK" + b"7" * LONG_BYTES + b"\r"
            super()._reply(client, session, long if self.trouble == "long" else out)


class Bench:
    """One arm, its wrist sensor and gripper; ``mode`` is the stiffness mode of the arm."""

    def __init__(self, mode: str = "software", seed: int = 0) -> None:
        self.served = Served(TroubledFront, self._felt, stiffness_mode=mode)
        device = self.served.arm._device
        self.front, self.controller = self.served.arm, device.controller
        self._placing = MelfaPrograms(self.served.settings.melfa).placing
        self._start_rad = self.controller.joints.true_rad.copy()
        self._joints, self._place_mm = self._start_rad, np.array([0.0, 0.0, ABOVE_MM])
        self.controller.felt = lambda: np.array([0.0, 0.0, self.push_n(), 0.0, 0.0, 0.0])
        self.backend = Backend(self.served.settings)
        self.rng = random.Random(seed)
        self._threads: list[threading.Thread] = []
        self._steady = threading.Event()

    def close(self) -> None:
        self.backend.close()
        self.served.close()

    def _felt(self, now_s: float) -> tuple[float, ...]:
        x, y, z, *moments = hanging_gripper(now_s)
        return (x, y, z + self.push_n(), *moments)

    def height_mm(self) -> float:
        self.push_n()
        return float(self._place_mm[2])

    def push_n(self) -> float:
        """Return what presses on the arm from below."""
        joints: FloatArray | None = getattr(self, "controller", None) and (
            self.controller.joints.true_rad
        )
        if joints is not None and joints is not self._joints:
            self._joints, self._place_mm = joints, self._placing.pivot_mm(joints)
        return max(0.0, GEL_N_MM * (FLOOR_MM - float(self._place_mm[2])))

    # -- getting somewhere ------------------------------------------------------------------------

    def wait(self, seconds: float) -> None:
        self._steady.wait(seconds)

    def aside(self, order: Callable[[], object], request: bytes = b"") -> None:
        """Run an order on its own thread and ignore its result.

        Returns when the controller has received ``request``, if one is given.
        """

        def give() -> None:
            with contextlib.suppress(FaultError, RefusedError):
                order()

        begun_s, thread = time.monotonic(), threading.Thread(target=give, daemon=True)
        self._threads.append(thread)
        thread.start()
        while request and not self._asked(request, begun_s):
            if not thread.is_alive() or time.monotonic() > begun_s + LIMIT_S:
                raise FaultError(NOT_SEEN)
            self._steady.wait(0.0005)

    def _asked(self, request: bytes, since_s: float) -> bool:
        newest = list(self.front.log)[-40:]
        return any(e.incoming and e.t_s >= since_s and request in e.data for e in newest)

    def renew(self) -> None:
        self.backend.interlock.renew_lease(self.backend.now_s())

    def above(self) -> None:
        """Be connected, and stand long enough for a press to know its air."""
        self.backend.connect()
        self.renew()
        self.wait(0.3)

    def recover(self) -> None:
        """Be closed, with latch and error cleared, and the arm carried back to its start."""
        self.front.trouble = ""
        for thread in self._threads:
            thread.join(LIMIT_S)
        self._threads.clear()
        with contextlib.suppress(FaultError):
            self.backend.arm.close()
        if self.backend.link.lost is not None:
            self.backend.disconnect()
        self.controller.reset_error()
        joints = self.controller.joints
        joints.command_rad = joints.filtered_rad = joints.true_rad = self._start_rad.copy()
        self.backend.interlock.reset()
        self.wait(0.03)

    # -- STOP -------------------------------------------------------------------------------------

    def stop(self) -> float:
        pressed_s = time.monotonic()
        self.backend.interlock.stop()
        self.backend.arm.stop()
        return pressed_s

    def wire_s(self, pressed_s: float) -> float:
        """Return how long STOP took to the controller; infinite if it never came."""
        while time.monotonic() < pressed_s + NEVER_S:
            came = [stop_s for stop_s in list(self.front.stops) if stop_s >= pressed_s]
            if came:
                return came[0] - pressed_s
            self._steady.wait(0.001)
        return float("inf")

    def _pass(self, seconds: float) -> None:
        """Let time pass, and the controller come so far: a busy computer may leave it behind."""
        then_s = time.monotonic() + seconds
        self.wait(seconds)
        until(lambda: self.controller.now_s >= then_s, LIMIT_S)

    def stands(self) -> bool:
        """Return True if the arm stands after the braking time, and no program presses."""
        self._pass(BRAKED_S)
        before = self.controller.joints.true_rad.copy()
        self._pass(WATCHED_S)
        moved = float(np.abs(self.controller.joints.true_rad - before).max())
        return moved < STILL_RAD and self.controller.program != "probe"


NOT_SEEN = Fault("NO-ANSWER", "The controller was not asked what was waited for.", "", "", "arm")


@dataclass(frozen=True)
class State:
    """One state of the arm. ``mode``: stiffness mode; ``wired``: a wire exists for sure."""

    reach: Callable[[Bench], object]
    mode: str = "software"
    wired: bool = True


def _connecting(request: bytes) -> State:
    def reach(bench: Bench) -> None:
        bench.backend.wrist.connect(10.0, threading.Event())
        bench.aside(lambda: bench.backend.arm.connect(10.0, threading.Event()), request)

    return State(reach)


def _under_way(
    begin: Callable[[Bench], object], for_s: float = 0.1, mode: str = "software"
) -> State:
    def reach(bench: Bench) -> None:
        bench.above()
        begin(bench)
        bench.wait(for_s + bench.rng.uniform(0.0, SOON_S))

    return State(reach, mode)


def _asked(order: Callable[[Bench], object], request: bytes, mode: str = "software") -> State:
    def reach(bench: Bench) -> None:
        bench.above()
        bench.aside(lambda: order(bench), request)

    return State(reach, mode)


def _press(bench: Bench) -> object:
    return bench.backend.arm.press(STATE_PRESS)


def in_contact(bench: Bench) -> object:
    """Press until the hand is pushed by 2 N; raises what ends it before."""
    motion = bench.backend.arm.press(STATE_PRESS)
    end_s = time.monotonic() + LIMIT_S
    while bench.push_n() < 2.0:
        if motion.done or time.monotonic() > end_s:
            motion.result()
            raise FaultError(NOT_SEEN)
        bench.renew()
        bench.wait(0.002)
    return motion


def _unloading(bench: Bench) -> object:
    in_contact(bench)
    bench.wait(1.0)
    return bench.backend.arm.unload(0.5, 1.0)


def _retreating(bench: Bench) -> None:
    in_contact(bench)
    bench.backend.arm.retreat()


def _faulted(bench: Bench) -> None:
    bench.backend.arm.move_to(STATE_UP, STATE_SPEED_MM_S)
    bench.wait(0.1)
    bench.controller.raise_error(ALARM)
    until(lambda: bench.backend.arm.state is DeviceState.FAULT, LIMIT_S)


def _after_stop_latched(bench: Bench) -> None:
    bench.backend.arm.move_to(STATE_UP, STATE_SPEED_MM_S)
    bench.wire_s(bench.stop())
    bench.wait(0.1)


def _reset(bench: Bench) -> None:
    _after_stop_latched(bench)
    bench.backend.interlock.reset()


def _after_a_stop(request: bytes) -> State:
    def reach(bench: Bench) -> None:
        bench.above()
        _reset(bench)
        bench.wait(0.05)
        bench.renew()
        bench.aside(lambda: bench.backend.arm.move_to(STATE_UP, STATE_SPEED_MM_S), request)

    return State(reach)


def _closing(bench: Bench) -> None:
    bench.aside(bench.backend.arm.close)


def _servo_off(bench: Bench) -> None:
    bench.backend.arm.servo(False)


def _servo_on(bench: Bench) -> None:
    bench.backend.arm.servo(False)
    bench.backend.arm.servo(True)


START_UP = (
    *("1;OPEN=TOUCHDOWN\r", "ERROR", "PARMXTTOUT", "CNTLON", "OVRD=", "SRVON", "SLOTINIT", "RUN"),
)
JOINTS = (JOINT_RAD_S, 0.0, 0.0, 0.0, 0.0, 0.0)
STATES: Mapping[str, State] = {
    "closed": State(lambda bench: None, wired=False),
    **{f"connecting: {one.strip('1;=')}": _connecting(one.encode()) for one in START_UP},
    "connecting: first packets": _connecting(b"STATE"),
    "ready": _under_way(lambda bench: None),
    "switching off": _asked(_servo_off, b"SRVOFF"),
    "servo off": _under_way(_servo_off),
    "switching on": _asked(_servo_on, b"SRVON"),
    "travelling": _under_way(lambda bench: bench.backend.arm.move_to(STATE_UP, STATE_SPEED_MM_S)),
    "jogging": _under_way(lambda bench: bench.backend.arm.jog((0.0, 0.0, STATE_SPEED_MM_S), 2.0)),
    "turning joints": _under_way(lambda bench: bench.backend.arm.jog_joints(JOINTS, 2.0)),
    "press, on its way down": _under_way(_press),
    "press, in contact": _under_way(in_contact),
    "unloading": _under_way(_unloading, 0.05),
    "retreat": _under_way(_retreating, 0.0),
    "force program, prepared": _asked(_press, b"MDKZ", "controller"),
    "force program, begun": _asked(_press, b"RUNTDPROBE", "controller"),
    "force program, on its way down": _under_way(_press, mode="controller"),
    "force program, in contact": _under_way(in_contact, mode="controller"),
    "fault": _under_way(_faulted),
    "stopped already": _under_way(_after_stop_latched),
    "reset just now": _under_way(_reset, 0.0),
    "stream opened again": _after_a_stop(b"SLOTINIT"),
    "stream opened again, run": _after_a_stop(b"RUN"),
    "disconnecting": _under_way(_closing, 0.0),
}


def _troubled(trouble: str) -> State:
    def reach(bench: Bench) -> None:
        bench.above()
        bench.backend.arm.move_to(STATE_UP, STATE_SPEED_MM_S)
        bench.front.trouble = trouble
        bench.wait(bench.rng.uniform(0.1, TROUBLED_S))

    return State(reach)


TROUBLED: Mapping[str, State] = {
    f"command channel {kind}": _troubled(kind) for kind in ("silent", "late", "split", "long")
}


def pressed_in(bench: Bench, name: str, state: State) -> tuple[float, list[str]]:
    """Reach a state, press STOP; return s to the wire (NaN: not reached) and what fails."""
    for _ in range(TRIES):
        try:
            state.reach(bench)
        except (FaultError, RefusedError) as error:
            code = error.fault.code if isinstance(error, FaultError) else error.reason
            if code not in STARVED | {"NO-ANSWER"}:
                raise
            bench.recover()
        else:
            break
    else:
        return float("nan"), [f"{name}: never reached"]
    pressed_s = bench.stop()
    took_s = bench.wire_s(pressed_s) if state.wired else 0.0
    rows = {"goes on": bench.stands(), "not latched": bench.backend.interlock.latched}
    bench.recover()
    return took_s, [f"{name}: {what}" for what, holds in rows.items() if not holds]


SECONDS, BUSY, PRIORITY = 8.0, 1, 50
WIRE_STOPS = 100
Times = dict[str, float | str]
CHILD = [sys.executable, "-m", "tests.bench.children.arm"]


@contextmanager
def beside(*arguments: str) -> Iterator[str]:
    """Run a child until the block ends; gives the first line that it prints."""
    with subprocess.Popen(
        [*CHILD, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as child:
        assert child.stdin is not None
        assert child.stdout is not None
        try:
            yield child.stdout.readline() if arguments[0] == "emulate" else ""
        finally:
            child.stdin.close()
            child.wait(30.0)


def streamed(load: int, priority: int = 0) -> Times:
    """Return the cycle times of a driver in a process with ``load`` busy threads."""
    with beside("emulate") as served:
        done = subprocess.run(
            [*CHILD, "drive", served, str(SECONDS), str(load), str(priority)],
            capture_output=True,
            text=True,
            check=True,
            timeout=120.0,
        )
    found: Times = json.loads(done.stdout)
    return found


def share(found: Times) -> float:
    """Share in % of the wake-ups that came more than a cycle late."""
    return 100.0 * float(found["late"]) / float(found["wakes"])


def note(found: Times) -> str:
    skipped = 1.0 - float(found["wakes"]) / (SECONDS / CYCLE_S)
    fault = f", {found['fault']}" if found["fault"] else ""
    return (
        f"{found['wakes']} wake-ups, {100 * skipped:.0f} % of the cycles skipped, "
        f"latest {found['latest_ms']:.0f} ms, {found['holds']} holds{fault}"
    )


@figure("arm")
def cycle_times() -> list[Figure]:
    """Late wake-ups beside a busy interpreter: as a thread of it, and as a process of its own."""
    inside = streamed(BUSY)
    with beside("burn", str(BUSY)):
        apart, first = streamed(0), streamed(0, PRIORITY)
    thread, process, fifo = share(inside), share(apart), share(first)
    ok = fifo <= thread / 10.0 if first["realtime"] else None
    why = note(first) if first["realtime"] else "no right to real-time priority here"
    return [
        stated("late cycles, thread of a busy process", thread, "%", note(inside)),
        Figure("late cycles, process of its own beside it", process, "%", "<= 1/3 of the thread",
               process <= thread / 3.0, note(apart)),
        Figure("late cycles, process of its own with SCHED_FIFO", fifo, "%",
               "<= 1/10 of the thread", ok, why),
    ]  # fmt: skip


@figure("arm")
def stop_to_wire() -> list[Figure]:
    """Time from ``stop`` to its arrival at the emulated controller, while streaming."""
    served = front()
    served.start()
    arm = driver(served.settings)
    took_ms = []
    try:
        while len(took_ms) < WIRE_STOPS:
            try:
                arm.connect(10.0, threading.Event())
                arm.move_to(UP, 5.0)
            except FaultError:
                # A stall of a shared machine has ended the stream: connect again.
                arm.close()
                continue
            threading.Event().wait(0.05)
            before = len(served.stops)
            asked_s = time.monotonic()
            arm.stop()
            while len(served.stops) == before:
                threading.Event().wait(0.001)
            took_ms.append(1e3 * (served.stops[before] - asked_s))
            threading.Event().wait(0.15)
    finally:
        arm.close()
        served.close()
    p99 = float(np.percentile(took_ms, 99))
    told = f"{WIRE_STOPS} stops; median {np.median(took_ms):.2f}, worst {max(took_ms):.1f} ms"
    return [at_most("STOP to the controller's socket, p99", p99, "ms", 20, told)]


STATE_STOPS, TROUBLES, WIRE_MS = 20, 12, 20.0
MODES = ("software", "controller")


@figure("faults", long=True)
def stops_in_every_state(stops: int = STATE_STOPS) -> list[Figure]:
    """From STOP to the emulated controller, in each state; what went on all the same."""
    return _stop_figures("STOP in every state", STATES, stops)


@figure("faults")
def stops_beside_a_troubled_channel(stops: int = TROUBLES) -> list[Figure]:
    """The same while the command channel is silent, 2 s late, split or too long, in motion."""
    return _stop_figures("STOP beside a troubled command channel", TROUBLED, stops)


def _stop_figures(name: str, states: Mapping[str, State], stops: int) -> list[Figure]:
    took_ms: dict[str, list[float]] = {}
    broken: list[str] = []
    for mode in MODES:
        of_mode = {name: state for name, state in states.items() if state.mode == mode}
        if not of_mode:
            continue
        bench = Bench(mode)
        try:
            for state_name, state in of_mode.items():
                ended = [pressed_in(bench, state_name, state) for _ in range(stops)]
                reached = [1e3 * took_s for took_s, _ in ended if not math.isnan(took_s)]
                took_ms |= {state_name: reached} if reached else {}
                broken += [what for _, wrong in ended for what in wrong]
        finally:
            bench.close()
    wired = [ms for one, all_ms in took_ms.items() if states[one].wired for ms in all_ms]
    p50, p99, worst = np.percentile(wired, (50, 99, 100), method="lower")
    slow = sorted(took_ms, key=lambda one: -max(took_ms[one]))[:3]
    told = f"{len(wired)} stops in {len(took_ms)} states; median {p50:.1f}, worst {worst:.0f} ms; "
    told += ", ".join(f"{one} {max(took_ms[one]):.0f}" for one in slow)
    wrong = "; ".join(sorted(set(broken))[:3])
    return [
        Figure(f"{name}: to the wire, p99", float(p99), "ms", "<= 20", bool(p99 <= WIRE_MS), told),
        failures(f"{name}: went on, or no latch", len(broken), "", wrong),
    ]
