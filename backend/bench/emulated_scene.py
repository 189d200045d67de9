"""Emulated devices around one simulated scene, with the bench file and the scoring channel.

The world follows the joints of the emulated controller in real time. The emulated arm is stiff; the
driver provides the compliance. A late world uses the arm position at the time of each cycle:
samples may be late, their time stamps are correct. The monitor records driver behaviour that must
never occur on a real bench, from the data on the wires. The scoring channel serves the ground truth
to scoring, never to a driver.
"""

from __future__ import annotations

import gc
import json
import math
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from touchdown.backend import core
from touchdown.backend.bench.emulator_registry import bench_toml
from touchdown.backend.config import HardwareSettings, MelfaSettings, ProbeSettings, read_toml
from touchdown.backend.devices.dynpick import EmulatedDynpick
from touchdown.backend.devices.gelsight import GelsightServer, camera_tables
from touchdown.backend.devices.melfa import (
    READY_RAD,
    TIMEOUT_CYCLES,
    EmulatedMelfa,
    MelfaServer,
    frame_of,
    melfa_tables,
    solve,
)
from touchdown.backend.devices.wsg import EmulatedWsg
from touchdown.backend.emulation import (
    EmulatedDevice,
    Emulation,
    FaultPlan,
    Faults,
    PtyServer,
    TcpServer,
    apply_faults,
)
from touchdown.backend.simulation import ArmCycle, CycleRecord, Scene, SceneTruth, SimProgram, World

REST_ROWS = 100  # wrist samples of a new scene, averaged to the payload without contact


@dataclass(frozen=True, slots=True)
class DriverObservations:
    """Driver behaviour since the scene was set.

    ``step_share`` is the largest joint step as a share of the joint's top speed. ``late_command_s``
    is the time of the last motion command after a controller error (emergency stop, alarm, servo
    off). ``openings`` counts open commands on a held piece, ``barred`` motions of a gripper with an
    unacknowledged fault. ``force_n`` is the largest force on the wrist beyond its payload.
    """

    step_share: float
    late_command_s: float
    openings: int
    barred: int
    force_n: float

    def __str__(self) -> str:
        late = "no command after an error"
        if self.late_command_s > 0.0:
            late = f"last command {1e3 * self.late_command_s:.0f} ms after an error"
        return (
            f"largest step {100 * self.step_share:.1f} % of a joint's top speed; {late}; "
            f"jaws opened on a piece {self.openings} times, "
            f"{self.barred} motions asked of a gripper in a fault; "
            f"strongest force {self.force_n:.1f} N"
        )


def command_travel(
    positions_mm: Sequence[tuple[float, core.FloatArray]], since_s: float
) -> tuple[float, float, float]:
    """Return how far the commanded positions (time, (3,) mm) went sideways, down and up after
    ``since_s``, mm.
    """
    way = np.array([at_mm for t_s, at_mm in positions_mm if t_s >= since_s]).reshape(-1, 3)
    if not len(way):
        return 0.0, 0.0, 0.0
    x, y, z = (way - way[0]).T
    return float(np.hypot(x, y).max()), float(-z.min()), float(z.max())


class DriverMonitor:
    """Monitor of the devices of a scene; ``gripper`` is set once there is one."""

    def __init__(self, melfa: EmulatedMelfa) -> None:
        self._melfa = melfa
        self.gripper: SceneWsg | None = None
        self._rest: list[core.FloatArray] = []
        self._rest_n: core.FloatArray = np.zeros(3)
        self._force_n = 0.0

    def add_samples(self, wrench: core.FloatArray) -> None:
        """Process wrist samples (N, 6) of the world."""
        force_n = wrench[:, :3]
        if sum(map(len, self._rest)) < REST_ROWS:
            self._rest.append(force_n)
            self._rest_n = np.concatenate(self._rest).mean(axis=0)
        if len(force_n):
            strongest_n = np.linalg.norm(force_n - self._rest_n, axis=1).max()
            self._force_n = max(self._force_n, float(strongest_n))

    def observations(self) -> DriverObservations:
        """Return the observations so far."""
        stream, gripper = self._melfa.stream, self.gripper
        return DriverObservations(
            step_share=stream.largest_share,
            late_command_s=stream.late_command_s,
            openings=0 if gripper is None else gripper.openings,
            barred=0 if gripper is None else gripper.barred,
            force_n=self._force_n,
        )


STIFF_N_MM = 1000.0
# A descent below this height above first contact starts a new probe with its own nuisances
NEXT_PROBE_MM = 2.0
# A world this late renders no image, which would be outdated; it then catches up several times
# faster
PICTURE_S = 0.040
BEHIND_S = 0.5  # a world this late skips the delay
LATENCY_S = 0.020  # Age of a wrist sample at the sensor: one cycle and its computation
KEPT = 500  # wrist samples kept for the sensor
KEPT_COMMANDS = 3000  # cycles of commanded positions, 30 s
CONTACT_MM = 0.02
HAND_MM = 5.0  # On a bench with a jig, a piece released this high goes to the operator's hand


class EmulatedScene:
    """Scene with the state that its devices read; time passes on its own thread."""

    def __init__(self, scene: Scene, settings: MelfaSettings) -> None:
        self.scene, self.world = scene, World(scene)
        self.frame: BenchFrame = BenchFrame(settings)
        start = self.frame.joints(self.world.drive.command_mm)
        self.melfa: EmulatedMelfa = EmulatedMelfa(settings, start_rad=start)
        self.world.drive.run(CarriedProgram(self))
        self.monitor = DriverMonitor(self.melfa)
        self.melfa.controller.felt = self._felt_in_base
        self._zero_s = 0.0
        self._felt: tuple[float, core.FloatArray] = (0.0, np.zeros((1, 6)))
        self._pictures: dict[core.Finger, core.ImageArray] = {}
        self._stop = threading.Event()
        self.priority = 0  # real-time priority of the world thread if permitted; 0: unchanged
        self._thread = threading.Thread(target=self._run, name="world", daemon=True)
        self.late: int = 0  # skipped cycles
        self.faults: dict[str, Faults] = {}  # of each device, for a strike
        self._commands: deque[tuple[float, core.FloatArray]] = deque(maxlen=KEPT_COMMANDS)

    def start(self) -> None:
        """Start the time."""
        self._thread.start()

    def close(self) -> None:
        """Stop the time."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    @property
    def sampled_until_s(self) -> float:
        """Monotonic time up to which the wrist sensor has samples."""
        return self._zero_s + self._felt[0] + LATENCY_S

    def joints_rad(self, world_s: float) -> core.FloatArray:
        """Return the joints (6,) of the emulated arm at a time of the world."""
        return self.melfa.controller.joints_at(self._zero_s + world_s)

    def wrench(self, now_s: float) -> tuple[float, ...]:
        """Return the wrench ``LATENCY_S`` before ``now_s`` (monotonic), N and N·m.

        Returns the newest sample if the world is late.
        """
        newest_s, rows = self._felt
        rate_hz = self.scene.settings.wrist.rate_hz
        behind = round((newest_s - (now_s - self._zero_s - LATENCY_S)) * rate_hz)
        return tuple(rows[max(-1 - max(behind, 0), -len(rows))].tolist())

    def _felt_in_base(self) -> core.FloatArray:
        """Return the newest wrench (6,) in axes of the arm base."""
        newest, in_base = self._felt[1][-1], self.frame.in_base
        return np.concatenate([in_base(newest[:3]), in_base(newest[3:])])

    def picture(self, finger: core.Finger) -> core.ImageArray | None:
        """Return the newest image of a finger, None if it was returned before."""
        return self._pictures.pop(finger, None)

    def truth(self, *, animate: bool = False) -> SceneTruth:
        """Return the ground truth."""
        return self.world.truth(animate=animate)

    def command_travel(self, since_s: float) -> tuple[float, float, float]:
        """Return ``command_travel`` of the arm since a monotonic time."""
        return command_travel(list(self._commands), since_s)

    def step(self, behind_s: float = 0.0) -> CycleRecord:
        """Advance the world, late by ``behind_s``, by one cycle and publish its samples."""
        sensed = self.world.step(core.FINGERS if behind_s <= PICTURE_S else ())
        self.monitor.add_samples(sensed.wrench)
        rows = np.concatenate([self._felt[1], sensed.wrench])[-KEPT:]
        self._felt = (1e-6 * sensed.end_us, rows)
        over_s = self._zero_s + 1e-6 * sensed.end_us
        self._commands.append((over_s, self.world.drive.command_mm))
        for finger in core.FINGERS:
            if sensed.shots[finger]:
                self._pictures[finger] = sensed.shots[finger][-1].develop()
        return sensed

    def _run(self) -> None:
        """Step each cycle as soon as it is over, when the arm position at its end is known."""
        core.set_realtime_priority(self.priority)
        self._zero_s = time.monotonic() - 1e-6 * self.world.now_us
        while not self._stop.is_set():
            over_s = self._zero_s + 1e-6 * (self.world.now_us + self.world.cycle_us)
            wait_s = over_s - time.monotonic()
            if wait_s > 0.0:
                self._stop.wait(wait_s)
            elif wait_s < -BEHIND_S:
                self._give_up(-wait_s)
            else:
                self.step(-wait_s)

    def _give_up(self, behind_s: float) -> None:
        """Skip the delay; samples from before are not returned for times after."""
        self._felt = (self._felt[0], self._felt[1][-1:])
        self._zero_s += behind_s
        self.late += round(1e6 * behind_s / self.world.cycle_us)


class BenchFrame:
    """Transform between the bench and the arm base."""

    def __init__(self, settings: MelfaSettings) -> None:
        yaw, hand = math.radians(settings.yaw_deg), math.radians(settings.hand_deg)
        self._origin_mm, self._tool_mm = np.array(settings.origin_mm), settings.tool_mm
        self._turn = core.pose_rotation(core.Pose(0.0, 0.0, 0.0, rz_rad=yaw))
        hand_turn = core.pose_rotation(core.Pose(0.0, 0.0, 0.0, rz_rad=yaw + hand))
        self._hand = hand_turn @ np.diag([1.0, -1.0, -1.0])
        self._last: tuple[list[float], core.FloatArray] = ([], np.eye(4))

    def _frame(self, joints_rad: core.FloatArray) -> core.FloatArray:
        """Return the flange pose (4, 4), cached for joints at rest."""
        last, joints = self._last, joints_rad.tolist()
        if joints != last[0]:
            self._last = last = (joints, frame_of(joints_rad))
        return last[1]

    def pivot_mm(self, joints_rad: core.FloatArray) -> core.FloatArray:
        """Return the position (3,) of ``G`` in the bench frame."""
        frame = self._frame(joints_rad)
        at_mm = frame[:3, 3] + self._tool_mm * frame[:3, 2]
        return np.asarray(self._turn.T @ (at_mm - self._origin_mm))

    def in_base(self, vector: core.FloatArray) -> core.FloatArray:
        """Return a vector (3,) of the bench in axes of the arm base."""
        return np.asarray(self._turn @ vector)

    def turn(self, joints_rad: core.FloatArray) -> core.FloatArray:
        """Return the rotation (3, 3) of the hand; the identity within the level tolerance."""
        hand = self._frame(joints_rad)[:3, :3]
        turn = self._turn.T @ hand @ self._hand.T @ self._turn
        level = np.linalg.norm(core.rotation_vector(turn)) <= core.LEVEL_TOLERANCE_RAD
        return core.IDENTITY_ROTATION if level else turn

    def joints(self, pivot_mm: core.FloatArray) -> core.FloatArray:
        """Return joints (6,) with ``G`` there and the hand down; ``ValueError`` out of reach."""
        frame = np.eye(4)
        frame[:3, :3] = self._hand
        frame[:3, 3] = self._origin_mm + self._turn @ pivot_mm - self._tool_mm * self._hand[:, 2]
        found = solve(frame, READY_RAD)
        if found is None:
            raise ValueError("the scene is out of reach of the arm")
        return found


class CarriedProgram(SimProgram):
    """Arm program of the world: follow the joints of the emulated arm."""

    def __init__(self, emulated: EmulatedScene) -> None:
        self._emulated = emulated
        self.turn = core.IDENTITY_ROTATION  # rotation of the emulated arm's hand

    def next_mm(self, command_mm: core.FloatArray, cycle: ArmCycle) -> core.FloatArray:
        """Return the arm position at the end of ``cycle``; a descent begins the next probe."""
        joints_rad, frame = self._emulated.joints_rad(cycle.end_s), self._emulated.frame
        here, holding = frame.pivot_mm(joints_rad), self._emulated.world.holding
        self.turn = frame.turn(joints_rad)
        if holding is not None and not holding.sensed and here[2] < command_mm[2]:
            height = float(here[2]) - holding.touch_height_mm
            if CONTACT_MM < height < NEXT_PROBE_MM:
                holding.begin_probe(ProbeSettings(stiffness_n_mm=(STIFF_N_MM,) * 3))
        return here


class SceneDynpick(EmulatedDynpick):
    """Emulated wrist sensor of a scene; sends no sample beyond the time of the world."""

    def __init__(self, emulated: EmulatedScene, faults: Faults | None = None) -> None:
        faults = faults or Faults("force_torque")
        super().__init__(apply_faults(emulated.wrench, faults))
        self.pace.faults = faults
        self._emulated = emulated

    def due(self, now_s: float) -> bytes:
        """Return the records of the stream up to the time of the world."""
        return super().due(min(now_s, self._emulated.sampled_until_s))


LEAST_STEP_MM, STEP_MM_S = 0.01, 5.0  # smallest step of the jaws, and speed of one that was missed


class SceneWsg(EmulatedWsg):
    """Emulated gripper whose jaws hold the piece of a scene."""

    def __init__(self, emulated: EmulatedScene, faults: Faults | None = None) -> None:
        super().__init__(part_mm=emulated.scene.piece.width_mm, faults=faults)
        self._world, self._piece_mm = emulated.world, emulated.scene.piece.width_mm
        self._held = self._in_hand = False
        self.openings: int = 0
        emulated.monitor.gripper = self

    def due(self, now_s: float) -> bytes:
        """Return the gripper's output and apply its jaws to the world."""
        hand = self._world.jaws
        if hand.piece_present and self._faults.active("part_lost", now_s):
            hand.lose()
        self.jaws.part_mm = self._piece_mm if hand.piece_present else None
        out = super().due(now_s)
        motion = self.jaws.motion
        # A short step may begin and end between two calls.
        open_mm, speed_mm_s = self.jaws.width_mm, STEP_MM_S
        if motion is not None and motion.velocity_mm_s > 0.0:
            open_mm, speed_mm_s = motion.target_mm, motion.velocity_mm_s
        if not self._held and self.jaws.force_n > 0.0:
            self._held = True
            hand.width_mm = self._piece_mm
            hand.close(0.5 * self.jaws.force_n)
        elif (self._held or hand.loosened) and open_mm > hand.width_mm + LEAST_STEP_MM:
            self.openings += self._held
            self._held, self._in_hand = False, self._is_taken()
            hand.open_to(open_mm, speed_mm_s)
        elif self._in_hand and not hand.piece_present:
            self._in_hand, hand.piece_present = False, True
        elif motion is None and not (self._held or hand.piece_present) and self._is_taken():
            # The piece stands or lies on the bench: the operator sets up once more.
            self._world.set_up_again()
        return out

    def _is_taken(self) -> bool:
        """Return True if an operator holds the piece when the jaws open: on a bench with a jig."""
        world = self._world
        return world.scene.jig and world.clear_mm(world.drive.command_mm) > HAND_MM


SERIALS: Mapping[core.Finger, str] = {"left": "LEFT-0001", "right": "RGHT-0001"}
BENCH_FILE = "bench.toml"
LAB_HEAD = """\
# Lab file of an emulated bench: it holds as long as the bench is served.
version = 1
name = "Rehearsal"
kind = "emulated"
piece = "{piece}"
bottom = "{bottom}"

"""
POLL_HZ = 100.0  # Poll rate of the cameras: once per cycle of the world

# Real-time priority of all devices, below that of the rig: real devices do not share the CPU
EMULATOR_PRIORITY = 20
# About one cycle of the arm, which senses once a cycle; each poll wakes sensor and driver
SENSOR_TICK_S = 0.004
GRIPPER_TICK_S = 0.01  # one cycle of the world; commands wake the gripper at once

# The default of 5 ms, accumulated over threads, made the arm miss ten cycles at a time
SWITCH_S = 0.0005


# Period of a wake-up, and the work at each of emulated devices that follow a motion
WAKE_S, WORK_S = 0.004, 0.001


def longest_delay_s(seconds: float, work_s: float = 0.0) -> float:
    """Return the longest delay of this thread, which computes for ``work_s`` every 4 ms."""
    longest_s, never = 0.0, threading.Event()
    begun_s = now_s = time.monotonic()
    while now_s - begun_s < seconds:
        due_s = now_s + WAKE_S
        never.wait(WAKE_S)
        work_end_s = time.thread_time() + work_s
        while time.thread_time() < work_end_s:
            pass
        now_s = time.monotonic()
        longest_s = max(longest_s, now_s - work_s - due_s)
    return longest_s


def processor_share(seconds: float) -> float:
    """Return the share of a processor core that this thread gets while it computes, 0 to 1."""
    begun_s, used_s = time.monotonic(), time.thread_time()
    while (passed_s := time.monotonic() - begun_s) < seconds:
        pass
    return (time.thread_time() - used_s) / passed_s


def shorten_switch_interval() -> None:
    """Prepare the process that serves a bench for real time.

    Threads switch sooner, and the garbage collector ignores the objects made so far.
    """
    sys.setswitchinterval(SWITCH_S)
    gc.collect()
    gc.freeze()


def serve_bench(
    scene: Scene, folder: Path, plan: FaultPlan, host: str = "127.0.0.1", *, terminal: bool = True
) -> tuple[EmulatedScene, Emulation]:
    """Make arm, gripper, wrist sensor and both cameras of ``scene`` on free ports.

    ``folder`` takes the links of sensor and cameras, and the bench file. The wrist sensor is on a
    pseudo terminal or, without ``terminal``, on a TCP port: a thread of the system without
    priority carries the bytes of a terminal, late on a busy computer. Raises ``OSError``, and
    ``InputError`` for a bench file of other origin in ``folder``.
    """
    file, fingers = folder / BENCH_FILE, camera_tables(folder, SERIALS)
    own = core.parse_toml(bench_toml(fingers))["gelsight"]
    if file.exists() and read_toml(file).get("gelsight") != own:
        what = "This command did not write the file; it would be replaced."
        raise core.InputError(what, str(file), "Name another folder.")
    settings = HardwareSettings.model_validate({"melfa": {"mxt": {"mxttout": TIMEOUT_CYCLES}}})
    emulated = EmulatedScene(scene, settings.melfa)
    folder.mkdir(parents=True, exist_ok=True)
    arm = MelfaServer(emulated.melfa, host, faults=Faults("arm", plan))
    gripping = Faults("gripper", plan)
    gripper = TcpServer(SceneWsg(emulated, gripping), host, faults=gripping)
    felt = Faults("force_torque", plan)
    sensor: TcpServer | PtyServer
    if sys.platform == "win32" or not terminal:
        sensor = TcpServer(SceneDynpick(emulated, felt), host, faults=felt)
    else:
        sensor = PtyServer(SceneDynpick(emulated, felt), faults=felt, link=folder / "force_torque")
    sensor.tick_s, gripper.tick_s = SENSOR_TICK_S, GRIPPER_TICK_S
    cameras = [
        GelsightServer(
            lambda now_s, finger=finger: emulated.picture(finger),  # type: ignore[misc]
            folder,
            SERIALS[finger],
            rate_hz=POLL_HZ,
            faults=Faults(f"tactile_{finger}", plan),
        )
        for finger in core.FINGERS
    ]
    emulated.faults = {one.faults.device: one.faults for one in (arm, gripper, sensor, *cameras)}
    emulated.priority = EMULATOR_PRIORITY
    for server in (arm, gripper, sensor, *cameras):
        server.priority = EMULATOR_PRIORITY
    tables: dict[str, Mapping[str, object]] = {
        **melfa_tables(arm),
        "wsg": {"host": host, "port": gripper.address[1]},
        "ft": {"driver": "dynpick", "address": sensor.url, "latency_ms": 1e3 * LATENCY_S},
        **fingers,
    }
    file.write_text(bench_toml(tables), "utf-8")
    return emulated, Emulation((arm, gripper, sensor, *cameras), tables)


def lab_toml(scene: Scene, emulation: Emulation) -> str:
    """Return a lab file of an emulated bench, with the values that a laboratory would measure."""
    wrist, tactile = scene.settings.wrist, scene.settings.tactile
    bottoms = "+".join(body.name for body in scene.bottoms.bodies)
    tables = {name: dict(table) for name, table in emulation.bench.items()}
    tables["gelsight"] |= {"mm_per_px_x": tactile.mm_per_px[0], "mm_per_px_y": tactile.mm_per_px[0]}
    mounting = {
        "sensor_height_mm": wrist.height_mm,
        "sensor_yaw_rad": wrist.yaw_rad,
        "payload_kg": wrist.payload_kg,
        "payload_com_mm": list(wrist.payload_com_mm),
    }
    return LAB_HEAD.format(piece=scene.piece.name, bottom=bottoms) + bench_toml(
        {"mounting": mounting, **tables}
    )


ANSWER_S = 2.0
LONGEST = 4096
TRUTH, AFTER, STRIKE = b"?\n", b"after ", b"strike "
TRUTH_FIELDS = ("offset_mm", "yaw_rad", "margin_mm", "stands", "slip_mm", "knocked_over", "kick_mm")


class TruthServer(EmulatedDevice):
    """Answers each line with a line of JSON: ground truth or command travel; starts a fault."""

    def __init__(self, emulated: EmulatedScene) -> None:
        self._emulated = emulated

    def receive(self, now_s: float, data: bytes) -> bytes:
        """Return one line per line."""
        answer = b""
        for line in data.splitlines(keepends=True):
            if line.startswith(AFTER):
                travel = self._emulated.command_travel(float(line[len(AFTER) :]))
                answer += json.dumps(travel).encode() + b"\n"
            elif line.startswith(STRIKE):
                fault = json.loads(line[len(STRIKE) :])
                self._emulated.faults[fault.pop("device")].inject(now_s, **fault)
                answer += json.dumps(time.monotonic()).encode() + b"\n"
            elif line.endswith(b"\n"):
                truth = self._emulated.truth()
                fields = {name: getattr(truth, name) for name in TRUTH_FIELDS}
                answer += json.dumps(fields).encode() + b"\n"
        return answer


GONE = core.Fault(
    "BENCH-GONE",
    "The process of the emulated bench has ended.",
    "All emulated devices are gone.",
    "Start Touchdown again; the last output is on standard error.",
)


class TruthClient:
    """Ground truth of ``scene``, which another process emulates at ``address``."""

    def __init__(self, scene: Scene, address: tuple[str, int]) -> None:
        self.scene, self._address = scene, address

    def truth(self, *, animate: bool = False) -> SceneTruth:
        """Return the ground truth; raises ``FaultError``."""
        answer = self._ask(TRUTH)
        x, y = answer.pop("offset_mm")
        return SceneTruth(offset_mm=(x, y), fall=None, **answer)

    def command_travel(self, since_s: float) -> tuple[float, float, float]:
        """Return ``command_travel`` since a monotonic time; raises ``FaultError``."""
        side_mm, down_mm, up_mm = self._ask(AFTER + f"{since_s!r}\n".encode())
        return side_mm, down_mm, up_mm

    def strike(self, device: str, kind: str, for_s: float, **more: float) -> float:
        """Start a fault of a device now; return the monotonic time of its start.

        Raises ``FaultError``.
        """
        fault = {"device": device, "kind": kind, "for_s": for_s, **more}
        return float(self._ask(STRIKE + json.dumps(fault).encode() + b"\n"))

    def _ask(self, question: bytes) -> Any:
        received = b""
        try:
            with socket.create_connection(self._address, timeout=ANSWER_S) as line:
                line.sendall(question)
                while not received.endswith(b"\n") and len(received) < LONGEST:
                    more = line.recv(LONGEST)
                    if not more:
                        raise core.FaultError(GONE)
                    received += more
        except OSError as error:
            raise core.FaultError(GONE) from error
        return json.loads(received)
