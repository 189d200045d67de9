"""The stepped world: physics against closed forms and the batch vectors, truth, repeatability."""

from __future__ import annotations

import hashlib
import threading

import numpy as np
import pytest

from touchdown.backend.config.simulation import SimulationSettings
from touchdown.backend.core import FINGERS, FaultError, Pose, RawStreams, SampleStream
from touchdown.backend.devices.protocols import PressCommand
from touchdown.backend.devices.sensor_faults import PictureMonitor
from touchdown.backend.emulation.simulated_disturbances import parse_script
from touchdown.backend.geometry import Tower, load_pieces
from touchdown.backend.simulation import RESIDUAL_LIMIT, Scene
from touchdown.backend.simulation.devices.bench import SimulatedBench
from touchdown.backend.simulation.world import World

PRESS = PressCommand(1.5, 1.5, 2.0, 2.0, 1.0, 11.0, (30.0, 30.0, 15.0))
CATALOGUE = load_pieces()


class Driven:
    """A simulated bench and the few moves the tests need."""

    def __init__(self, start=(0.0, 0.0), piece="pot", bottoms=("short",), seed=5, **given):
        script = parse_script(given.pop("script", ()))
        cameras = given.pop("cameras", False)
        settings = SimulationSettings.model_validate({"preset": "off", **given})
        tower = Tower(tuple(CATALOGUE.bottom(name).body() for name in bottoms))
        self.bench = SimulatedBench(
            Scene(CATALOGUE.top(piece), tower, start, seed, settings), script
        )
        for name, device in self.bench.devices.items():
            if cameras or not name.startswith("tactile"):
                device.connect(1.0, threading.Event())
        self.arm, self.gripper = self.bench.arm, self.bench.gripper

    def rest(self, seconds, step_us=10_000):
        for _ in range(round(seconds * 1e6 / step_us)):
            self.bench.advance(step_us)

    def finish(self, motion, step_us=10_000):
        for _ in range(6_000):
            if motion.done:
                break
            self.bench.advance(step_us)
        motion.result()
        return motion

    def grip(self):
        self.finish(self.gripper.grip(10.0))
        self.rest(0.3)
        return self

    def press(self):
        return self.finish(self.arm.press(PRESS))

    def move(self, dx=0.0, dy=0.0, dz=0.0, speed=20.0):
        here = self.arm.pose(0.1)
        target = Pose(here.x_mm + dx, here.y_mm + dy, here.z_mm + dz)
        return self.finish(self.arm.move_to(target, speed))

    def release(self):
        self.finish(self.arm.unload(1.0, 2.0))
        self.rest(0.2)
        self.finish(self.gripper.open_to(self.gripper.status().width_mm + 4.0, 5.0))

    def wrench(self, seconds=0.05):
        now = self.bench.clock.now_s()
        return self.bench.force_torque.samples.window(now - seconds, now).values.mean(axis=0)

    def digest(self):
        seen = hashlib.sha256()
        for finger in FINGERS:
            for frame in self.bench.tactile[finger].frames.since(0)[0]:
                seen.update(f"{frame.sequence} {frame.t_s!r}".encode())
                seen.update(frame.image.tobytes())
        for stream in (self.bench.force_torque.samples, self.arm.poses):
            samples = stream.since(0)
            seen.update(samples.t_s.tobytes() + samples.values.tobytes())
        return seen.hexdigest()


def test_in_air_the_wrist_carries_gripper_and_piece_only():
    driven = Driven()
    driven.rest(0.1)
    gripper = driven.wrench()
    assert gripper == pytest.approx([0, 0, -1.5 * 9.80665, 0, 0, 0], abs=1e-9)
    driven.grip()
    piece = driven.wrench() - gripper
    assert piece == pytest.approx([0, 0, -0.015 * 9.80665, 0, 0, 0], abs=1e-9)


@pytest.mark.parametrize(
    ("piece", "bottom", "start", "force", "torque"),
    [
        ("mushroom", "circle15", (0.0, 0.0), (0.0, 0.0, 7.815), (0.0, 0.0)),
        ("mushroom", "circle15", (9.0, 0.0), (0.794, 0.0, 7.699), (0.0, -0.0943)),
        ("mushroom", "circle15", (7.0, 7.0), (0.589, 0.795, 7.692), (0.0918, -0.0699)),
        ("pot", "circle25", (0.0, 12.0), (0.0, 0.478, 7.779), (0.0550, 0.0)),
    ],
)
def test_a_press_ends_at_the_published_equilibrium(piece, bottom, start, force, torque):
    driven = Driven(start, piece, (bottom,)).grip()
    air = driven.wrench()
    motion = driven.press()
    felt = driven.wrench() - air
    # Steps of 10 ms instead of 100 ms and an onset found in samples instead of known: 1 %.
    assert felt[:3] == pytest.approx(force, abs=0.05)
    assert felt[3:5] == pytest.approx(torque, abs=0.006)
    holding = driven.bench._world.holding
    assert holding is not None
    assert holding.residual < RESIDUAL_LIMIT
    # Robot and gel share the 1.5 mm as springs of 15 and 8 N/mm in series.
    here = driven.arm.pose(0.1)
    assert here.z_mm - holding.touch_height_mm == pytest.approx(-1.5 + felt[2] / 15.0, abs=0.02)
    assert motion.onset_s == pytest.approx(0.9 + 1.5, abs=0.02)


def test_markers_move_by_the_published_field():
    driven = Driven((9.0, 0.0), "mushroom", ("circle15",)).grip()
    driven.press()
    left, right = driven.bench._world._field_px
    assert left[31] == pytest.approx((1.71, -16.59), abs=0.12)
    assert right[31] == pytest.approx((-1.71, -16.59), abs=0.12)


def test_lifting_brings_everything_back():
    driven = Driven((5.0, 2.0)).grip()
    air, start = driven.wrench(), driven.arm.pose(0.1)
    driven.press()
    driven.move(dz=3.0)
    driven.rest(0.1)
    assert driven.wrench() == pytest.approx(air, abs=1e-9)
    assert np.abs(driven.bench._world._field_px).max() < 1e-9
    # The measured pose is that of the compliant arm: a press shifts it by the lateral force.
    assert driven.arm.pose(0.1).x_mm == pytest.approx(start.x_mm, abs=0.05)


def test_the_same_commands_give_the_same_bytes_however_time_is_wound():
    digests = set()
    for step_us in (10_000, 70_000, 30_000):
        driven = Driven((6.0, 1.0), preset="mixed", seed=3, cameras=True)
        grip = driven.gripper.grip(10.0)
        driven.rest(1.05, step_us)
        assert grip.done
        driven.arm.press(PRESS)
        driven.rest(2.1, step_us)
        digests.add(driven.digest())
    assert len(digests) == 1
    other = Driven((6.0, 1.0), preset="mixed", seed=4, cameras=True)
    other.rest(0.2)
    same = Driven((6.0, 1.0), preset="mixed", seed=3, cameras=True)
    same.rest(0.2)
    assert other.digest() != same.digest()


def test_a_bench_at_rest_is_advanced_at_once_and_gives_the_same_bytes(monkeypatch):
    steps, step = [], World.step
    monkeypatch.setattr(
        World, "step", lambda world, seen, n: steps.append(n) or step(world, seen, n)
    )
    digests, air = [], []
    for step_us in (10_000, 100_000):
        driven = Driven((6.0, 1.0), preset="hard", seed=3, cameras=True)
        driven.rest(1.0, step_us)
        steps.append(0)
        driven.finish(driven.gripper.grip(10.0), 10_000)
        driven.press()
        driven.rest(0.5, step_us)
        driven.release()
        driven.rest(0.3, step_us)
        digests.append((driven.digest(), driven.gripper.status()))
        air.append(driven.bench._world._recent_n)
    assert digests[0] == digests[1]
    assert air[0] == air[1]
    first = len(steps) - 1 - steps[::-1].index(0)
    assert steps[first - 10 : first] == [10] * 10
    assert set(steps[first + 1 :]) == {1, 10}, "single cycles while a piece is held"
    failing = Driven(script=("force_torque:stop@0.05",))
    assert not failing.bench.rests()


def test_a_picture_is_made_when_it_is_read():
    driven = Driven(cameras=True)
    driven.rest(0.2)
    frames = driven.bench.tactile["left"].frames.since(0)[0]
    assert len(frames) >= 4
    assert not any(frame.made for frame in frames)
    image = frames[1].image
    assert [frame.made for frame in frames[:3]] == [False, True, False]
    assert image is frames[1].image
    assert not image.flags.writeable
    monitor = PictureMonitor("left", driven.bench.tactile["left"].frames)
    driven.rest(0.4)
    assert monitor.check() is None
    assert not any(frame.made for frame in driven.bench.tactile["left"].frames.since(6)[0])
    frozen = Driven(cameras=True, script=("tactile_left:freeze@0.1",))
    monitor = PictureMonitor("left", frozen.bench.tactile["left"].frames)
    frozen.rest(0.4)
    assert monitor.check().code == "CAMERA-FROZEN"


def test_odd_steps_wind_the_clock_exactly():
    driven = Driven()
    for step_us in (1, 9_998, 3, 12_345, 7):
        driven.bench.advance(step_us)
    assert driven.bench.clock.now_us == 22_354
    assert driven.arm.poses.since(0).t_s == pytest.approx([0.01, 0.02])


def test_start_is_the_true_offset_whatever_the_nuisances():
    for seed in range(5):
        driven = Driven((4.0, -3.0), preset="hard", seed=seed)
        before = driven.bench.truth()
        driven.grip()
        after = driven.bench.truth()
        assert before.offset_mm == (4.0, -3.0)
        assert after.offset_mm == pytest.approx((4.0, -3.0), abs=1e-12)
        assert after.stands is None


def test_grasp_offset_moves_the_piece_and_the_label_keeps_the_command():
    driven = Driven((4.0, -3.0), preset="hard", seed=1).grip()
    holding = driven.bench._world.holding
    assert holding is not None
    g_x = holding.gripping.grasp_offset_mm[0]
    p_x, p_y = holding.mounting.print_offset_mm
    assert abs(g_x) > 0.05
    assert driven.arm.pose(0.1).x_mm == pytest.approx(4.0 + g_x + p_x)
    assert driven.arm.pose(0.1).y_mm == pytest.approx(-3.0 + p_y)


def test_sensor_errors_of_a_probe_come_after_the_reference_and_end_with_it():
    wrist = {"offset_n": 0.5, "offset_nm": 0.02}
    driven = Driven(tactile={"bias_px": 0.4}, wrist=wrist).grip()
    air = driven.wrench()
    motion = driven.arm.press(PRESS)
    driven.rest(0.5)
    first = driven.wrench() - air
    assert np.abs(first[:3]).max() > 0.1
    assert np.abs(driven.bench._world._bias_px(0)).max() > 0.01
    driven.finish(motion)
    driven.move(dz=3.0)
    driven.rest(0.2)
    assert driven.wrench() == pytest.approx(air, abs=1e-9)
    driven.arm.press(PRESS)
    driven.rest(0.3)
    assert np.abs(driven.wrench() - air - first).max() > 0.1


def test_slip_stays_until_the_jaws_open():
    driven = Driven((6.0, 0.0), mu_grip=0.36).grip()
    driven.press()
    slipped = driven.bench.truth().slip_mm
    assert 0.05 < slipped < 1.0
    driven.move(dz=4.0)
    driven.move(dx=-2.0)
    assert driven.bench.truth().slip_mm == pytest.approx(slipped, abs=1e-6)
    driven.press()
    assert driven.bench.truth().slip_mm >= slipped - 1e-3


def test_noise_has_the_sizes_of_the_settings():
    driven = Driven(wrist={"white_n": 0.1, "white_nm": 0.004})
    driven.rest(3.0)
    values = driven.bench.force_torque.samples.since(0).values
    assert values[:, :3].std(axis=0) == pytest.approx([0.1] * 3, rel=0.08)
    assert values[:, 3:].std(axis=0) == pytest.approx([0.004] * 3, rel=0.08)
    white = values[:, 0] - values[:, 0].mean()
    assert abs(np.mean(white[1:] * white[:-1])) < 0.1 * np.mean(white**2)


@pytest.mark.parametrize("start", [(0.0, 0.0), (8.5, 0.0), (12.0, 3.0)])
def test_release_is_judged_at_the_true_offset(start):
    driven = Driven(start).grip()
    driven.press()
    before = driven.bench.truth()
    driven.release()
    after = driven.bench.truth()
    # A piece of d 15 on one of d 20 stands while its centre is over the bottom: 10 mm.
    assert after.stands is bool(np.hypot(*start) < 10.0)
    assert before.stands is None
    assert after.margin_mm == pytest.approx(before.margin_mm)
    assert after.offset_mm == pytest.approx(start, abs=1e-9)


def open_in_steps(driven, opened_mm, from_mm=None):
    """Open in steps of 0.1 mm, each held for 1 s, from the width ``from_mm`` of the piece."""
    width_mm = driven.bench.scene.piece.width_mm if from_mm is None else from_mm
    for step in range(1, round(opened_mm / 0.1) + 1):
        driven.finish(driven.gripper.open_to(width_mm + 0.1 * step, 5.0))
        driven.rest(0.98)


def unloaded(start, **given):
    """Return a piece at ``start`` that its support carries."""
    driven = Driven(start, **given).grip()
    driven.press()
    driven.finish(driven.arm.unload(0.4, 2.0))
    driven.rest(0.2)
    return driven


def test_a_stable_piece_leaves_the_hand_without_load_step_by_step():
    driven = unloaded((4.0, 3.0))
    open_in_steps(driven, 0.5)
    assert driven.gripper.status().force_n == pytest.approx(10.0 - 5.0 * 0.5, abs=0.3)
    assert not driven.gripper.status().holding
    assert driven.bench.truth().stands is None
    open_in_steps(driven, 2.0, driven.bench.scene.piece.width_mm + 0.5)
    gripper = np.array([0, 0, -1.5 * 9.80665, 0, 0, 0])
    assert driven.wrench() == pytest.approx(gripper, abs=1e-3)
    driven.finish(driven.gripper.open_to(driven.gripper.status().width_mm + 2.0, 5.0))
    after = driven.bench.truth()
    assert (after.stands, driven.bench.truth().margin_mm) == (True, pytest.approx(5.0, abs=0.01))


def test_a_piece_that_falls_along_the_pads_is_lost_while_the_jaws_open():
    driven = unloaded((11.5, 0.0))
    open_in_steps(driven, 2.6)
    assert driven.bench.truth().stands is False
    driven.finish(driven.gripper.grip(10.0))
    assert not driven.gripper.status().holding


def test_a_piece_that_leans_on_a_finger_loads_the_hand_and_can_be_gripped_again():
    driven = unloaded((0.0, 15.5), piece="brick", bottoms=("circle25",))
    margin_mm = driven.bench.truth().margin_mm
    open_in_steps(driven, 2.6)
    assert driven.bench.truth().stands is None
    free_n = -1.5 * 9.80665
    load = driven.wrench() - [0, 0, free_n, 0, 0, 0]
    # It leans at the height of the pads, 28 mm, by 1.6 mm of its weight beside the edge.
    assert load[1] == pytest.approx(-0.15 * 9.80665 * margin_mm / 28.0, rel=0.1)
    assert load[3] == pytest.approx(1e-3 * load[1] * 120.0, rel=0.05)
    driven.finish(driven.gripper.grip(10.0))
    driven.rest(0.2)
    assert driven.gripper.status().holding
    driven.move(dz=10.0)
    weight_n = 9.80665 * (1.5 + 1e-3 * driven.bench.scene.piece.mass_g)
    assert driven.wrench()[2] == pytest.approx(-weight_n, abs=1e-6)
    assert driven.bench.truth().stands is None
    assert margin_mm < 0.0


def test_steps_in_air_loosen_the_grip_and_the_piece_falls():
    driven = Driven().grip()
    open_in_steps(driven, 0.3)
    assert driven.bench.truth().stands is None
    driven.finish(driven.gripper.open_to(40.0, 20.0))
    assert driven.bench.truth().stands is False


def test_release_high_above_the_support_is_a_fall():
    driven = Driven().grip()
    driven.finish(driven.gripper.open_to(40.0, 20.0))
    truth = driven.bench.truth()
    assert truth.stands is False
    assert truth.margin_mm > 5.0


def test_release_disturbance_decides_near_the_edge():
    stands = set()
    for seed in range(5):
        driven = Driven((9.9, 0.0), seed=seed, release_disturbance_mm=0.5).grip()
        driven.press()
        driven.release()
        stands.add(driven.bench.truth().stands)
    assert stands == {True, False}


def test_dragging_knocks_a_free_support_over_and_spares_a_fixed_one():
    for bottoms, knocked in ((("short",), True), (("circle25",), False)):
        driven = Driven(bottoms=bottoms).grip()
        driven.press()
        driven.move(dx=2.0)
        assert driven.bench.truth().knocked_over is knocked


def test_towers_are_judged_at_every_interface():
    scene_bottoms = Tower(
        (CATALOGUE.bottom("short").body(), CATALOGUE.bottom("long").body((8.5, 0.0)))
    )
    scene = Scene(
        CATALOGUE.top("mushroom"), scene_bottoms, (5.0, 0.0), 1, SimulationSettings(preset="off")
    )
    truth = SimulatedBench(scene).truth()
    # Both above the short: (35 g at 8.5 + 21 g at 13.5) / 56 g = 10.4 mm, but its radius is 10.
    assert truth.margin_mm == pytest.approx(10.0 - (35 * 8.5 + 21 * 13.5) / 56, abs=0.05)


def test_scripted_faults_reach_the_devices():
    driven = Driven(
        cameras=True,
        script=(
            "tactile_left:freeze@0.5",
            "tactile_right:stop@0.5",
            "force_torque:nan@0.5+0.2",
            "force_torque:stop@1.0",
            "arm:silent@1.0",
        ),
    )
    driven.rest(1.5)
    left = [f for f in driven.bench.tactile["left"].frames.since(0)[0] if f.t_s > 0.55]
    assert len(left) > 15
    assert all(np.array_equal(left[0].image, frame.image) for frame in left)
    right = driven.bench.tactile["right"].frames.newest()
    assert right is not None
    assert right.t_s < 0.5
    samples = driven.bench.force_torque.samples.since(0)
    bad = np.isnan(samples.values).all(axis=1)
    assert samples.t_s[bad].min() == pytest.approx(0.5, abs=0.011)
    assert bad.sum() == pytest.approx(200, abs=10)
    assert samples.t_s[-1] < 1.01
    assert driven.arm.poses.since(0).t_s[-1] < 1.01


def test_light_faults_change_the_brightness_only_while_they_last():
    driven = Driven(
        script=("tactile_left:flicker@0.5+0.5", "tactile_right:dark@0.5+0.5"), cameras=True
    )
    driven.rest(1.5)

    def brightness(finger, start_s, end_s):
        frames = driven.bench.tactile[finger].frames.since(0)[0]
        return [f.image.mean() for f in frames if start_s < f.t_s < end_s]

    calm, swing = brightness("left", 0.0, 0.49), brightness("left", 0.51, 0.99)
    assert max(calm) / min(calm) < 1.01
    assert max(swing) / min(swing) == pytest.approx(1.25 / 0.75, rel=0.1)
    assert max(brightness("right", 0.51, 0.99)) < 0.1 * min(brightness("right", 1.01, 1.5))


def test_beside_the_support_the_press_finds_nothing():
    driven = Driven((40.0, 0.0)).grip()
    motion = driven.arm.press(PRESS)
    with pytest.raises(FaultError, match="NO-CONTACT"):
        driven.finish(motion)


def test_gel_creeps_back_after_a_press_when_hysteresis_is_on():
    driven = Driven((2.0, 1.0), grasp={"hysteresis": True}).grip()
    driven.press()
    pressed = np.abs(driven.bench._world._field_px).max()
    driven.move(dz=3.0)
    left = np.abs(driven.bench._world._field_px).max()
    driven.rest(3.0)
    assert 0.01 * pressed < left < 0.2 * pressed
    assert np.abs(driven.bench._world._field_px).max() < 0.02 * left


def test_a_stalled_arm_does_not_arrive():
    driven = Driven(script=("arm:stall@0.1",))
    driven.rest(0.05)
    motion = driven.arm.move_to(Pose(0.0, 0.0, 60.0), 20.0)
    driven.rest(3.0)
    assert not motion.done
    assert driven.arm.pose(0.1).z_mm < 40.0


def test_cameras_jitter_drop_and_lose_markers_as_set():
    tactile = {"jitter_s": 0.005, "drop_share": 0.1, "lost_share": 0.05}
    driven = Driven(tactile=tactile, cameras=True)
    driven.rest(8.0)
    frames = driven.bench.tactile["left"].frames.since(0)[0]
    t_s = np.array([frame.t_s for frame in frames])
    number = np.array([frame.sequence for frame in frames])
    late = t_s - 0.04 * number
    assert np.ptp(late) < 0.0101
    assert np.ptp(late) > 0.007
    assert 0.03 < 1.0 - len(frames) / (number[-1] + 1) < 0.2
    assert driven.bench.tactile["left"].health.lost == number[-1] - number[0] + 1 - len(frames)


def test_streams_of_a_former_scene_are_forgotten():
    first = Driven(cameras=True)
    first.rest(0.5)
    streams = first.bench.tactile["left"].frames
    scene = first.bench.scene
    shared = RawStreams(
        {finger: first.bench.tactile[finger].frames for finger in FINGERS},
        first.bench.force_torque.samples,
        first.arm.poses,
        SampleStream("arm_command", 3, 10),
    )
    again = SimulatedBench(scene, streams=shared)
    assert streams.newest() is None
    assert again.tactile["left"].frames is streams


def test_falls_are_animated_only_when_asked():
    pytest.importorskip("mujoco")
    driven = Driven((12.0, 0.0)).grip()
    driven.press()
    driven.release()
    assert driven.bench.truth().fall is None
    fall = driven.bench.truth(animate=True).fall
    assert fall is not None
    assert fall.names == ("short", "pot")
    assert fall.pose.shape == (len(fall.t_s), 2, 7)
    assert driven.bench.truth(animate=True).fall is fall
