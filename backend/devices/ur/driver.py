"""Driver of a Universal Robots arm: straight moves, jogging, compliant presses by servo cycles.

One thread owns the control interface, which allows one caller at a time. STOP uses a separate
connection and waits neither for that thread nor for its lock; the script is sent again before the
next motion. If this program dies, the controller's watchdog stops the arm. ``ServoCore`` is one
cycle without wire or clock, from the measured pose to the next command. The hand stays level.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping

import numpy as np

from touchdown.backend.config import HardwareSettings, UrSettings
from touchdown.backend.core import (
    LEVEL_TOLERANCE_RAD,
    Fault,
    FaultError,
    FloatArray,
    Pose,
    RefusedError,
    Samples,
    SampleStream,
    rotation_angle_rad,
    rotation_from_vector,
)
from touchdown.backend.devices import streamed
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
    arm_fault,
    servo_off_fault,
)
from touchdown.backend.devices.ur import rtde

M_PER_MM = 1e-3
# Permitted lag of the arm: this time at its speed, plus a distance.
LEAD_S, LEAD_MM = 0.25, 2.0
LOOK_FOR_HOLD = (
    "Look for an obstacle and at the speed slider of the teach pendant; then press Reset."
)
STEP_MM = 1.5  # largest step of one cycle; at 125 Hz that is 187 mm/s


class UrPlacement:
    """Transform between bench (mm) and base (m): origin and turn of the bench in the arm's base."""

    def __init__(self, settings: UrSettings) -> None:
        self._origin_mm = np.array(settings.origin_mm)
        self._turn = rotation_from_vector(np.array([0.0, 0.0, math.radians(settings.yaw_deg)]))

    def pivot_mm(self, pose: FloatArray) -> FloatArray:
        """Return ``G`` (3,) in the bench frame for a pose (6,) in the base."""
        return np.asarray(self._turn.T @ (pose[:3] / M_PER_MM - self._origin_mm))

    def pose(self, pivot_mm: FloatArray, rotation: FloatArray) -> list[float]:
        """Return the pose (6,) in the base with ``G`` at this position and the hand turned by
        ``rotation``.
        """
        place = M_PER_MM * (self._origin_mm + self._turn @ pivot_mm)
        return [*place.tolist(), *rotation.tolist()]


class ServoCore:
    """Active program and command; the owner calls ``step`` once per cycle."""

    def __init__(self) -> None:
        self.program: streamed.MotionProgram | None = None
        self.command_mm, self.measured_mm = np.zeros(3), np.zeros(3)
        self._velocity_mm_s = np.zeros(3)

    def begin(self, measured_mm: FloatArray) -> None:
        """Start at the measured position."""
        self.program = None
        self.command_mm, self.measured_mm = measured_mm.copy(), measured_mm.copy()
        self._velocity_mm_s = np.zeros(3)

    def run(self, program: streamed.MotionProgram) -> None:
        """Replace the active program."""
        if self.program is not None:
            self.program.motion.end(REPLACED)
        self.program = program

    def halt(self) -> None:
        """Brake from the present speed to standstill."""
        if self.program is not None:
            self.program.motion.end(STOPPED)
            self.program = streamed.JogProgram(CommandedMotion({}), self._velocity_mm_s)

    def end(self, fault: Fault) -> None:
        """Stop at once; the command becomes the measured position."""
        if self.program is not None:
            self.program.motion.end(fault)
        self.begin(self.measured_mm)

    def step(
        self, now_s: float, cycle_s: float, measured_mm: FloatArray, samples: Samples
    ) -> FloatArray:
        """Return the command (3,) of this cycle; raises ``FaultError`` if it is not permitted.
        ``samples``: untared wrench since the last cycle.
        """
        self.measured_mm = measured_mm
        if self.program is None:
            return self.command_mm
        felt = streamed.CycleInput(
            now_s, cycle_s, self.command_mm, measured_mm, samples.t_s, samples.values[:, :3]
        )
        after_mm = self.program.next_mm(felt)
        step_mm = float(np.linalg.norm(after_mm - self.command_mm))
        if not step_mm <= STEP_MM:
            what = f"A command would be {step_mm:.1f} mm from the last one."
            raise FaultError(arm_fault("STEP", what, "Move more slowly."))
        behind_mm = float(np.linalg.norm(after_mm - measured_mm))
        if not behind_mm <= self.program.speed_mm_s * LEAD_S + LEAD_MM:
            what = f"The arm is {behind_mm:.1f} mm behind its command."
            raise FaultError(arm_fault("UR-BEHIND", what, LOOK_FOR_HOLD))
        self._velocity_mm_s = (after_mm - self.command_mm) / cycle_s
        self.command_mm = after_mm
        return after_mm


def link_fault(what: str) -> Fault:
    """Return the fault of a missing or lost connection."""
    return arm_fault(
        "UR-LINK",
        what,
        "Check cable, address and remote control of the robot, then connect it again.",
        "The controller stops the arm by itself; the gripper was not opened.",
    )


def robot_fault(what: str, code: str = "UR-STOPPED") -> Fault:
    """Return the fault that the robot reports."""
    return arm_fault(code, f"{what}.", "Clear it at the teach pendant, then connect the arm again.")


NO_TURNS = "this arm does not turn its hand"


SILENT_S = 0.1


class RobotWatchdog:
    """Watchdog of one connection from ``now_s`` on; ``late``: cycles without new data."""

    def __init__(self, now_s: float) -> None:
        self._told_s, self._told_at_s = -math.inf, now_s
        self.late = 0

    def has_news(self, receive: rtde.ReceiveInterface, now_s: float) -> bool:
        """Return True if the robot's clock has advanced since the last cycle."""
        told_s = receive.getTimestamp()
        if told_s == self._told_s:
            self.late += 1
            return False
        self._told_s, self._told_at_s = told_s, now_s
        return True

    def require_healthy(self, receive: rtde.ReceiveInterface, now_s: float) -> None:
        """Raise ``FaultError`` for silence and for faults of the robot."""
        if now_s - self._told_at_s > SILENT_S or not receive.isConnected():
            raise FaultError(link_fault("The robot tells nothing any more."))
        if receive.isEmergencyStopped():
            raise FaultError(robot_fault("An emergency stop is pressed", "HW-STOP"))
        if receive.getSafetyMode() not in (rtde.NORMAL, rtde.REDUCED):
            raise FaultError(robot_fault("The robot has stopped by itself (protective stop)"))


BRAKE_M_S2 = 2.0
SERVO_ON_S = 30.0
LOOK_S = 0.05
SETTLE_S = 1.0  # limit for the answer to a stop; without it nothing moves
AXES = ("x_mm", "y_mm", "z_mm")


class UrArm:
    """Driver of the arm; ``wrench``: untared samples of the wrist sensor in bench axes."""

    name = ARM
    rotates = False
    joint_limits_rad: tuple[tuple[float, float], ...] = ()

    def __init__(
        self,
        settings: HardwareSettings,
        now_s: Callable[[], float],
        wrench: SampleStream,
        poses: SampleStream | None = None,
        open_with: rtde.OpenRobot = rtde.open_robot,
    ) -> None:
        self._settings, self._now_s, self._open = settings.ur, now_s, open_with
        self._wrench, self._cursor = wrench, 0
        self._measured = streamed.PositionRecord(now_s, poses)
        # Measured position of ``G``, mm in the bench frame, once per cycle.
        self.poses = self._measured.poses
        self._placing, self._cycle_s = UrPlacement(settings.ur), 1.0 / settings.ur.rate_hz
        lags_s = 1e-3 * settings.ur.arm_lag_ms, 1e-3 * settings.ur.sensor_lag_ms
        self._orders = streamed.StreamedPrograms(streamed.LoopDelays(self._cycle_s, *lags_s))
        self._core = ServoCore()
        self._robot: rtde.UrConnections | None = None
        self._rotation = np.zeros(3)
        self._lock = threading.Lock()
        self._stop_asked, self._ends, self._stops = threading.Event(), threading.Event(), 0
        self._retreat_asked = threading.Event()
        self._thread: threading.Thread | None = None
        self._lane: rtde.StopConnection | None = None
        self._script_ended = False
        self._servoing = False
        self._watch = RobotWatchdog(-math.inf)
        self.steps = ConnectionSteps()
        self.state = DeviceState.CLOSED  # state of the connection
        self.identity: Identity | None = None  # None before the first connection
        self.fault: Fault | None = None

    # -- connection -------------------------------------------------------------------------------

    @property
    def health(self) -> Health:
        """Rate of measured positions over the last second, age of the newest, counts."""
        return self._measured.health(self._watch.late)

    def describe(self) -> Mapping[str, str | float]:
        """Return model, commanded position, and cycles without new data."""
        place = dict(zip(AXES, self._core.command_mm.tolist(), strict=True))
        model = self.identity.model if self.identity else "Universal Robots"
        return {"kind": model, **place, "late": self._watch.late}

    def connect(self, timeout_s: float, cancel: threading.Event) -> None:
        """Connect, read the position of the arm, and start the servo cycles; nothing moves."""
        if self.state is DeviceState.READY:
            return
        self.close()
        self.state, self.fault = DeviceState.CONNECTING, None
        self.steps.begin()
        try:
            self._begin()
        except (FaultError, RuntimeError, OSError) as error:
            self.close()
            if isinstance(error, FaultError):
                raise
            raise FaultError(link_fault(f"The robot cannot be reached: {error}.")) from error
        self.state = DeviceState.READY

    def close(self) -> None:
        """Brake and end the script; the gripper does not move."""
        with self._lock:
            self._core.end(STOPPED)
        self._drop()
        self.state = DeviceState.CLOSED

    def servo(self, on: bool) -> None:
        """Switch the servo motors by the dashboard; on takes seconds."""
        robot = self._require_link()
        if not on:
            with self._lock:
                self._core.end(servo_off_fault(ARM))
                self._still(robot)
            robot.dashboard.powerOff()
            return
        robot.dashboard.powerOn()
        robot.dashboard.brakeRelease()
        end_s, never = self._now_s() + SERVO_ON_S, threading.Event()
        while robot.receive.getRobotMode() != rtde.RUNNING and self._now_s() <= end_s:
            never.wait(LOOK_S)
        if robot.receive.getRobotMode() != rtde.RUNNING:
            raise FaultError(robot_fault("The motors do not come on"))
        with self._lock:
            self._send_script(robot)

    def _send_script(self, robot: rtde.UrConnections) -> None:
        robot.control.reuploadScript()
        robot.control.setWatchdog(self._settings.watchdog_hz)
        self._core.begin(self._place_mm(robot))
        self._script_ended = False

    def _begin(self) -> None:
        robot = self._robot = self._open(self._settings.host, self._settings.rate_hz)
        self.steps.reached("reach")
        self.identity = rtde.identity_of(robot.dashboard, self._settings.host)
        self.steps.reached("identify")
        robot.control.setTcp([0.0, 0.0, 1e-3 * self._settings.tool_mm, 0.0, 0.0, 0.0])
        robot.control.setWatchdog(self._settings.watchdog_hz)
        pose = np.array(robot.receive.getActualTCPPose())
        self._rotation = pose[3:]
        cosine = -float(rotation_from_vector(self._rotation)[2, 2])
        lean_rad = math.acos(max(-1.0, min(1.0, cosine)))
        if lean_rad > LEVEL_TOLERANCE_RAD:
            raise FaultError(streamed.tilted_fault(lean_rad, "teach pendant"))
        self._core.begin(self._placing.pivot_mm(pose))
        self.steps.reached("configure")
        self._cursor = self._wrench.count
        self._measured.begin()
        self._watch = RobotWatchdog(self._now_s())
        self._stop_asked.clear()
        self._retreat_asked.clear()
        self._script_ended = False
        self._lane = rtde.StopConnection(robot.stopper)
        self._ends = threading.Event()
        self.cycle(self._now_s())
        if self.fault is not None:
            raise FaultError(self.fault)
        self.steps.reached("first sample")
        self._start_thread()

    def _start_thread(self) -> None:
        self._thread = threading.Thread(
            target=self._run, args=(self._ends,), name="ur", daemon=True
        )
        self._thread.start()

    def _run(self, ends: threading.Event) -> None:
        """Run cycles at the rate; late cycles are skipped."""
        due_s = self._now_s()
        while not ends.is_set():
            self.cycle(self._now_s())
            due_s = max(due_s + self._cycle_s, self._now_s() - self._cycle_s)
            ends.wait(max(0.0, due_s - self._now_s()))

    def _drop(self) -> None:
        self._ends.set()
        if self._thread is not None:
            self._thread.join()
        self._thread = None
        if self._lane is not None:
            self._lane.close()
            self._lane = None
        robot, self._robot = self._robot, None
        if robot is not None:
            self._still(robot)
            robot.control.stopScript()
            robot.close()

    # -- cycle, on the thread that owns the control interface -------------------------------------

    def cycle(self, now_s: float) -> None:
        """Measure and command; a fault stops the arm and is latched."""
        if (robot := self._robot) is None:
            return
        with self._lock:
            try:
                self._look(robot, now_s)
                if self._stop_asked.is_set():
                    self._take_stop()
                elif self.fault is None:
                    self._command(robot, now_s)
                robot.control.kickWatchdog()
            except (FaultError, RuntimeError) as error:
                self._fail(robot, error)

    def _fail(self, robot: rtde.UrConnections, error: FaultError | RuntimeError) -> None:
        if self._stop_asked.is_set():
            # A stop came during this cycle: it is the reason of the controller's refusal.
            self._take_stop()
        elif isinstance(error, FaultError):
            self._latch(robot, error.fault)
        else:
            self._latch(robot, link_fault(f"The robot does not answer: {error}."))

    def _take_stop(self) -> None:
        """Handle a sent STOP; the caller holds the lock."""
        self._stop_asked.clear()
        self._retreat_asked.clear()
        self._core.end(STOPPED)
        self._servoing, self._script_ended = False, True

    def _look(self, robot: rtde.UrConnections, now_s: float) -> None:
        """Read the state of the robot; raise its fault."""
        if self._watch.has_news(robot.receive, now_s):
            self._core.measured_mm = self._place_mm(robot)
            self._measured.put(now_s, self._core.measured_mm)
        if self.fault is None:
            self._watch.require_healthy(robot.receive, now_s)

    def _command(self, robot: rtde.UrConnections, now_s: float) -> None:
        samples = self._wrench.since(self._cursor)
        self._cursor = samples.cursor
        if self._retreat_asked.is_set():
            self._retreat_asked.clear()
            if robot.control.isProgramRunning():
                self._orders.retreat(self._core)
        if not self._servoing and self._core.program is None:
            return
        if not robot.control.isProgramRunning():
            raise FaultError(robot_fault("The script on the controller has ended"))
        place_mm = self._core.step(now_s, self._cycle_s, self._core.measured_mm, samples)
        pose = self._placing.pose(place_mm, self._rotation)
        settings = self._settings
        self._servoing = True
        if not robot.control.servoL(
            pose, 0.0, 0.0, self._cycle_s, settings.lookahead_s, settings.gain
        ):
            raise FaultError(robot_fault("The robot refuses a servo command"))

    def _place_mm(self, robot: rtde.UrConnections) -> FloatArray:
        return self._placing.pivot_mm(np.array(robot.receive.getActualTCPPose()))

    def _still(self, robot: rtde.UrConnections) -> None:
        if self._servoing:
            self._servoing = False
            robot.control.servoStop(BRAKE_M_S2)

    def _latch(self, robot: rtde.UrConnections, fault: Fault) -> None:
        self._core.end(fault)
        self.fault = self.fault or fault
        if self.state is DeviceState.READY:
            self.state = DeviceState.FAULT
        try:
            self._still(robot)
        except RuntimeError:
            return  # no connection: the watchdog of the controller stops the arm

    # -- state ------------------------------------------------------------------------------------

    def status(self) -> ArmStatus:
        """Return the status."""
        if (robot := self._robot) is None:
            return ArmStatus(RobotMode.DISCONNECTED, SafetyMode.UNKNOWN, 0.0, 0)
        program = self._core.program
        moving = program is not None and not program.motion.done
        mode = RobotMode.MOVING if moving else RobotMode.READY
        if robot.receive.getRobotMode() != rtde.RUNNING:
            mode = RobotMode.SERVO_OFF
        safety = SafetyMode.NORMAL
        if self.fault is not None:
            safety = SafetyMode.HW_STOP if self.fault.code == "HW-STOP" else SafetyMode.FAULT
        elif robot.receive.getSafetyMode() == rtde.REDUCED:
            safety = SafetyMode.REDUCED
        return ArmStatus(mode, safety, robot.receive.getSpeedScaling(), 0)

    def pose(self, max_age_s: float) -> Pose:
        """Return the measured pose; raises ``StaleSampleError`` if it is older."""
        return Pose(*self._measured.latest_mm(max_age_s))

    # -- motion -----------------------------------------------------------------------------------

    def move_to(
        self, target: Pose, speed_mm_s: float, turn_rad_s: float = TURN_RAD_S
    ) -> CommandedMotion:
        """Move on a straight line to ``target``; raises ``ValueError`` for a turn or an invalid
        number.
        """
        goal = np.array([target.x_mm, target.y_mm, target.z_mm])
        if not (np.isfinite(goal).all() and 0.0 < speed_mm_s < math.inf):
            raise ValueError("target and speed must be finite, the speed positive")
        if not rotation_angle_rad(target) <= LEVEL_TOLERANCE_RAD:
            raise ValueError(NO_TURNS)
        robot = self._require_ready()
        with self._lock:
            if not robot.control.isPoseWithinSafetyLimits(self._placing.pose(goal, self._rotation)):
                raise RefusedError("SAFETY-PLANE", "The robot's own safety limits bar this place.")
            place = dict(zip(AXES, goal.tolist(), strict=True))
            motion = CommandedMotion({**place, "speed_mm_s": speed_mm_s})
            self._orders.leave()
            self._core.run(streamed.TravelProgram(motion, goal, speed_mm_s))
            return motion

    def jog(
        self, velocity_mm_s: Vector, for_s: float, turn_rad_s: Vector = STILL
    ) -> CommandedMotion:
        """Move at a velocity for ``for_s``; a renewal continues smoothly."""
        velocity = np.array(velocity_mm_s)
        if not (np.isfinite(velocity).all() and 0.0 < for_s < math.inf):
            raise ValueError("velocity and time must be finite, the time positive")
        if any(turn_rad_s):
            raise ValueError(NO_TURNS)
        self._require_ready()
        with self._lock:
            return self._orders.follow(self._core, velocity, self._now_s() + for_s)

    def joints_rad(self, max_age_s: float) -> Joints:
        """Refuse."""
        raise ValueError(NO_TURNS)

    def place_of(self, joints_rad: Joints) -> Pose:
        """Refuse."""
        raise ValueError(NO_TURNS)

    def jog_joints(self, speeds_rad_s: Joints, for_s: float) -> CommandedMotion:
        """Refuse."""
        raise ValueError(NO_TURNS)

    def move_joints(self, target_rad: Joints, speed_rad_s: float) -> CommandedMotion:
        """Refuse."""
        raise ValueError(NO_TURNS)

    def press(self, command: PressCommand) -> ArmPress:
        """Press compliantly, straight down."""
        self._require_ready()
        before = streamed.air_before(self._wrench, self._now_s())
        with self._lock:
            return self._orders.press(self._core, command, before)

    def unload(self, force_n: float, speed_mm_s: float) -> CommandedMotion:
        """Lift until the press force is ``force_n``."""
        self._require_ready()
        with self._lock:
            return self._orders.unload(self._core, force_n, speed_mm_s)

    def halt(self) -> None:
        """Brake to standstill, ready for the next motion."""
        with self._lock:
            self._core.halt()

    def retreat(self) -> None:
        """Retreat from the contact from the next cycle on; an arm that cannot move is stopped.
        Takes no lock: the thread of the cycles may hold it while the robot is slow to answer.
        """
        if self.state is not DeviceState.READY or self._script_ended or self._stop_asked.is_set():
            self.stop()
            return
        self._retreat_asked.set()
        if (program := self._core.program) is not None:
            program.motion.end(STOPPED)

    def stop(self) -> None:
        """Stop on a separate connection; in every state, from any thread, without waiting."""
        self._stops += 1
        self._stop_asked.set()
        if (lane := self._lane) is not None:
            lane.press()
        if (program := self._core.program) is not None:
            program.motion.end(STOPPED)

    def _require_link(self) -> rtde.UrConnections:
        if self._robot is None or self.state is not DeviceState.READY:
            raise FaultError(self.fault or NOT_CONNECTED)
        return self._robot

    def _require_ready(self) -> rtde.UrConnections:
        stops, robot = self._stops, self._require_link()
        if robot.receive.getRobotMode() != rtde.RUNNING:
            raise FaultError(servo_off_fault(ARM))
        if self._lane is not None and not self._lane.settle(SETTLE_S):
            raise FaultError(link_fault("The robot does not answer to STOP."))
        with self._lock:
            if self._stops != stops:  # a stop came after the command
                raise FaultError(STOPPED)
            if self._stop_asked.is_set():
                self._take_stop()
            if self._script_ended:
                self._send_script(robot)
        return robot
