"""Driver of a Universal Robots arm."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping

import numpy as np

from touchdown.backend.config import UrSettings
from touchdown.backend.core import (
    LEVEL_RAD,
    Fault,
    FaultError,
    FloatArray,
    Pose,
    RefusedError,
    SampleStream,
    rotation_angle_rad,
)
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
    RobotMode,
    SafetyMode,
    Steps,
    Vector,
    servo_off_fault,
)
from touchdown.backend.devices.streamed import (
    ARM,
    NOT_CONNECTED,
    STOPPED,
    ArmPress,
    Loop,
    MeasuredPlaces,
    StreamedOrders,
    Travel,
    air_before,
)
from touchdown.backend.devices.ur.rtde import (
    REDUCED,
    RUNNING,
    Interfaces,
    OpenRobot,
    StopLane,
    Watch,
    identity_of,
    leaning_fault,
    link_fault,
    open_robot,
    robot_fault,
)
from touchdown.backend.devices.ur.servo import Placing, ServoCore, lean_rad

NO_TURNS = "this arm does not turn its hand"


class LevelHand:
    """The part of an arm that turns nothing: all of it raises ``ValueError``."""

    rotates = False
    joint_limits_rad: tuple[tuple[float, float], ...] = ()

    def refuse_turning(self, turn_rad_s: Vector) -> None:
        """Raise for any turn."""
        if any(turn_rad_s):
            raise ValueError(NO_TURNS)

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


def words_of(robot: Interfaces | None, fault: Fault | None, *, moving: bool) -> ArmStatus:
    """Return the status words; ``robot`` is None while there is no connection."""
    if robot is None:
        return ArmStatus(RobotMode.DISCONNECTED, SafetyMode.UNKNOWN, 0.0, 0)
    mode = RobotMode.MOVING if moving else RobotMode.READY
    if robot.receive.getRobotMode() != RUNNING:
        mode = RobotMode.SERVO_OFF
    safety = SafetyMode.NORMAL
    if fault is not None:
        safety = SafetyMode.HW_STOP if fault.code == "HW-STOP" else SafetyMode.FAULT
    elif robot.receive.getSafetyMode() == REDUCED:
        safety = SafetyMode.REDUCED
    return ArmStatus(mode, safety, robot.receive.getSpeedScaling(), 0)


BRAKE_M_S2 = 2.0
SERVO_ON_S = 30.0
LOOK_S = 0.05
SETTLE_S = 1.0
"""A stop that was asked for is answered within this, or nothing moves."""
AXES = ("x_mm", "y_mm", "z_mm")


class UrArm(LevelHand):
    """``wrench``: the untared samples of the wrist sensor, in the axes of the bench."""

    name = ARM

    def __init__(
        self,
        settings: UrSettings,
        now_s: Callable[[], float],
        wrench: SampleStream,
        poses: SampleStream | None = None,
        open_with: OpenRobot = open_robot,
    ) -> None:
        self._settings, self._now_s, self._open = settings, now_s, open_with
        self._wrench, self._cursor = wrench, 0
        self._measured = MeasuredPlaces(now_s, poses)
        self.poses = self._measured.poses
        """Measured position of ``G``, mm in the bench, once per cycle."""
        self._placing, self._cycle_s = Placing(settings), 1.0 / settings.rate_hz
        self._orders = StreamedOrders(
            Loop(
                self._cycle_s,
                arm_lag_s=1e-3 * settings.arm_lag_ms,
                sensor_lag_s=1e-3 * settings.sensor_lag_ms,
            )
        )
        self._core = ServoCore()
        self._robot: Interfaces | None = None
        self._rotation = np.zeros(3)
        self._lock = threading.Lock()
        self._stop_asked, self._ends, self._stops = threading.Event(), threading.Event(), 0
        self._retreat_asked = threading.Event()
        self._thread: threading.Thread | None = None
        self._lane: StopLane | None = None
        self._script_ended = False
        self._servoing = False
        self._watch = Watch(-math.inf)
        self.steps = Steps()
        self.state = DeviceState.CLOSED
        """Where the connection is in its life."""
        self.identity: Identity | None = None
        """Known once connected."""
        self.fault: Fault | None = None

    # -- connection -------------------------------------------------------------------------------

    @property
    def health(self) -> Health:
        """Rate of measured positions over the last second, age of the newest, counts."""
        return self._measured.health(self._watch.late)

    def describe(self) -> Mapping[str, str | float]:
        """Return model, commanded place, and cycles without news."""
        place = dict(zip(AXES, self._core.command_mm.tolist(), strict=True))
        model = self.identity.model if self.identity else "Universal Robots"
        return {"kind": model, **place, "late": self._watch.late}

    def connect(self, timeout_s: float, cancel: threading.Event) -> None:
        """Connect, take the place of the arm, and begin the servo cycles; nothing moves."""
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
        """Brake, end the script; the gripper stays as it is."""
        with self._lock:
            self._core.end(STOPPED)
        self._drop()
        self.state = DeviceState.CLOSED

    def servo(self, on: bool) -> None:
        """Switch the motors over the dashboard; on takes seconds."""
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
        while robot.receive.getRobotMode() != RUNNING and self._now_s() <= end_s:
            never.wait(LOOK_S)
        if robot.receive.getRobotMode() != RUNNING:
            raise FaultError(robot_fault("The motors do not come on"))
        with self._lock:
            self._send_script(robot)

    def _send_script(self, robot: Interfaces) -> None:
        robot.control.reuploadScript()
        robot.control.setWatchdog(self._settings.watchdog_hz)
        self._core.begin(self._place_mm(robot))
        self._script_ended = False

    def _begin(self) -> None:
        robot = self._robot = self._open(self._settings.host, self._settings.rate_hz)
        self.steps.reached("reach")
        self.identity = identity_of(robot.dashboard, self._settings.host)
        self.steps.reached("identify")
        robot.control.setTcp([0.0, 0.0, 1e-3 * self._settings.tool_mm, 0.0, 0.0, 0.0])
        robot.control.setWatchdog(self._settings.watchdog_hz)
        pose = np.array(robot.receive.getActualTCPPose())
        self._rotation = pose[3:]
        lean = lean_rad(self._rotation)
        if lean > LEVEL_RAD:
            raise FaultError(leaning_fault(math.degrees(lean)))
        self._core.begin(self._placing.pivot_mm(pose))
        self.steps.reached("configure")
        self._cursor = self._wrench.count
        self._measured.begin()
        self._watch = Watch(self._now_s())
        self._stop_asked.clear()
        self._retreat_asked.clear()
        self._script_ended = False
        self._lane = StopLane(robot.stopper)
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
        """Keep the rate; a cycle that comes late is not made up for."""
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

    # -- one cycle, on the thread that owns the control interface ---------------------------------

    def cycle(self, now_s: float) -> None:
        """Measure, decide, command; a fault stops the arm and is latched."""
        if (robot := self._robot) is None:
            return
        with self._lock:
            try:
                self._look(robot, now_s)
                if self._stop_asked.is_set():
                    self._take_stop(robot)
                elif self.fault is None:
                    self._command(robot, now_s)
                robot.control.kickWatchdog()
            except (FaultError, RuntimeError) as error:
                self._fail(robot, error)

    def _fail(self, robot: Interfaces, error: FaultError | RuntimeError) -> None:
        if self._stop_asked.is_set():
            # The stop has overtaken this cycle: what the controller refused is what was stopped.
            self._take_stop(robot)
        elif isinstance(error, FaultError):
            self._latch(robot, error.fault)
        else:
            self._latch(robot, link_fault(f"The robot does not answer: {error}."))

    def _take_stop(self, robot: Interfaces) -> None:
        """Take note, with the lock held, that STOP has gone out."""
        self._stop_asked.clear()
        self._retreat_asked.clear()
        self._core.end(STOPPED)
        self._servoing, self._script_ended = False, True

    def _look(self, robot: Interfaces, now_s: float) -> None:
        """Take what the robot tells; raise the fault that it tells of."""
        if self._watch.has_news(robot.receive, now_s):
            self._core.measured_mm = self._place_mm(robot)
            self._measured.put(now_s, self._core.measured_mm)
        if self.fault is None:
            self._watch.require_healthy(robot.receive, now_s)

    def _command(self, robot: Interfaces, now_s: float) -> None:
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

    def _place_mm(self, robot: Interfaces) -> FloatArray:
        return self._placing.pivot_mm(np.array(robot.receive.getActualTCPPose()))

    def _still(self, robot: Interfaces) -> None:
        if self._servoing:
            self._servoing = False
            robot.control.servoStop(BRAKE_M_S2)

    def _latch(self, robot: Interfaces, fault: Fault) -> None:
        self._core.end(fault)
        self.fault = self.fault or fault
        if self.state is DeviceState.READY:
            self.state = DeviceState.FAULT
        try:
            self._still(robot)
        except RuntimeError:
            return  # nobody hears it: the watchdog of the controller stops the arm

    # -- state ------------------------------------------------------------------------------------

    def status(self) -> ArmStatus:
        """Return the status words."""
        return words_of(self._robot, self.fault, moving=self._core.moving)

    def pose(self, max_age_s: float) -> Pose:
        """Return the measured pose; raises ``StaleSampleError`` if it is older."""
        return Pose(*self._measured.latest_mm(max_age_s))

    # -- motion -----------------------------------------------------------------------------------

    def move_to(
        self, target: Pose, speed_mm_s: float, turn_rad_s: float = TURN_RAD_S
    ) -> CommandedMotion:
        """Move straight to ``target``; ValueError for a turn or a senseless number."""
        goal = np.array([target.x_mm, target.y_mm, target.z_mm])
        if not (np.isfinite(goal).all() and 0.0 < speed_mm_s < math.inf):
            raise ValueError("target and speed must be finite, the speed positive")
        if not rotation_angle_rad(target) <= LEVEL_RAD:
            raise ValueError(NO_TURNS)
        robot = self._require_ready()
        with self._lock:
            if not robot.control.isPoseWithinSafetyLimits(self._placing.pose(goal, self._rotation)):
                raise RefusedError("SAFETY-PLANE", "The robot's own safety limits bar this place.")
            place = dict(zip(AXES, goal.tolist(), strict=True))
            motion = CommandedMotion({**place, "speed_mm_s": speed_mm_s})
            self._orders.leave()
            self._core.run(Travel(motion, goal, speed_mm_s))
            return motion

    def jog(
        self, velocity_mm_s: Vector, for_s: float, turn_rad_s: Vector = STILL
    ) -> CommandedMotion:
        """Follow a velocity for ``for_s``; a renewal goes on without a jerk."""
        velocity = np.array(velocity_mm_s)
        if not (np.isfinite(velocity).all() and 0.0 < for_s < math.inf):
            raise ValueError("velocity and time must be finite, the time positive")
        self.refuse_turning(turn_rad_s)
        self._require_ready()
        with self._lock:
            return self._orders.follow(self._core, velocity, self._now_s() + for_s)

    def press(self, command: PressCommand) -> ArmPress:
        """Press compliantly from here straight down."""
        self._require_ready()
        before = air_before(self._wrench, self._now_s())
        with self._lock:
            return self._orders.press(self._core, command, before)

    def unload(self, force_n: float, speed_mm_s: float) -> CommandedMotion:
        """Rise until the press force is ``force_n``."""
        self._require_ready()
        with self._lock:
            return self._orders.unload(self._core, force_n, speed_mm_s)

    def halt(self) -> None:
        """Brake and stand still, ready for the next motion."""
        with self._lock:
            self._core.halt()

    def retreat(self) -> None:
        """Draw back from what the arm touches, from the next cycle on; what cannot move is stopped.

        Waits for no lock: the thread of the cycles may hold it while the robot is slow to answer.
        """
        if self.state is not DeviceState.READY or self._script_ended or self._stop_asked.is_set():
            self.stop()
            return
        self._retreat_asked.set()
        if (program := self._core.program) is not None:
            program.motion.end(STOPPED)

    def stop(self) -> None:
        """Stop on a connection of its own; in every state, from any thread, waiting for nothing."""
        self._stops += 1
        self._stop_asked.set()
        if (lane := self._lane) is not None:
            lane.press()
        if (program := self._core.program) is not None:
            program.motion.end(STOPPED)

    def _require_link(self) -> Interfaces:
        if self._robot is None or self.state is not DeviceState.READY:
            raise FaultError(self.fault or NOT_CONNECTED)
        return self._robot

    def _require_ready(self) -> Interfaces:
        stops, robot = self._stops, self._require_link()
        if robot.receive.getRobotMode() != RUNNING:
            raise FaultError(servo_off_fault(ARM))
        if self._lane is not None and not self._lane.settle(SETTLE_S):
            raise FaultError(link_fault("The robot does not answer to STOP."))
        with self._lock:
            if self._stops != stops:  # it came after the order: it is not to be forgotten
                raise FaultError(STOPPED)
            if self._stop_asked.is_set():
                self._take_stop(robot)
            if self._script_ended:
                self._send_script(robot)
        return robot
