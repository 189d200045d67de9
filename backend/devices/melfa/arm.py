"""Driver of the MELFA arm."""

from __future__ import annotations

import contextlib
import math
import threading
from collections.abc import Callable, Mapping

import numpy as np

from touchdown.backend.config import MelfaSettings
from touchdown.backend.core import (
    IDENTITY_ROTATION,
    Fault,
    FaultError,
    Pose,
    SampleStream,
    pose_rotation,
    require_unrotated,
    rotation_vector,
)
from touchdown.backend.devices.melfa.console import Console
from touchdown.backend.devices.melfa.faults import link_fault
from touchdown.backend.devices.melfa.force_program import Air, ForceProgram
from touchdown.backend.devices.melfa.sockets import Wires
from touchdown.backend.devices.melfa.status import Orders, Watch, raw_fields, trace_of, words_of
from touchdown.backend.devices.melfa.stream import END, JOINT_RANGES, Inbox, Phase, StreamCore
from touchdown.backend.devices.protocols import (
    STILL,
    TURN_RAD_S,
    ArmStatus,
    CommandedMotion,
    DeviceState,
    Health,
    Identity,
    Joints,
    PressCommand,
    Steps,
    Vector,
    servo_off_fault,
)
from touchdown.backend.devices.streamed import (
    ARM,
    NOT_CONNECTED,
    REPLACED,
    STOPPED,
    ArmPress,
    MeasuredPlaces,
    air_before,
)

INF, LONGEST_S = math.inf, 3600.0
WAIT_S = 0.02
OPEN_S = 5.0


class MelfaArm:
    """``wrench``: the untared samples of the wrist sensor, in the axes of the bench."""

    name = ARM
    rotates = True
    joint_limits_rad = JOINT_RANGES

    def __init__(
        self,
        wires: Wires,
        wrench: SampleStream,
        settings: MelfaSettings,
        now_s: Callable[[], float],
        poses: SampleStream | None = None,
    ) -> None:
        self._wires, self._settings, self._now_s = wires, settings, now_s
        self._wrench, self._wrench_cursor = wrench, 0
        self._measured = MeasuredPlaces(now_s, poses)
        self.poses = self._measured.poses
        """Measured position of ``G``, mm in the bench, once per cycle."""
        self._orders, self.steps = Orders(settings), Steps()
        self._core = StreamCore(settings, self._orders.placing)
        self._watch: Watch | None = None
        self._stopped = threading.Event()
        self._console = Console(wires, settings, self._stopped, threading.Event())
        self._force = ForceProgram(lambda: self._console, wires, settings)
        self._lock = threading.Lock()
        self.state = DeviceState.CLOSED
        """Where the connection is in its life."""
        self.identity: Identity | None = None
        """Known once connected; the controller tells no number, so its address stands for it."""
        self._powered = False
        self.fault: Fault | None = None

    # -- connection -------------------------------------------------------------------------------

    @property
    def health(self) -> Health:
        """Rate of measured positions over the last second, age of the newest, counts."""
        with self._lock:
            counts = self._core.replies.counts
            return self._measured.health(counts.refused + counts.skipped)

    def describe(self) -> Mapping[str, str | float]:
        """Return the commanded place and the counts of the link."""
        return raw_fields(self._core, self._wires, self._settings, self._console)

    def connect(self, timeout_s: float, cancel: threading.Event) -> None:
        """Go through the start-up to an open stream; ``timeout_s`` is the least for each step."""
        if self.state is DeviceState.READY:
            return
        self.close()
        self.state, self.fault = DeviceState.CONNECTING, None
        self._stopped.clear()
        self._console = self._console.again(cancel)
        self._measured.begin()
        self.steps.begin()
        try:
            self._wires.open(self._cycle, self._lost)
            self.steps.reached("reach")
            self.identity = self._console.start_up(self.steps.reached)
            self._powered = True
            self._open_stream()
            self.steps.reached("first sample")
        except FaultError as error:
            self._give_up()
            raise FaultError(self._latched() or error.fault) from error
        # What was measured on the way up belongs to no connection yet.
        self.poses.clear()
        with self._lock:
            ready = self._latched() is None
            self.state = DeviceState.READY if ready else DeviceState.FAULT

    def examine(self) -> Identity:
        """Ask who answers, while closed; raises ``FaultError``. Nothing is switched on."""
        try:
            self._wires.open(lambda now_s, datagrams: None, lambda fault: None)
            return self._console.examine()
        finally:
            self._wires.close()

    def close(self) -> None:
        """Brake, end the stream, stop, switch the servo off; the gripper stays as it is."""
        if self.state is DeviceState.CLOSED:
            return
        with self._lock:
            self._core.halt()
        self._wires.pause(0.1)
        self._give_up()

    def servo(self, on: bool) -> None:
        """Switch the motors; the place is told all the while. May take seconds."""
        if self.state is not DeviceState.READY:
            raise FaultError(self.fault or NOT_CONNECTED)
        if on:
            self._stopped.clear()
            self._console.servo_on()
            self._powered = True
            return
        self._powered = False
        with self._lock:
            self._core.halt()
        self._wires.pause(0.1)
        self._end_stream()
        self._console.servo_off()

    def _end_stream(self, fault: Fault = STOPPED) -> None:
        with self._lock:
            self._core.stop(fault)
        self._wires.pause(WAIT_S)

    def _give_up(self) -> None:
        self._end_stream()
        with contextlib.suppress(FaultError):
            self._console.shut_down()
        self._watch = None
        self._wires.close()
        self.state = DeviceState.CLOSED

    def _open_stream(self) -> None:
        """Take the place that the running program replies; raises ``FaultError``."""
        placing, euler = self._orders.placing, self._settings.euler
        with self._lock:
            if self._stopped.is_set():
                raise FaultError(STOPPED)
            self._watch = Watch(self._wires.ask, placing, euler)
            self._wrench_cursor = self._wrench.count
            self._core.begin(self._now_s())
        waited_s = 0.0
        while self._core.phase is not Phase.OPEN:
            self._wires.pause(WAIT_S)
            waited_s += WAIT_S
            if self.fault is not None:
                raise FaultError(self.fault)
            if self._stopped.is_set():
                raise FaultError(STOPPED)
            if waited_s > OPEN_S + self._settings.mxt.start_timeout_s:
                raise FaultError(link_fault("The real-time stream does not open."))

    # -- one cycle, on the thread that owns the real-time wire ------------------------------------

    def _cycle(self, now_s: float, datagrams: tuple[bytes, ...]) -> bytes | None:
        with self._lock:
            samples = self._wrench.since(self._wrench_cursor)
            self._wrench_cursor = samples.cursor
            felt = samples.t_s, samples.values[:, :3]
            out = self._core.step(now_s, Inbox(datagrams, *felt))
            watch = self._watch
            self._force.cycle(now_s, felt, running=watch is None or not watch.ended)
            if out.pose_mm is not None:
                self._measured.put(now_s, out.pose_mm)
            if watch is not None:
                self._supervise(now_s, watch)
            if out.fault is not None:
                self._latch(out.fault)
        if out.fault is not None:
            self._wires.stop_now(END)
        return out.packet

    def _supervise(self, now_s: float, watch: Watch) -> None:
        streaming = self._core.phase in (Phase.OPEN, Phase.HOLDING)
        watch.step(now_s, streaming=streaming, probing=self._force.running)
        if watch.place_mm is not None:
            self._measured.put(now_s, watch.place_mm)
            watch.place_mm = None
        if watch.fault is not None:
            self._core.stop(watch.fault)
            self._force.end(watch.fault)
            self._latch(watch.fault)
            watch.fault = None

    def _latched(self) -> Fault | None:
        return self.fault

    def _latch(self, fault: Fault) -> None:
        """Keep the first fault, unless the controller's own reason comes after a silence."""
        if self.fault is None or self.fault.code in ("MXT-LOST", "MXT-ENDED"):
            self.fault = fault
        self.state = DeviceState.FAULT

    def _lost(self, fault: Fault) -> None:
        with self._lock:
            self._core.stop(fault)
            self._force.end(fault)
            self._latch(fault)

    # -- state ------------------------------------------------------------------------------------

    def status(self) -> ArmStatus:
        """Return the status words."""
        state = None if self._watch is None else self._watch.state
        moving = self._force.under_way or self._orders.under_way(self._core)
        return words_of(self.state, state, self.fault, moving=moving)

    @property
    def press_n(self) -> float:
        """Felt press force by the zero of the contact law; NaN without contact."""
        return self._force.press_n if self._force.running else self._orders.level.press_n()

    def trace(self) -> tuple[float, ...]:
        """Return the values of ``TRACE`` as they are now."""
        with self._lock:
            return trace_of(self._core, self._orders)

    def pose(self, max_age_s: float) -> Pose:
        """Return the measured pose; raises ``StaleSampleError`` if it is older."""
        x, y, z = self._measured.latest_mm(max_age_s + self._force.place_late_s)
        with self._lock:
            turned, joints = self._core.turn is not IDENTITY_ROTATION, self._core.measured_rad
        if not turned:
            return Pose(x, y, z)
        return Pose(x, y, z, *rotation_vector(self._orders.placing.turn(joints)).tolist())

    # -- motion -----------------------------------------------------------------------------------

    def move_to(
        self, target: Pose, speed_mm_s: float, turn_rad_s: float = TURN_RAD_S
    ) -> CommandedMotion:
        """Move straight to ``target``, turning on the way; ValueError for a senseless number."""
        goal, turn = np.array([target.x_mm, target.y_mm, target.z_mm]), pose_rotation(target)
        speeds = (speed_mm_s, turn_rad_s)
        if not (np.isfinite([*goal, *turn.ravel()]).all() and all(0.0 < v < INF for v in speeds)):
            raise ValueError("target and speed must be finite, the speed positive")
        self._require_stream()
        with self._lock:
            return self._orders.travel(self._core, (goal, turn), speeds)

    def jog(
        self, velocity_mm_s: Vector, for_s: float, turn_rad_s: Vector = STILL
    ) -> CommandedMotion:
        """Follow a velocity and a turn for ``for_s``; a renewal goes on without a jerk."""
        velocity, turning = np.array(velocity_mm_s), np.array(turn_rad_s)
        if not (np.isfinite([*velocity, *turning]).all() and 0.0 < for_s <= LONGEST_S):
            raise ValueError("velocity and time must be finite, the time positive")
        self._require_stream()
        with self._lock:
            return self._orders.jog(self._core, velocity, turning, self._now_s() + for_s)

    def joints_rad(self, max_age_s: float) -> Joints:
        """Return the measured joints; raises ``StaleSampleError`` if they are older."""
        self.poses.latest(self._now_s(), max_age_s)
        with self._lock:
            return tuple(self._core.measured_rad.tolist())

    def place_of(self, joints_rad: Joints) -> Pose:
        """Return the pose that these joints give the hand."""
        joints, placing = np.array(joints_rad), self._orders.placing
        x, y, z = placing.pivot_mm(joints).tolist()
        return Pose(x, y, z, *rotation_vector(placing.turn(joints)).tolist())

    def jog_joints(self, speeds_rad_s: Joints, for_s: float) -> CommandedMotion:
        """Turn the joints for ``for_s``; a renewal goes on without a jerk."""
        speeds = np.array(speeds_rad_s)
        if not (speeds.shape == (6,) and np.isfinite(speeds).all() and 0.0 < for_s <= LONGEST_S):
            raise ValueError("six speeds and the time must be finite, the time positive")
        self._require_stream()
        with self._lock:
            return self._orders.jog_joints(self._core, speeds, self._now_s() + for_s)

    def move_joints(self, target_rad: Joints, speed_rad_s: float) -> CommandedMotion:
        """Turn all joints to ``target_rad``; none goes faster than ``speed_rad_s``."""
        target = np.array(target_rad)
        sensible = target.shape == (6,) and bool((np.abs(target) <= 4.0 * math.pi).all())
        if not (sensible and 0.0 < speed_rad_s < INF):
            raise ValueError("six joints and the speed must be finite, the speed positive")
        self._require_stream()
        with self._lock:
            return self._orders.travel_joints(self._core, target, speed_rad_s)

    def press(self, command: PressCommand) -> ArmPress:
        """Press compliantly from here straight down; refused while the hand is turned."""
        if self._settings.stiffness_mode == "controller":
            return self._press_by_controller(command)
        self._require_stream()
        require_unrotated(self._core.turn)
        before = air_before(self._wrench, self._now_s())
        with self._lock:
            return self._orders.level.press(self._core, command, before)

    def unload(self, force_n: float, speed_mm_s: float) -> CommandedMotion:
        """Rise until the press force is ``force_n``."""
        if self._force.running:
            self._require_ready()
            return self._force.unload(force_n, speed_mm_s, self._now_s())
        self._require_stream()
        with self._lock:
            return self._orders.level.unload(self._core, force_n, speed_mm_s)

    def halt(self) -> None:
        """Brake and stand still; the stream goes on, a force program is stopped."""
        with self._lock:
            self._core.halt()
        if self._force.running:
            self._force.end(STOPPED)
            self._wires.stop_now(END)
            self._wires.pace(running=False)

    def retreat(self) -> None:
        """Draw back from what the arm touches; where no stream is open, stop."""
        with self._lock:
            if self._core.phase is Phase.OPEN:
                self._orders.level.retreat(self._core)
                return
        self.stop()

    def stop(self) -> None:
        """End the stream and stop the controller on a connection of its own."""
        self._stopped.set()
        with self._lock:
            self._core.stop()
            self._force.end(STOPPED)
        if self.state is not DeviceState.CLOSED:
            self._wires.stop_now(END)
            self._wires.pace(running=False)

    def _press_by_controller(self, command: PressCommand) -> ArmPress:
        """End the stream and let the controller press by its force program."""
        self._force.refuse(command)
        self._require_ready()
        require_unrotated(self._core.turn)
        self._force.end(REPLACED)
        self._stopped.clear()
        self._end_stream(REPLACED)
        return self._force.begin(command, self._air_of_program)

    def _air_of_program(self) -> Air:
        if self._watch is not None:
            # What the controller told before concerns another program.
            self._watch.state = None
        return air_before(self._wrench, self._now_s())

    def _require_stream(self) -> None:
        """Raise ``FaultError`` unless ready; after a stop or a force program it is opened again."""
        self._require_ready()
        if self._force.running:
            self._force.end(REPLACED)
        if self._core.phase is not Phase.OPEN:
            self._stopped.clear()
            self._console.run_stream()
            self._open_stream()

    def _require_ready(self) -> None:
        """Raise ``FaultError`` unless connected with its motors on."""
        if self.state is not DeviceState.READY:
            raise FaultError(self.fault or NOT_CONNECTED)
        if not self._powered:
            # The program of the stream would switch them on.
            raise FaultError(servo_off_fault(ARM))
