"""The contract of an arm, asked of the driver for Universal Robots; and what that arm alone has."""

import inspect
import math
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from tests.backend.devices import contract_bench, test_arm_contract
from tests.backend.devices.ur.stand_in import UrWires, hand_leaning
from tests.backend.devices.waiting import until
from touchdown.backend.config.hardware import ForceTorqueSettings, HardwareSettings
from touchdown.backend.core import FaultError, Pose, RefusedError, SampleStream
from touchdown.backend.devices.factories import make_arm, make_force_torque
from touchdown.backend.devices.force_torque.reader import WrenchStamper
from touchdown.backend.devices.protocols import DeviceState, RobotMode, SafetyMode
from touchdown.backend.devices.ur import driver as ur_arm
from touchdown.backend.devices.ur import rtde
from touchdown.backend.devices.ur.driver import UrArm
from touchdown.backend.devices.ur.rtde import SAMPLE, UrWrenchDriver
from touchdown.backend.simulation.devices.bench import SimulatedBench

TURNING = ("turn", "joint")
CLAUSES = [
    clause
    for name, clause in vars(test_arm_contract).items()
    if name.startswith("test_")
    and list(inspect.signature(clause).parameters) == ["bench"]
    and not any(word in name for word in TURNING)
]
NAMES = [clause.__name__.removeprefix("test_") for clause in CLAUSES]


@pytest.fixture
def wires():
    return UrWires(SimulatedBench(contract_bench._scene(contract_bench.FEW_HZ)))


@pytest.fixture
def bench(wires):
    still = {"still_s": 0.3, "still_mm": 0.05}
    yield contract_bench.devices_of(wires.bench, wires.arm, wires.advance, **still)
    wires.arm.close()
    until(lambda: not any(t.name == "ur-stop" for t in threading.enumerate()))


@pytest.mark.parametrize("clause", CLAUSES, ids=NAMES)
def test_it_keeps_the_contract_of_an_arm(clause, bench):
    clause(bench)


def test_most_of_the_contract_is_asked():
    assert len(CLAUSES) >= 10


def test_commands_leave_from_where_the_arm_is_and_never_leap(bench, wires):
    bench.connect()
    begun_m = wires.robot.place_m.copy()
    here = bench.arm.pose(1.0)
    bench.finish(bench.arm.move_to(Pose(here.x_mm + 20.0, here.y_mm, here.z_mm + 10.0), 50.0))
    told = np.array([pose for _, pose in wires.robot.commands])
    assert np.linalg.norm(told[0, :3] - begun_m) < 1e-3
    assert np.linalg.norm(np.diff(told[:, :3], axis=0), axis=1).max() <= 50.0 * 0.008 * 1e-3 + 1e-6
    assert np.allclose(told[:, 3:], told[0, 3:])
    assert np.linalg.norm(told[-1, :3] - begun_m) == pytest.approx(math.hypot(20, 10) * 1e-3)


def test_the_controller_is_told_its_tool_and_keeps_hearing(bench, wires):
    bench.connect()
    bench.rest(0.4)
    assert wires.robot.tcp == [0.0, 0.0, 0.2, 0.0, 0.0, 0.0]
    assert wires.robot.kicks == pytest.approx(50, abs=2)
    assert wires.robot.commands == []


def test_stop_that_comes_while_a_move_is_being_ordered_is_not_forgotten(bench, monkeypatch):
    bench.connect()
    here, settle = bench.arm.pose(1.0), rtde.StopConnection.settle

    def stopped_meanwhile(lane, limit_s):
        settled = settle(lane, limit_s)
        bench.arm.stop()
        return settled

    monkeypatch.setattr(rtde.StopConnection, "settle", stopped_meanwhile)
    with pytest.raises(FaultError, match="STOPPED"):
        bench.arm.move_to(Pose(here.x_mm + 20.0, here.y_mm, here.z_mm), 50.0)
    monkeypatch.undo()
    bench.rest(0.5)
    assert bench.arm.pose(1.0).x_mm == pytest.approx(here.x_mm, abs=0.05)
    bench.finish(bench.arm.move_to(Pose(here.x_mm + 5.0, here.y_mm, here.z_mm), 50.0))


def test_stop_goes_out_beside_everything_else_and_the_next_motion_sends_the_script_again(
    bench, wires
):
    bench.connect()
    bench.arm.jog((20.0, 0.0, 0.0), 2.0)
    bench.rest(0.3)
    robot = wires.robot
    robot.hangs = threading.Event()
    # The thread of the cycles waits in the control interface, with the lock of the arm in its hand.
    stuck = threading.Thread(target=bench.arm.cycle, args=(bench.now_s(),))
    stuck.start()
    asked_s, sent = bench.now_s(), len(robot.commands)
    bench.arm.stop()
    assert bench.arm._lane.settle(10.0)
    assert stuck.is_alive()
    assert robot.ended == [asked_s]
    assert not robot.servoing
    robot.hangs.set()
    stuck.join()
    robot.hangs = None
    bench.rest(0.05)
    assert len(robot.commands) == sent
    assert bench.arm.state is DeviceState.READY
    here = bench.arm.pose(1.0)
    bench.finish(bench.arm.move_to(Pose(here.x_mm, here.y_mm, here.z_mm + 2.0), 20.0))
    assert robot.program
    assert bench.arm.pose(1.0).z_mm == pytest.approx(here.z_mm + 2.0, abs=0.1)


def test_a_stop_that_is_not_answered_lets_nothing_move(bench, wires, monkeypatch):
    bench.connect()
    hangs = threading.Event()
    monkeypatch.setattr(wires.robot, "stop", hangs.wait)
    monkeypatch.setattr(ur_arm, "SETTLE_S", 0.01)
    bench.arm.stop()
    with pytest.raises(FaultError, match="does not answer to STOP"):
        bench.arm.jog((1.0, 0.0, 0.0), 1.0)
    hangs.set()
    bench.finish(bench.arm.jog((5.0, 0.0, 0.0), 0.2))


def broken(robot, how):
    if how == "emergency":
        robot.estop = True
    elif how == "protective":
        robot.safety = 3
    elif how == "script":
        robot.program = False
    elif how == "mute":
        robot.mute = True
    else:
        robot.connected = False


@pytest.mark.parametrize(
    ("how", "code"),
    [
        ("emergency", "HW-STOP"),
        ("protective", "UR-STOPPED"),
        ("script", "UR-STOPPED"),
        ("mute", "UR-LINK"),
        ("gone", "UR-LINK"),
    ],
)
def test_whatever_the_robot_tells_ends_the_motion_and_is_latched(bench, wires, how, code):
    bench.connect()
    motion = bench.arm.jog((20.0, 0.0, 0.0), 2.0)
    bench.rest(0.2)
    broken(wires.robot, how)
    bench.rest(0.15)
    assert motion.done
    assert (bench.arm.state, bench.arm.fault.code) == (DeviceState.FAULT, code)
    stopped = SafetyMode.HW_STOP if how == "emergency" else SafetyMode.FAULT
    assert bench.arm.status().safety_mode is stopped
    sent = len(wires.robot.commands)
    bench.rest(0.5)
    assert len(wires.robot.commands) == sent
    with pytest.raises(FaultError):
        bench.arm.jog((20.0, 0.0, 0.0), 1.0)


def test_an_arm_that_is_held_back_is_not_run_away_from(bench, wires):
    bench.connect()
    wires.robot.advance = lambda step_s: setattr(wires.robot, "told", wires.robot.told + step_s)
    bench.arm.jog((20.0, 0.0, 0.0), 2.0)
    bench.rest(1.0)
    assert bench.arm.fault.code == "UR-BEHIND"
    gone_m = np.linalg.norm(np.array(wires.robot.commands[-1][1][:3]) - wires.robot.place_m)
    assert gone_m < 0.008


def test_a_leaning_hand_and_a_barred_place_are_refused(bench, wires):
    wires.robot.rotation = hand_leaning(2.0)
    with pytest.raises(FaultError, match=r"leans 2\.0"):
        bench.arm.connect(1.0, threading.Event())
    wires.robot.rotation = hand_leaning(0.0)
    bench.connect()
    with pytest.raises(RefusedError, match="safety limits"):
        bench.arm.move_to(Pose(2000.0, 0.0, 100.0), 50.0)
    with pytest.raises(ValueError, match="turn"):
        bench.arm.move_to(Pose(0.0, 0.0, 60.0, 0.1, 0.0, 0.0), 50.0)


def test_a_retreat_waits_for_no_cycle_and_is_a_stop_where_nothing_can_move(bench, wires):
    bench.lifted_and_gripped()
    bench.arm.jog((0.0, 0.0, -20.0), 2.0)
    bench.rest(0.2)
    robot = wires.robot
    robot.hangs = threading.Event()
    stuck = threading.Thread(target=bench.arm.cycle, args=(bench.now_s(),))
    stuck.start()
    # The thread of the cycles waits with the lock of the arm in its hand.
    bench.arm.retreat()
    assert stuck.is_alive()
    robot.hangs.set()
    stuck.join()
    robot.hangs, low_mm = None, bench.arm.pose(1.0).z_mm
    bench.rest(0.5)
    assert robot.ended == []
    assert 1.0 < bench.arm.pose(1.0).z_mm - low_mm < 2.6
    bench.arm.stop()
    assert bench.arm._lane.settle(10.0)
    bench.rest(0.1)
    # The script has ended: what cannot be drawn back is stopped once more.
    sent = len(robot.commands)
    bench.arm.retreat()
    bench.rest(0.1)
    assert len(robot.commands) == sent
    bench.arm.servo(False)
    bench.arm.retreat()
    bench.rest(0.1)
    assert bench.arm.fault is None


def test_motors_go_off_and_on_over_the_dashboard(bench):
    bench.connect()
    bench.arm.servo(False)
    bench.rest(0.1)
    assert bench.arm.status().robot_mode is RobotMode.SERVO_OFF
    with pytest.raises(FaultError):
        bench.arm.jog((1.0, 0.0, 0.0), 1.0)
    bench.arm.servo(True)
    bench.finish(bench.arm.jog((5.0, 0.0, 0.0), 0.2))
    assert bench.arm.state is DeviceState.READY


def test_a_bench_file_names_it_and_its_package_is_asked_for():
    settings = HardwareSettings.model_validate({"melfa": {"driver": "ur"}})
    streams = [SampleStream("force_torque", 6, 10), SampleStream("arm", 3, 10)]
    arm = make_arm(settings, lambda: 0.0, *streams)
    assert isinstance(arm, UrArm)


@pytest.mark.optional
def test_the_package_has_what_the_driver_calls():
    control = pytest.importorskip("rtde_control").RTDEControlInterface
    receive = pytest.importorskip("rtde_receive").RTDEReceiveInterface
    dashboard = pytest.importorskip("dashboard_client").DashboardClient
    # Names and numbers of arguments.
    called = {
        control: {"servoL": 6, "servoStop": 1, "setTcp": 1, "isPoseWithinSafetyLimits": 1,
                  "isProgramRunning": 0, "reuploadScript": 0, "setWatchdog": 1, "kickWatchdog": 0,
                  "stopScript": 0, "disconnect": 0},
        receive: {"getActualTCPPose": 0, "getTimestamp": 0, "getRobotMode": 0, "getSafetyMode": 0,
                  "isEmergencyStopped": 0, "getFtRawWrench": 0, "getSpeedScaling": 0,
                  "isConnected": 0, "disconnect": 0},
        dashboard: {"connect": 1, "getSerialNumber": 0, "getRobotModel": 0, "polyscopeVersion": 0,
                    "powerOn": 0, "brakeRelease": 0, "powerOff": 0, "stop": 0, "disconnect": 0},
    }  # fmt: skip
    for theirs, methods in called.items():
        for name, count in methods.items():
            told = (getattr(theirs, name).__doc__ or "").splitlines()[0]
            assert told.count(":") - told.count("Flags") >= count, (name, told)
    with pytest.raises(RuntimeError):
        rtde.open_robot("127.0.0.1", 125.0)


# ruff: noqa: N802


LOAD = (1.0, -2.0, -10.5, 0.1, -0.2, 0.05)
PERIOD_S = 0.002
SETTINGS = HardwareSettings.model_validate(
    {
        "ft": {"driver": "ur", "rotation": ((0, -1, 0), (1, 0, 0), (0, 0, 1)), "sign": -1},
        "ur": {"host": "robot", "rate_hz": 500.0},
    }
)


class Robot:
    """What ``rtde_receive.RTDEReceiveInterface`` tells; every sample trembles a little."""

    def __init__(self, host, rate_hz):
        assert (host, rate_hz) == ("robot", 500.0)
        self.begun_s = None
        self.halted_s = None
        self.connected, self.lacks = True, False

    def getTimestamp(self):
        now_s = time.monotonic() if self.halted_s is None else self.halted_s
        self.begun_s = now_s if self.begun_s is None else self.begun_s
        return PERIOD_S * int((now_s - self.begun_s) / PERIOD_S)

    def getFtRawWrench(self):
        if self.lacks:
            raise RuntimeError("unable to get state data for specified key: ft_raw_wrench")
        return [v + 1e-6 * (self.getTimestamp() % 1.0) for v in LOAD]

    def isConnected(self):
        return self.connected

    def disconnect(self):
        self.connected = False


@pytest.fixture
def robots(monkeypatch):
    made = []

    def receive(host, rate_hz):
        made.append(Robot(host, rate_hz))
        return made[-1]

    module = SimpleNamespace(RTDEReceiveInterface=receive)
    monkeypatch.setitem(rtde.importlib.sys.modules, "rtde_receive", module)
    return made


@pytest.fixture
def driver():
    made = make_force_torque(SETTINGS, time.monotonic)
    yield made
    made.close()


def test_it_is_read_like_any_wrist_sensor(robots, driver):
    driver.connect(5.0, threading.Event())
    until(lambda: driver.samples.count >= 40)
    samples = driver.samples.since(0)
    # Turned into tool axes, and the other way round: force by the sensor.
    wanted = [-2.0, -1.0, 10.5, -0.2, -0.1, -0.05]
    assert np.abs(samples.values - wanted).max() < 1e-5
    assert (np.diff(samples.t_s) > 0).all()
    # What a busy computer misses is counted: nothing of the robot's time is left out.
    robot = robots[0]
    robot.halted_s = time.monotonic()
    told = round(robot.getTimestamp() / PERIOD_S)
    until(lambda: driver.health.received + driver.health.lost == told)
    assert driver.identity.model == "built-in F/T"
    assert driver.rated.tolist() == [50.0, 50.0, 50.0, 10.0, 10.0, 10.0]


@pytest.mark.parametrize("how", ["mute", "gone", "old"])
def test_a_robot_that_tells_nothing_is_a_fault(robots, driver, how):
    driver.connect(5.0, threading.Event())
    robot = robots[0]
    if how == "old":
        robot.lacks = True
    else:
        robot.halted_s = time.monotonic()
        robot.connected = how == "mute"
    until(lambda: driver.state is DeviceState.FAULT)
    assert driver.fault.code == "FT-LINK"
    words = {"mute": "silent", "gone": "closed the connection", "old": "tells no wrench"}
    assert words[how] in driver.fault.what


def test_without_the_package_it_says_so(driver, monkeypatch):
    monkeypatch.setitem(rtde.importlib.sys.modules, "rtde_receive", None)
    with pytest.raises(FaultError, match="'ur_rtde' is not installed"):
        driver.connect(1.0, threading.Event())


def test_a_gap_in_the_time_of_the_robot_is_counted_and_the_end_of_its_range_told():
    language = UrWrenchDriver(SETTINGS, "rtde://robot")
    told = [SAMPLE.pack(t_s, *LOAD) for t_s in (5.0, 5.002, 5.010, 5.012)]
    assert [reading.missed for data in told for reading in language.take(data)] == [0, 0, 3, 0]
    readout = WrenchStamper(ForceTorqueSettings(), 0.002, rated=SETTINGS.ur.rated)
    readings = language.take(SAMPLE.pack(5.014, 0.0, 0.0, -50.0, 0.0, 0.0, 0.0))
    assert np.isnan(readout.accept(1.0, readings)[1]).all()
    assert readout.overload == "Fz = -50.00 N, rated 50"
    assert language.take(SAMPLE.pack(5.016, float("nan"), *LOAD[1:])) == []
    assert language.refusals.in_a_row == 1
