"""The first press in process and over the emulated wires, with a manual clock."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.backend.bench.wound import WoundWires, bursts, force_apart, simulated_press
from touchdown.backend.bench import EmulatedScene, SimulatedBenchChoice, make_scene
from touchdown.backend.bench.emulated_scene import (
    LATENCY_S,
    REST_ROWS,
    BenchFrame,
    DriverMonitor,
    SceneDynpick,
    SceneWsg,
    TruthServer,
)
from touchdown.backend.config import HardwareSettings, MelfaSettings, SimulationSettings
from touchdown.backend.devices.dynpick import protocol
from touchdown.backend.devices.dynpick.emulator import SENSITIVITY
from touchdown.backend.devices.dynpick.protocol import DynpickCommand
from touchdown.backend.devices.melfa.driver import MelfaPrograms
from touchdown.backend.devices.melfa.emulated_controller import READY_RAD, SPEEDS_RAD_S
from touchdown.backend.devices.melfa.emulator import EmulatedMelfa
from touchdown.backend.devices.melfa.realtime_protocol import (
    CYCLE_S,
    AxisValues,
    BlockKind,
    MxtCommand,
    MxtRequest,
    encode_mxt_request,
)
from touchdown.backend.devices.wsg import protocol as wsg_binary
from touchdown.backend.devices.wsg import protocol as wsg_protocol
from touchdown.backend.devices.wsg.emulator import EmulatedWsg
from touchdown.backend.devices.wsg.protocol import GraspState
from touchdown.backend.devices.wsg.protocol import WsgCommand as Word
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.runs.requests import SceneChoice

NEARLY_WITHOUT_NOISE = SimulationSettings.model_validate(
    {"wrist": {"white_n": 0.01, "white_nm": 0.0004}}
)


def test_a_world_that_falls_behind_bends_no_press():
    """Delays of up to 60 ms. The rest is the damping required by the delay of the loop."""
    wanted = simulated_press(306, NEARLY_WITHOUT_NOISE)
    found = WoundWires(306, NEARLY_WITHOUT_NOISE, bursts(0.06)).press()
    assert force_apart(wanted, found) <= 1.0
    assert found[-1] == pytest.approx(wanted[-1], rel=0.02, abs=0.05)


MELFA = HardwareSettings().melfa


class Bench:
    """World and gripper, stepped by the test."""

    def __init__(self, *, jig=False):
        settings = SimulatedBenchChoice(preset="quiet").settings()
        choice = SceneChoice("pot", ("short",), 3, jig=jig)
        scene = make_scene(load_pieces(), choice, settings)
        self.emulated = EmulatedScene(scene, MELFA)
        self.gripper = SceneWsg(self.emulated)

    def pass_time(self, seconds):
        for _ in range(round(seconds / 0.01)):
            self.emulated.step()
            self.gripper.due(1e-6 * self.emulated.world.now_us)

    def order(self, request):
        now_s = 1e-6 * self.emulated.world.now_us
        self.gripper.receive(now_s, wsg_binary.encode_request(request))

    def felt_n(self):
        """Mean Fz of the last 0.2 s as read by the sensor."""
        now_s = 1e-6 * self.emulated.world.now_us + LATENCY_S
        return np.mean([self.emulated.wrench(now_s - 0.001 * k)[2] for k in range(200)])

    def held(self):
        self.order(wsg_binary.home())
        self.pass_time(1.0)
        self.order(wsg_binary.set_force_limit(20.0))
        self.order(wsg_binary.grasp(0.0, 100.0))
        self.pass_time(1.0)


@pytest.fixture
def bench():
    return Bench()


@pytest.mark.parametrize("yaw_deg", [0.0, 30.0])
def test_both_ends_of_the_wire_place_the_bench_alike(yaw_deg):
    """The closed form of the driver and the numeric solution of the emulator agree."""
    settings = HardwareSettings.model_validate({"melfa": {"yaw_deg": yaw_deg}}).melfa
    frame, placing = BenchFrame(settings), MelfaPrograms(settings).placing
    for place in ([0.0, 0.0, 30.0], [40.0, -60.0, 120.0]):
        joints = frame.joints(np.array(place))
        assert frame.pivot_mm(joints) == pytest.approx(place, abs=1e-5)
        assert placing.pivot_mm(joints) == pytest.approx(place, abs=1e-5)
        assert placing.joints(np.array(place), READY_RAD) == pytest.approx(joints, abs=1e-6)


def test_the_piece_is_taken_with_its_weight_and_let_go(bench):
    bench.pass_time(0.3)
    empty_n = bench.felt_n()
    assert bench.emulated.world.holding is None
    bench.held()
    holding = bench.emulated.world.holding
    assert holding is not None
    assert holding.gripping.grip_force_n == pytest.approx(10.0, abs=1.0)
    assert bench.felt_n() - empty_n == pytest.approx(holding.weight_g[2], abs=0.05)
    bench.order(wsg_binary.release(60.0, 50.0))
    bench.pass_time(0.5)
    assert bench.emulated.world.holding is None
    assert bench.gripper.jaws.part_mm is None


@pytest.mark.parametrize("speed_mm_s", [5.0, 200.0])
def test_steps_of_the_jaws_reach_the_world_however_short_they_are(bench, speed_mm_s):
    bench.held()
    world, width_mm = bench.emulated.world, bench.emulated.scene.piece.width_mm
    for step, order in enumerate((wsg_binary.release, wsg_binary.preposition), 1):
        more = {} if step == 1 else {"stop_on_block": True}
        bench.order(order(width_mm + 0.1 * step, speed_mm_s, **more))
        bench.pass_time(0.2)
        assert world.jaws.width_mm == pytest.approx(width_mm + 0.1 * step, abs=0.011)
        assert (world.jaws.loosened, world.jaws.holding) == (True, False)
    assert bench.gripper.openings == 1
    assert world.holding is not None
    bench.order(wsg_binary.grasp(0.0, 100.0))
    bench.pass_time(0.5)
    assert (world.jaws.loosened, world.jaws.holding) == (False, True)
    assert world.jaws.width_mm == width_mm


def test_a_piece_that_is_lost_is_gone_from_jaws_and_world(bench):
    bench.held()
    assert bench.emulated.world.holding is not None
    bench.gripper._faults.begin(0.0)
    bench.gripper._faults.inject(1e-6 * bench.emulated.world.now_us, "part_lost", 0.1)
    bench.pass_time(0.2)
    assert bench.gripper.jaws.state is GraspState.PART_LOST
    assert bench.emulated.world.holding is None
    assert not bench.emulated.truth().stands
    bench.pass_time(0.5)
    assert bench.gripper.jaws.part_mm is None


def test_a_piece_let_go_in_its_jig_can_be_taken_again():
    bench = Bench(jig=True)
    world = bench.emulated.world
    for _ in range(2):
        bench.held()
        assert world.holding is not None
        bench.order(wsg_binary.release(60.0, 50.0))
        bench.pass_time(0.5)
        assert world.holding is None


@pytest.mark.parametrize(("jig", "again"), [(True, True), (False, False)])
def test_a_piece_let_go_high_over_a_bench_with_a_jig_is_in_the_operators_hand(jig, again):
    bench = Bench(jig=jig)
    world = bench.emulated.world
    bench.held()
    place = world.drive.command_mm + np.array([0.0, 0.0, 40.0])
    bench.emulated.melfa.controller.joints.true_rad = bench.emulated.frame.joints(place)
    bench.pass_time(0.1)
    bench.order(wsg_binary.release(60.0, 50.0))
    bench.pass_time(1.2)
    assert world.holding is None
    bench.order(wsg_binary.grasp(0.0, 100.0))
    bench.pass_time(1.0)
    assert (world.holding is not None) is again


@pytest.mark.parametrize(("jig", "again"), [(True, True), (False, False)])
def test_a_piece_that_was_put_down_is_handed_over_again_where_an_operator_is(jig, again):
    """Otherwise a rehearsal would end with the first trial."""
    bench = Bench(jig=jig)
    world = bench.emulated.world
    bench.held()

    def go(height_mm):
        place = np.array([2.0, 1.0, height_mm])
        bench.emulated.melfa.controller.joints.true_rad = bench.emulated.frame.joints(place)
        bench.pass_time(0.1)

    touch_mm = world.holding.touch_height_mm
    for height_mm in (touch_mm + 15.0, touch_mm - 0.1):
        go(height_mm)
    bench.order(wsg_binary.release(60.0, 50.0))
    bench.pass_time(1.5)
    assert world.holding is None
    assert world.truth().stands is not None
    bench.order(wsg_binary.grasp(0.0, 100.0))
    bench.pass_time(1.0)
    assert world.holding is None, "it stands below the jaws"
    bench.order(wsg_binary.release(60.0, 50.0))
    bench.pass_time(1.5)
    go(touch_mm + 15.0)
    bench.pass_time(0.5)
    bench.order(wsg_binary.grasp(0.0, 100.0))
    bench.pass_time(1.0)
    assert (world.holding is not None) is again


def test_the_world_goes_where_the_joints_are_and_a_descent_is_a_probe(bench):
    bench.held()
    world, touch_mm = bench.emulated.world, bench.emulated.world.holding.touch_height_mm
    place = world.drive.command_mm
    for height_mm in np.arange(place[2] - 0.05, touch_mm - 0.3, -0.05):
        place[2] = height_mm
        bench.emulated.melfa.controller.joints.true_rad = bench.emulated.frame.joints(place)
        bench.emulated.step()
    assert world.drive.command_mm == pytest.approx(place, abs=1e-4)
    assert world.holding.probe == 1
    assert world.holding.press_n > 1.0
    assert bench.felt_n() > -14.7 + world.holding.weight_g[2]
    felt, told = bench.emulated._felt[1][-1], bench.emulated.melfa.controller.felt()
    assert np.abs(felt[3:]).max() > 0.01
    about_z = Rotation.from_euler("z", MELFA.yaw_deg, degrees=True)
    np.testing.assert_allclose(told, about_z.apply(felt.reshape(2, 3)).ravel())


@pytest.mark.parametrize("yaw_deg", [0.0, 30.0, -110.0])
def test_the_arms_own_sensor_feels_the_same_in_axes_of_its_base(bench, yaw_deg):
    """Forces and moments; the bench is rotated by its yaw relative to the base."""
    melfa = MELFA.model_copy(update={"yaw_deg": yaw_deg})
    emulated = EmulatedScene(bench.emulated.scene, melfa)
    emulated._felt = (0.0, np.array([[1.0, -2.0, 3.0, 0.1, 0.2, -0.3]]))
    about_z = Rotation.from_euler("z", yaw_deg, degrees=True)
    told = emulated.melfa.controller.felt()
    np.testing.assert_allclose(told[:3], about_z.apply([1.0, -2.0, 3.0]))
    np.testing.assert_allclose(told[3:], about_z.apply([0.1, 0.2, -0.3]))


def test_a_late_world_is_felt_late_and_not_otherwise(bench):
    """A late world repeats no sample; afterwards all samples arrive unchanged."""
    emulated, sensor = bench.emulated, SceneDynpick(bench.emulated)
    bench.pass_time(0.1)
    told, felt = protocol.records(), []
    step = emulated.world.step
    emulated.world.step = lambda watched: felt.append(step(watched)) or felt[-1]
    sensor.receive(0.1 + LATENCY_S, DynpickCommand.START.value)

    def records(now_s):
        return [r.counts for r in told.feed(sensor.due(now_s + LATENCY_S))]

    assert len(records(0.1)) == 1
    assert records(0.17) == []
    for _ in range(7):
        emulated.step()
    late = records(0.17)
    exact = np.concatenate([sensed.wrench for sensed in felt]) * SENSITIVITY + protocol.ZERO_COUNT
    assert late == [tuple(row) for row in exact.round().astype(int).tolist()]


def test_time_that_is_given_up_is_told_with_no_older_sample(bench):
    """The same record is repeated, which the driver does not take as a measurement."""
    bench.pass_time(0.1)
    emulated = bench.emulated
    newest = emulated.wrench(0.1 + LATENCY_S)
    assert emulated.wrench(0.05 + LATENCY_S) != newest
    emulated._give_up(0.6)
    emulated.step()
    assert {emulated.wrench(t_s + LATENCY_S) for t_s in np.arange(0.2, 0.69, 0.001)} == {newest}
    assert emulated.wrench(0.71 + LATENCY_S) != newest


def test_a_late_world_takes_the_arm_where_it_was_then(bench):
    bench.held()
    emulated, controller = bench.emulated, bench.emulated.melfa.controller
    first_mm, start_s = emulated.world.drive.command_mm, 1e-6 * emulated.world.now_us
    controller.advance(start_s)
    controller.joints.command_rad = emulated.frame.joints(first_mm - [0.0, 0.0, 1.0])
    controller.advance(start_s + 0.1)
    # The first order of the emulated joints, as the settings say it.
    away_mm = np.exp(-0.02 / (1e-3 * MELFA.arm_lag_ms))
    for _ in range(2):
        emulated.step()
    assert emulated.world.drive.command_mm[2] == pytest.approx(
        first_mm[2] - 1.0 + away_mm, abs=0.02
    )
    for _ in range(8):
        emulated.step()
    assert emulated.world.drive.command_mm[2] == pytest.approx(first_mm[2] - 1.0, abs=1e-3)


def test_a_world_far_behind_takes_no_picture_of_another_time(bench):
    for _ in range(10):
        bench.emulated.step(behind_s=0.05)
    assert bench.emulated.picture("left") is None
    for _ in range(10):
        bench.emulated.step(behind_s=0.03)
    assert bench.emulated.picture("left").shape == (240, 320, 3)
    assert bench.emulated.picture("left") is None, "each is given once"


def move(joints_rad) -> bytes:
    target = AxisValues(BlockKind.JOINT, (*map(float, joints_rad), 0.0, 0.0))
    return encode_mxt_request(MxtRequest(MxtCommand.MOVE, target, (2, 0, 0, 0), 0))


@pytest.fixture
def melfa():
    made = EmulatedMelfa(MelfaSettings(), streaming=True)
    made.controller.advance(1.0)
    return made


def test_a_command_after_an_emergency_stop_is_seen_with_its_delay(melfa):
    here = melfa.controller.joints.command_rad
    assert melfa.stream.receive(1.0, move(here)) is not None
    melfa.controller.raise_error(50)
    assert DriverMonitor(melfa).observations().late_command_s == 0.0
    assert "no command after an error" in str(DriverMonitor(melfa).observations())
    melfa.stream.receive(1.25, move(here))
    melfa.stream.receive(
        1.75, encode_mxt_request(MxtRequest(MxtCommand.NONE, None, (2, 0, 0, 0), 0))
    )
    assert DriverMonitor(melfa).observations().late_command_s == pytest.approx(0.25)
    assert "250 ms after an error" in str(DriverMonitor(melfa).observations())


def test_a_step_is_seen_as_a_share_of_the_top_speed(melfa):
    here = melfa.controller.joints.command_rad.copy()
    here[0] += 0.8 * SPEEDS_RAD_S[0] * CYCLE_S
    melfa.stream.receive(1.0, move(here))
    assert DriverMonitor(melfa).observations().step_share == pytest.approx(0.8)


def test_force_counts_from_what_hangs_on_the_sensor(melfa):
    monitor = DriverMonitor(melfa)
    hanging = np.tile([0.0, 0.0, -14.7, 0.0, 0.0, 0.0], (REST_ROWS, 1))
    monitor.add_samples(hanging)
    monitor.add_samples(hanging + np.array([0.0, 3.0, 4.0, 9.0, 9.0, 9.0]))
    assert monitor.observations().force_n == pytest.approx(5.0)


def test_a_motion_asked_of_a_gripper_in_a_fault_is_seen(melfa):
    gripper = EmulatedWsg()
    gripper.closed(0.0)  # without a word: the fast stop is latched
    home = wsg_protocol.encode_request(wsg_protocol.WsgRequest(int(Word.HOME), (1,)))
    gripper.receive(0.1, home)
    assert gripper.barred == 1


def test_two_questions_in_one_packet_are_answered_line_by_line():
    class Moved:
        def command_travel(self, since_s):
            return since_s, 0.0, 2.0

    answers = TruthServer(Moved()).receive(0.0, b"after 1.5\nafter 2.5\n")
    assert [json.loads(line) for line in answers.splitlines()] == [[1.5, 0.0, 2.0], [2.5, 0.0, 2.0]]
