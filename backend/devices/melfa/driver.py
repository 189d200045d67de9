"""Driver of a MELFA arm: straight moves, jogging, compliant presses, streamed by this computer.

Start-up, errors and STOP use the command channel, every motion the real-time stream. ``stop`` is
out of band: it waits for no thread and for no lock that a wire could hold.
"""

from __future__ import annotations

import contextlib
import math
import threading
from collections.abc import Callable, Mapping

import numpy as np

from touchdown.backend.config import HardwareSettings, MelfaSettings
from touchdown.backend.core import (
    IDENTITY_ROTATION,
    Fault,
    FaultError,
    FloatArray,
    Pose,
    SampleStream,
    pose_rotation,
    require_unrotated,
    rotation_vector,
)
from touchdown.backend.devices import streamed
from touchdown.backend.devices.melfa import command_channel
from touchdown.backend.devices.melfa.faults import link_fault
from touchdown.backend.devices.melfa.force_program import AirBaseline, ForceProgram
from touchdown.backend.devices.melfa.kinematics import JOINT_RANGES, MelfaPlacement
from touchdown.backend.devices.melfa.r3_protocol import ControllerState, RunFlags
from touchdown.backend.devices.melfa.realtime_protocol import CYCLE_S
from touchdown.backend.devices.melfa.sockets import SocketLinks
from touchdown.backend.devices.melfa.stream import END, Phase, StreamCore, StreamInput
from touchdown.backend.devices.protocols import (
    ARM,
    NOT_CONNECTED,
    REPLACED,
    STILL,
    STOPPED,
    TURN_RAD_S,
    ArmPress,
    ArmStatus,
    CommandedMotion,
    ConnectionSteps,
    DeviceState,
    Health,
    Identity,
    Joints,
    PressCommand,
    RobotMode,
    SafetyMode,
    Vector,
    servo_off_fault,
)


class MelfaPrograms:
    """Creates programs for one arm; ``level``: those of every streamed arm."""

    def __init__(self, settings: MelfaSettings) -> None:
        self.placing = MelfaPlacement(
            settings.origin_mm,
            math.radians(settings.yaw_deg),
            math.radians(settings.hand_deg),
            settings.tool_mm,
        )
        lags_s = 1e-3 * settings.arm_lag_ms, 1e-3 * settings.sensor_lag_ms
        self.level = streamed.StreamedPrograms(streamed.LoopDelays(CYCLE_S, *lags_s))

    def under_way(self, core: StreamCore) -> bool:
        """Return True while a motion is active."""
        program = core.program
        return program is not None and not program.motion.done

    def travel(
        self, core: StreamCore, target: tuple[FloatArray, FloatArray], speeds: tuple[float, float]
    ) -> CommandedMotion:
        """Start a straight move to (3,) mm and (3, 3) turn, with mm/s and rad/s."""
        target_mm, turn = target
        x, y, z = target_mm.tolist()
        motion = CommandedMotion({"x_mm": x, "y_mm": y, "z_mm": z, "speed_mm_s": speeds[0]})
        self.level.leave()
        if turn is IDENTITY_ROTATION and core.turn is IDENTITY_ROTATION:
            core.run(streamed.TravelProgram(motion, target_mm, speeds[0]))
        else:
            core.run(streamed.RotationTravelProgram(motion, target, speeds))
        return motion

    def jog(
        self, core: StreamCore, velocity_mm_s: FloatArray, turn_rad_s: FloatArray, until_s: float
    ) -> CommandedMotion:
        """Start to move at a velocity and turn rate, or continue with new ones."""
        if core.turn is IDENTITY_ROTATION and not turn_rad_s.any():
            return self.level.follow(core, velocity_mm_s, until_s)
        program = core.program
        self.level.leave()
        if not isinstance(program, streamed.JogProgram) or not program.turns or program.motion.done:
            program = streamed.JogProgram(
                streamed.jog_motion(velocity_mm_s, turn_rad_s), turn_rad_s=streamed.AT_REST
            )
            core.run(program)
        program.renew(velocity_mm_s, until_s, turn_rad_s)
        return program.motion

    def jog_joints(
        self, core: StreamCore, speeds_rad_s: FloatArray, until_s: float
    ) -> CommandedMotion:
        """Start to turn joints, or continue with new speeds."""
        program = core.program
        self.level.leave()
        if not isinstance(program, streamed.JointJogProgram) or program.motion.done:
            speeds = {f"j{k}_rad_s": v for k, v in enumerate(speeds_rad_s.tolist(), 1)}
            program = streamed.JointJogProgram(CommandedMotion(speeds))
            core.run(program)
        program.renew(speeds_rad_s, until_s)
        return program.motion


PHASES = {phase: float(place) for place, phase in enumerate(Phase)}


def arm_status(
    device: DeviceState, state: ControllerState | None, fault: Fault | None, *, moving: bool
) -> ArmStatus:
    """Return the status; ``state`` is the last report of the controller."""
    if device is DeviceState.CLOSED:
        return ArmStatus(RobotMode.DISCONNECTED, SafetyMode.UNKNOWN, 0.0, 0)
    override = 0.0 if state is None else state.override / 100.0
    error = 0 if state is None else state.error
    if device is DeviceState.CONNECTING:
        return ArmStatus(RobotMode.CONNECTING, SafetyMode.UNKNOWN, override, error)
    safety = SafetyMode.NORMAL
    if device is DeviceState.FAULT:
        stopped = fault is not None and fault.code == "HW-STOP"
        safety = SafetyMode.HW_STOP if stopped else SafetyMode.FAULT
    mode = RobotMode.READY
    if state is not None and RunFlags.SERVO_ON not in state.run:
        mode = RobotMode.SERVO_OFF
    elif moving:
        mode = RobotMode.MOVING
    return ArmStatus(mode, safety, override, error)


INF, LONGEST_S = math.inf, 3600.0
WAIT_S = 0.02
OPEN_S = 5.0


class MelfaArm:
    """Driver of the arm; ``wrench``: untared samples of the wrist sensor in bench axes."""

    name = ARM
    rotates = True
    joint_limits_rad = JOINT_RANGES

    def __init__(
        self,
        wires: command_channel.ControllerLinks,
        wrench: SampleStream,
        settings: MelfaSettings,
        now_s: Callable[[], float],
        poses: SampleStream | None = None,
    ) -> None:
        self._wires, self._settings, self._now_s = wires, settings, now_s
        self._wrench, self._wrench_cursor = wrench, 0
        self._measured = streamed.PositionRecord(now_s, poses)
        # Measured position of ``G``, mm in the bench frame, once per cycle.
        self.poses = self._measured.poses
        self._orders, self.steps = MelfaPrograms(settings), ConnectionSteps()
        self._core = StreamCore(settings, self._orders.placing)
        self._watch: command_channel.ControllerPoller | None = None
        self._stopped = threading.Event()
        self._console = command_channel.Console(wires, settings, self._stopped, threading.Event())
        self._force = ForceProgram(lambda: self._console, wires, settings)
        self._lock = threading.Lock()
        self.state = DeviceState.CLOSED  # state of the connection
        # None before the first connection; the address replaces a serial number.
        self.identity: Identity | None = None
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
        """Return the commanded position of ``G`` and the counts of the link."""
        core, counts, times = self._core, self._core.replies.counts, self._wires.times
        return {
            "kind": "melfa",
            "host": self._settings.host,
            "stream": core.phase.value,
            **dict(zip(("x_mm", "y_mm", "z_mm"), core.command_mm.tolist(), strict=True)),
            "holds": core.holds,
            "refused": counts.refused,
            "repeated": counts.repeated,
            "old": counts.old,
            "skipped": counts.skipped,
            "controller_missed": core.timeouts,
            "bad_replies": self._wires.bad_replies,
            "late_cycles": times.late,
            "latest_ms": 1e3 * times.latest_s,
            "realtime": "yes" if times.realtime else "no",
            "time_limit": "none" if self._console.unlimited else "set",
            **({"notice": self._console.notice} if self._console.notice else {}),
        }

    def connect(self, timeout_s: float, cancel: threading.Event) -> None:
        """Connect up to an open stream; ``timeout_s`` is the minimum time limit of each step."""
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
        # Discard positions measured during the start-up.
        self.poses.clear()
        with self._lock:
            ready = self._latched() is None
            self.state = DeviceState.READY if ready else DeviceState.FAULT

    def examine(self) -> Identity:
        """Read the identity while closed; raises ``FaultError``. Nothing is switched on."""
        try:
            self._wires.open(lambda now_s, datagrams: None, lambda fault: None)
            return self._console.examine()
        finally:
            self._wires.close()

    def close(self) -> None:
        """Brake, end the stream, stop, switch the servo motors off; the gripper does not move."""
        if self.state is DeviceState.CLOSED:
            return
        with self._lock:
            self._core.halt()
        self._wires.pause(0.1)
        self._give_up()

    def servo(self, on: bool) -> None:
        """Switch the servo motors; positions continue meanwhile. May take seconds."""
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
        """Open the stream at the position that the program replies; raises ``FaultError``."""
        placing, euler = self._orders.placing, self._settings.euler
        with self._lock:
            if self._stopped.is_set():
                raise FaultError(STOPPED)
            self._watch = command_channel.ControllerPoller(self._wires.ask, placing, euler)
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

    # -- cycle, on the thread that owns the real-time wire ----------------------------------------

    def _cycle(self, now_s: float, datagrams: tuple[bytes, ...]) -> bytes | None:
        with self._lock:
            samples = self._wrench.since(self._wrench_cursor)
            self._wrench_cursor = samples.cursor
            felt = samples.t_s, samples.values[:, :3]
            out = self._core.step(now_s, StreamInput(datagrams, *felt))
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

    def _supervise(self, now_s: float, watch: command_channel.ControllerPoller) -> None:
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
        """Latch the first fault; the controller's own reason replaces a silence."""
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
        """Return the status."""
        state = None if self._watch is None else self._watch.state
        moving = self._force.under_way or self._orders.under_way(self._core)
        return arm_status(self.state, state, self.fault, moving=moving)

    @property
    def press_n(self) -> float:
        """Measured press force relative to the zero of the contact law, N; NaN without contact."""
        return self._force.press_n if self._force.running else self._orders.level.press_n()

    def trace(self) -> tuple[float, ...]:
        """Return the present values, in the order of ``TRACE_NAMES``."""
        with self._lock:
            core, level = self._core, self._orders.level
            return (
                *core.command_mm.tolist(),
                *core.measured_mm.tolist(),
                *core.sent_rad.tolist(),
                *core.measured_rad.tolist(),
                *(PHASES[core.phase], core.missed, core.holds),
                *(self._orders.under_way(core), level.press_n()),
            )

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
        """Move on a straight line to ``target`` and turn; raises ``ValueError`` for an invalid
        number.
        """
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
        """Move at a velocity and turn rate for ``for_s``; a renewal continues smoothly."""
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
        """Return the pose of the hand at these joints."""
        joints, placing = np.array(joints_rad), self._orders.placing
        x, y, z = placing.pivot_mm(joints).tolist()
        return Pose(x, y, z, *rotation_vector(placing.turn(joints)).tolist())

    def jog_joints(self, speeds_rad_s: Joints, for_s: float) -> CommandedMotion:
        """Turn the joints for ``for_s``; a renewal continues smoothly."""
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
            ends = {f"j{k}_rad": v for k, v in enumerate(target.tolist(), 1)}
            motion = CommandedMotion({**ends, "speed_rad_s": speed_rad_s})
            self._orders.level.leave()
            self._core.run(streamed.JointTravelProgram(motion, target, speed_rad_s))
            return motion

    def press(self, command: PressCommand) -> ArmPress:
        """Press compliantly, straight down; refused while the hand is turned."""
        if self._settings.stiffness_mode == "controller":
            return self._press_by_controller(command)
        self._require_stream()
        require_unrotated(self._core.turn)
        before = streamed.air_before(self._wrench, self._now_s())
        with self._lock:
            return self._orders.level.press(self._core, command, before)

    def unload(self, force_n: float, speed_mm_s: float) -> CommandedMotion:
        """Lift until the press force is ``force_n``."""
        if self._force.running:
            self._require_ready()
            return self._force.unload(force_n, speed_mm_s, self._now_s())
        self._require_stream()
        with self._lock:
            return self._orders.level.unload(self._core, force_n, speed_mm_s)

    def halt(self) -> None:
        """Brake to standstill; the stream continues, a force program is stopped."""
        with self._lock:
            self._core.halt()
        if self._force.running:
            self._force.end(STOPPED)
            self._wires.stop_now(END)
            self._wires.pace(running=False)

    def retreat(self) -> None:
        """Retreat from the contact; stop if no stream is open."""
        with self._lock:
            if self._core.phase is Phase.OPEN:
                self._orders.level.retreat(self._core)
                return
        self.stop()

    def stop(self) -> None:
        """End the stream and stop the controller on a separate connection."""
        self._stopped.set()
        with self._lock:
            self._core.stop()
            self._force.end(STOPPED)
        if self.state is not DeviceState.CLOSED:
            self._wires.stop_now(END)
            self._wires.pace(running=False)

    def _press_by_controller(self, command: PressCommand) -> ArmPress:
        self._force.refuse(command)
        self._require_ready()
        require_unrotated(self._core.turn)
        self._force.end(REPLACED)
        self._stopped.clear()
        self._end_stream(REPLACED)
        return self._force.begin(command, self._air_of_program)

    def _air_of_program(self) -> AirBaseline:
        if self._watch is not None:
            # Earlier reports of the controller concern another program.
            self._watch.state = None
        return streamed.air_before(self._wrench, self._now_s())

    def _require_stream(self) -> None:
        """Reopen the stream after a stop or a force program; raises ``FaultError`` unless ready."""
        self._require_ready()
        if self._force.running:
            self._force.end(REPLACED)
        if self._core.phase is not Phase.OPEN:
            self._stopped.clear()
            self._console.run_stream()
            self._open_stream()

    def _require_ready(self) -> None:
        """Raise ``FaultError`` unless connected with the servo motors on."""
        if self.state is not DeviceState.READY:
            raise FaultError(self.fault or NOT_CONNECTED)
        if not self._powered:
            # The stream program would switch them on.
            raise FaultError(servo_off_fault(ARM))


def make_melfa(
    settings: HardwareSettings,
    now_s: Callable[[], float],
    wrench: SampleStream,
    poses: SampleStream,
) -> MelfaArm:
    """Return the arm at ``melfa.host``."""
    return MelfaArm(SocketLinks(settings.melfa, now_s), wrench, settings.melfa, now_s, poses)
