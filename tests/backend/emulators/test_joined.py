"""The emulated devices around one scene: what the arm carries is felt, held, seen and let go."""

import numpy as np
import pytest

from backend.assembly import SimulatedBenchChoice, make_scene
from backend.config.hardware import HardwareSettings
from backend.devices.melfa.orders import Orders
from backend.emulators.joined import LATENCY_S, BenchFrame, JoinedScene, JoinedWsg
from backend.emulators.melfa_controller import READY_RAD
from backend.objects.catalogue import load_catalogue
from backend.runs.requests import SceneChoice
from backend.wire import wsg_binary

MELFA = HardwareSettings().melfa


class Bench:
    """World and gripper, stepped by hand."""

    def __init__(self):
        settings = SimulatedBenchChoice(preset="quiet").settings()
        scene = make_scene(load_catalogue(), SceneChoice("pot", ("short",), 3), settings)
        self.joined = JoinedScene(scene, MELFA)
        self.gripper = JoinedWsg(self.joined)

    def pass_time(self, seconds):
        for _ in range(round(seconds / 0.01)):
            self.joined.step()
            self.gripper.due(1e-6 * self.joined.world.now_us)

    def order(self, request):
        now_s = 1e-6 * self.joined.world.now_us
        self.gripper.receive(now_s, wsg_binary.encode_request(request))

    def felt_n(self):
        """Mean Fz of the last 0.2 s, as the sensor asks for it."""
        now_s = 1e-6 * self.joined.world.now_us + LATENCY_S
        return np.mean([self.joined.wrench(now_s - 0.001 * k)[2] for k in range(200)])

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
    """The driver's closed form and the emulator's numeric one."""
    settings = HardwareSettings.model_validate({"melfa": {"yaw_deg": yaw_deg}}).melfa
    frame, placing = BenchFrame(settings), Orders(settings).placing
    for place in ([0.0, 0.0, 30.0], [40.0, -60.0, 120.0]):
        joints = frame.joints(np.array(place))
        assert frame.pivot_mm(joints) == pytest.approx(place, abs=1e-5)
        assert placing.pivot_mm(joints) == pytest.approx(place, abs=1e-5)
        assert placing.joints(np.array(place), READY_RAD) == pytest.approx(joints, abs=1e-6)


def test_the_piece_is_taken_with_its_weight_and_let_go(bench):
    bench.pass_time(0.3)
    empty_n = bench.felt_n()
    assert bench.joined.world.holding is None
    bench.held()
    holding = bench.joined.world.holding
    assert holding is not None
    assert holding.gripping.grip_force_n == pytest.approx(10.0, abs=1.0)
    assert bench.felt_n() - empty_n == pytest.approx(holding.weight_g[2], abs=0.05)
    bench.order(wsg_binary.release(60.0, 50.0))
    bench.pass_time(0.5)
    assert bench.joined.world.holding is None
    assert bench.gripper.jaws.part_mm is None


def test_the_world_goes_where_the_joints_are_and_a_descent_is_a_probe(bench):
    bench.held()
    world, touch_mm = bench.joined.world, bench.joined.world.holding.touch_height_mm
    place = bench.joined.pivot_mm.copy()
    for height_mm in np.arange(place[2] - 0.05, touch_mm - 0.3, -0.05):
        place[2] = height_mm
        bench.joined.melfa.controller.joints.true_rad = bench.joined.frame.joints(place)
        bench.joined.step()
    assert world.drive.command_mm == pytest.approx(place, abs=1e-4)
    assert world.holding.probe == 1
    assert world.holding.press_n > 1.0
    assert bench.felt_n() > -14.7 + world.holding.weight_g[2]


def test_a_picture_is_given_once(bench):
    bench.pass_time(0.1)
    assert bench.joined.picture("left").shape == (240, 320, 3)
    assert bench.joined.picture("left") is None
