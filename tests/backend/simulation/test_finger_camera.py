"""Arm programs against closed forms: profile, press law, unloading."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest

from touchdown.backend.core import MARKERS, Decimator, FloatArray, InputError
from touchdown.backend.devices.protocols import PressCommand
from touchdown.backend.emulation.simulated_disturbances import (
    Disturbance,
    parse_disturbance,
    parse_script,
)
from touchdown.backend.simulation import (
    ArmCycle,
    TactileRenderer,
    load_gel_appearance,
    mirror_appearance,
)
from touchdown.backend.simulation.arm import ArmDrive, SimPress, SimTravel, SimUnload, travelled_mm
from touchdown.backend.simulation.contact import TRIALS_PER_CALL, halve_steps
from touchdown.backend.simulation.finger_camera import DotRenderer
from touchdown.backend.simulation.world import STILL_PX

LAW = PressCommand(1.5, 1.5, 2.0, 2.0, 1.0, 11.0, (15.0, 15.0, 15.0))
CYCLE_S = 0.01


def cycle(k, force_n=None):
    """Cycle k; ``force_n(t)`` gives the samples of the cycle before, None for a silent sensor."""
    start = k * CYCLE_S
    t_s = start - CYCLE_S + 0.001 * np.arange(1, 11)
    if force_n is None:
        return ArmCycle(start, start + CYCLE_S, np.empty(0), np.empty(0))
    return ArmCycle(start, start + CYCLE_S, t_s, force_n(t_s))


def advance(drive, numbers, force_n=None, *, stalled=False):
    for k in numbers:
        drive.step(cycle(k, force_n), stalled=stalled)


@pytest.mark.parametrize(("length", "speed"), [(10.0, 20.0), (0.3, 20.0), (3.0, 50.0), (0.0, 5.0)])
def test_profile_is_smooth_monotone_and_ends_at_the_target(length, speed):
    total = length / speed + speed / 500.0 + 1.0
    t = np.linspace(0.0, total, 4001)
    way = np.array([travelled_mm(float(x), length, speed, 500.0) for x in t])
    assert way[-1] == length
    assert np.all(np.diff(way) >= -1e-12)
    velocity = np.gradient(way, t)
    assert velocity.max() <= speed * (1.0 + 1e-6)
    assert np.abs(np.gradient(velocity, t)).max() <= 500.0 * 1.01


def test_travel_takes_the_time_of_a_trapezoid():
    start, target = np.array([1.0, 2.0, 3.0]), np.array([4.0, 6.0, 3.0])
    drive, travel = ArmDrive(start), SimTravel(start, target, 20.0)
    drive.run(travel)
    k, seen = 0, []
    while not travel.done:
        seen.append(drive.step(cycle(k), stalled=False))
        k += 1
    assert k == int(np.ceil((5.0 / 20.0 + 20.0 / 500.0) / CYCLE_S - 1e-9))
    assert drive.command_mm.tolist() == target.tolist()
    line = np.array(seen) - start
    assert line == pytest.approx(np.outer(line[:, 0] / 3.0, [3.0, 4.0, 0.0]))


def test_a_stalled_arm_stands_still_and_goes_on_afterwards():
    drive = ArmDrive(np.zeros(3))
    travel = SimTravel(np.zeros(3), np.array([0.0, 0.0, 5.0]), 20.0)
    drive.run(travel)
    advance(drive, range(10))
    before = drive.command_mm
    advance(drive, range(10, 30), stalled=True)
    assert drive.command_mm.tolist() == before.tolist()
    advance(drive, range(30, 60))
    assert travel.done
    assert drive.command_mm[2] == 5.0


def pressed(stiffness_n_mm, start_mm=3.0, noise=0.0, offset=14.7):
    """Press onto a spring whose surface is z = 0; returns the program, times and heights."""
    rng = np.random.default_rng(1)
    air_s = np.arange(-450, 1) * 1e-3
    air = air_s, offset + noise * rng.standard_normal(len(air_s))
    drive, press = ArmDrive(np.array([0.0, 0.0, start_mm])), SimPress(LAW, start_mm, 0.0, air)
    drive.run(press)
    ends, heights = [0.0], [start_mm]

    def force(t_s):
        z = np.interp(t_s, ends, heights)
        pushed = stiffness_n_mm * np.maximum(-z, 0.0)
        return offset + pushed + noise * rng.standard_normal(len(t_s))

    k = 0
    while not press.done and k < 2000:
        drive.step(cycle(k, force), stalled=False)
        ends.append((k + 1) * CYCLE_S)
        heights.append(float(drive.command_mm[2]))
        k += 1
    return press, np.array(ends), np.array(heights)


@pytest.mark.parametrize("stiffness", [3.0, 5.2, 12.0, 30.0])
def test_onset_is_back_dated_to_the_touch(stiffness):
    press, _, _ = pressed(stiffness, noise=0.1)
    assert press.onset_s == pytest.approx(1.5, abs=0.05)
    assert press.detected_s - press.onset_s == pytest.approx(1.0 / (2.0 * stiffness), abs=0.04)


@pytest.mark.parametrize("start_mm", [0.1, 0.3, 0.7])
@pytest.mark.parametrize("stiffness", [5.2, 12.0])
def test_a_contact_soon_after_the_start_is_told_from_the_air_before_it(stiffness, start_mm):
    press, _, z_mm = pressed(stiffness, start_mm, noise=0.1)
    touched_s = start_mm / 2.0
    assert press.onset_s == pytest.approx(touched_s, abs=0.05)
    assert press.detected_s - touched_s == pytest.approx(1.0 / (2.0 * stiffness), abs=0.05)
    assert z_mm[-1] == pytest.approx(-1.5, abs=0.1)


def test_command_follows_the_law_and_never_rises():
    press, t_s, z_mm = pressed(5.2)
    assert np.all(np.diff(z_mm) <= 1e-12)
    down = t_s < 1.5
    assert z_mm[down] == pytest.approx(3.0 - 2.0 * t_s[down])
    zero = 3.0 - 2.0 * press.onset_s
    acted = np.ceil((press.detected_s + 1e-9) / CYCLE_S) * CYCLE_S
    after = t_s > acted + 0.3
    ramp = zero - 1.5 * np.minimum(1.0, (t_s - press.onset_s) / 1.5)
    assert z_mm[after] == pytest.approx(ramp[after])
    assert z_mm[-1] == pytest.approx(zero - 1.5)
    assert t_s[-1] == pytest.approx(press.onset_s + 2.0, abs=0.0101)


def test_what_the_descent_overshot_is_kept():
    press, t_s, z_mm = pressed(3.0)
    zero = 3.0 - 2.0 * press.onset_s
    overshoot = zero - 2.0 * (np.ceil(press.detected_s / CYCLE_S) * CYCLE_S - press.onset_s)
    waiting = (t_s > press.detected_s + 0.03) & (t_s < press.onset_s + (zero - overshoot) - 0.02)
    assert waiting.any()
    assert np.ptp(z_mm[waiting]) == 0.0


@pytest.mark.parametrize("force", [None, lambda t: np.full(len(t), np.nan)])
def test_without_a_sensor_the_press_ends_after_its_travel(force):
    drive = ArmDrive(np.array([0.0, 0.0, 40.0]))
    press = SimPress(LAW, 40.0, 0.0, (np.empty(0), np.empty(0)))
    drive.run(press)
    advance(drive, range(700), force)
    assert press.done
    assert press.failure is not None
    assert press.failure.code == "NO-CONTACT"
    assert 40.0 - drive.command_mm[2] <= 11.0


def test_unload_stops_at_the_force_and_waits_while_nothing_is_heard():
    drive = ArmDrive(np.array([0.0, 0.0, -1.5]))
    unload = SimUnload(1.0, 14.7, 2.0, -1.5)
    drive.run(unload)
    advance(drive, range(20))
    assert drive.command_mm[2] == -1.5
    k = 20
    while not unload.done:
        z = float(drive.command_mm[2])
        drive.step(
            cycle(k, lambda t, z=z: np.full(len(t), 14.7 + 5.2 * max(-z, 0.0))), stalled=False
        )
        k += 1
    assert unload.failure is None
    assert 5.2 * -drive.command_mm[2] == pytest.approx(1.0, abs=0.11)


def test_unload_gives_up_when_the_force_does_not_fall():
    drive = ArmDrive(np.zeros(3))
    unload = SimUnload(1.0, 0.0, 2.0, 0.0)
    drive.run(unload)
    advance(drive, range(600), lambda t: np.full(len(t), 20.0))
    assert unload.failure is not None
    assert unload.failure.code == "NOT-UNLOADED"


def test_drop_stands_still():
    drive = ArmDrive(np.zeros(3))
    drive.run(SimTravel(np.zeros(3), np.array([0.0, 0.0, 50.0]), 20.0))
    drive.step(cycle(0), stalled=False)
    drive.drop()
    before = drive.command_mm
    drive.step(cycle(1), stalled=False)
    assert not drive.moving
    assert drive.command_mm.tolist() == before.tolist()


def test_text_is_read():
    assert parse_disturbance("tactile_right:stop@2.5+1.0") == Disturbance(
        "tactile_right", "stop", 2.5, 1.0
    )
    assert parse_disturbance(" force_torque:nan@4 ").length_s == float("inf")


def test_active_from_start_to_end_only():
    script = parse_script(["tactile_left:freeze@3.0+0.5", "arm:stall@1"])
    assert not script.active("tactile_left", "freeze", 2.99)
    assert script.active("tactile_left", "freeze", 3.0)
    assert not script.active("tactile_left", "freeze", 3.5)
    assert not script.active("tactile_left", "stop", 3.2)
    assert not script.active("tactile_right", "freeze", 3.2)
    assert script.active("arm", "stall", 1e6)


def test_a_slow_sensor_has_its_rate_and_takes_the_first_sample_of_each_period():
    script = parse_script(["force_torque:slow=300@1+2"])
    rates = [script.rate_hz("force_torque", t_s) for t_s in (0.9, 1.0, 2.9, 3.0)]
    assert rates == [None, 300.0, 300.0, None]
    thinned = Decimator()
    taken = [k for k in range(1000) if thinned.takes(1.0 + 0.001 * k, 300.0)]
    assert len(taken) == 300
    assert set(np.diff(taken)) == {3, 4}
    assert sum(thinned.takes(5.0 + 0.04 * k, 40.0) for k in range(25)) == 25, "it is no faster"


def test_a_turn_comes_once_in_the_cycle_of_its_time():
    script = parse_script(["gripper:turn=3@2.005"])
    turned = [script.turn_rad(0.01 * k, 0.01 * (k + 1)) for k in range(300)]
    assert np.flatnonzero(turned).tolist() == [200]
    assert sum(turned) == pytest.approx(np.radians(3.0))


def test_a_drift_grows_as_told_and_stays():
    script = parse_script(["force_torque:drift=0.05@2+4", "force_torque:drift=0.1@4"])
    assert [script.drift_n(t_s) for t_s in (0.0, 2.0, 4.0, 5.0, 10.0)] == pytest.approx(
        [0.0, 0.0, 0.1, 0.25, 0.8]
    )


@pytest.mark.parametrize(
    "text",
    [
        *("", "tactile_left", "tactile_left:freeze", "tactile_left:freeze@"),
        *("tactile_left:freeze@-1", "tactile_left:freeze@nan", "tactile_left:freeze@1+"),
        *("camera:freeze@1", "gripper:freeze@1", "arm:stall@1;arm:stall@2", "arm:slow=5@1"),
        *("force_torque:slow@1", "force_torque:slow=0@1", "force_torque:nan=5@1"),
        *("force_torque:drift@1", "tactile_left:drift=0.1@1"),
    ],
)
def test_bad_text_is_one_clear_error(text):
    with pytest.raises(InputError) as raised:
        parse_disturbance(text)
    assert raised.value.where == text
    assert raised.value.fix


STILL = np.zeros((MARKERS, 2))


@pytest.fixture
def dots():
    return DotRenderer(load_gel_appearance(), np.random.default_rng(4))


def drawn(dots, displacement):
    dots.draw(np.asarray(displacement, dtype=np.float64))
    return dots.mask.copy()


@pytest.mark.parametrize(("du", "dv"), [(30, 0), (-41, 0), (0, 25), (-7, -33)])
def test_a_shift_moves_the_mask_and_cuts_it_at_the_border(dots, du, dv):
    still = drawn(dots, STILL)
    moved = drawn(dots, STILL + np.array([du, dv]))
    here = np.s_[max(dv, 0) : 240 + min(dv, 0), max(du, 0) : 320 + min(du, 0)]
    there = np.s_[max(-dv, 0) : 240 + min(-dv, 0), max(-du, 0) : 320 + min(-du, 0)]
    assert still[there].max() > 0.9
    assert moved[here] == pytest.approx(still[there], abs=1e-4)


def test_where_two_dots_meet_the_larger_counts(dots):
    """Two dots at one position: no darker than the darker of both."""
    gone = STILL + 1e4
    rest = load_gel_appearance().rest_px
    single = []
    for marker in (30, 31):
        alone = gone.copy()
        alone[marker] = rest[31] - rest[marker]
        single.append(dots_alone(dots, alone))
    both = gone.copy()
    both[30], both[31] = rest[31] - rest[30], 0.0
    together = dots_alone(dots, both)
    assert together == pytest.approx(np.maximum(*single), abs=1e-6)
    assert single[0].max() > 0.8
    assert np.abs(single[0] - single[1]).max() > 0.05


def dots_alone(dots, displacement):
    """Draw round dots: the neighbours that are out of sight must not stretch them."""
    dots._slopes = np.zeros_like(dots._slopes)
    return drawn(dots, displacement)


def test_nothing_is_left_of_the_frame_before(dots):
    first = drawn(dots, STILL)
    assert drawn(dots, STILL + 1e4).max() == 0.0
    assert np.array_equal(drawn(dots, STILL), first)


def test_dots_that_hardly_moved_look_as_they_did_and_creep_adds_up():
    exact, still = (TactileRenderer(load_gel_appearance(), 4, px) for px in (0.0, STILL_PX))
    for creep_px, seen_px in ((0.0, 0.0), (0.004, 0.0), (0.008, 0.0), (0.012, 0.012)):
        image = still.render(STILL + creep_px, NOBODY)
        assert (image == exact.render(STILL + seen_px, NOBODY)).all(), creep_px


def test_a_picture_developed_late_is_the_one_developed_at_once(look):
    moved, hidden = np.tile([1.5, 2.0], (MARKERS, 1)), NOBODY.copy()
    hidden[31] = True
    course = [(STILL, NOBODY), (moved, hidden), (moved, NOBODY), (STILL, hidden)]
    once, late = TactileRenderer(look, 4), TactileRenderer(look, 4)
    images = [once.render(*shown) for shown in course]
    pending = [late.expose(*shown) for shown in course]
    for number in (2, 0, 3, 1, 0):
        assert np.array_equal(pending[number](), images[number]), number


MOST = 12


@dataclass(frozen=True)
class Place:
    """A position on a line, and its distance from the nearer of two minima."""

    x: FloatArray
    size: FloatArray

    @classmethod
    def at(cls, x: FloatArray) -> Place:
        return cls(x, np.minimum(np.abs(x), np.abs(x - 7.0) + 0.5))

    def take(self, rows: np.ndarray) -> Place:
        return Place(self.x[rows], self.size[rows])

    def put(self, rows: np.ndarray, by: Place) -> None:
        self.x[rows], self.size[rows] = by.x, by.size


def alone(x: float, step: float) -> float:
    """Return the result of one probe on its own."""
    before = Place.at(np.array([x])).size[0]
    for k in range(MOST):
        tried = x + step * 0.5**k
        if Place.at(np.array([tried])).size[0] < before:
            break
    return tried


@pytest.mark.parametrize("count", [1, 5, TRIALS_PER_CALL + 1])
def test_every_probe_goes_where_it_would_go_alone(count: int) -> None:
    rng = np.random.default_rng(count)
    x = rng.uniform(-3.0, 10.0, count)
    # Some steps overshoot once, some need many halvings, and every third one leads uphill.
    step = np.where(np.arange(count) % 3 == 2, np.sign(x), -x) * rng.uniform(0.5, 300.0, count)
    start, after, asked = Place.at(x), Place.at(x + step), []

    def at(rows: np.ndarray, share: FloatArray) -> Place:
        asked.append(len(rows))
        return Place.at(x[rows] + share * step[rows])

    worse = np.flatnonzero(~(after.size < start.size))
    halve_steps(after, start.size, worse, MOST, at)
    assert after.x.tolist() == [alone(a, s) for a, s in zip(x, step, strict=True)]
    assert max(asked, default=0) <= max(TRIALS_PER_CALL, len(worse))
    assert len(asked) < MOST or count > TRIALS_PER_CALL


def test_nothing_is_tried_where_all_fell() -> None:
    start, after = Place.at(np.array([4.0])), Place.at(np.array([1.0]))
    halve_steps(
        after, start.size, np.array([], dtype=np.intp), MOST, lambda *_: pytest.fail("tried")
    )
    assert after.x.tolist() == [1.0]


NOBODY = np.zeros(MARKERS, dtype=bool)


def darkness(image):
    """How much darker than the surroundings, independent of the renderer: blurred minus image."""
    grey = image.max(axis=2).astype(np.float64)
    return cv2.GaussianBlur(grey, (0, 0), 14.0) - grey


def centroid_px(image, around):
    """Centroid of the darkness within 11 px of ``around``."""
    v, u = np.mgrid[0:240, 0:320]
    near = np.hypot(u - around[0], v - around[1]) < 11.0
    weight = np.clip(darkness(image), 6.0, None)[near] - 6.0
    return np.array([(weight * u[near]).sum(), (weight * v[near]).sum()]) / weight.sum()


@pytest.fixture(scope="module")
def look():
    return load_gel_appearance()


def test_rest_grid_is_that_of_the_real_sensor(look):
    grid = look.rest_px.reshape(7, 9, 2)
    assert grid[0, 0].tolist() == [21.2, 21.4]
    assert grid[6, 8].tolist() == [287.2, 214.7]
    assert np.diff(grid[..., 0], axis=1).mean() == pytest.approx(32.9, abs=0.4)
    assert np.diff(grid[..., 1], axis=0).mean() == pytest.approx(31.6, abs=0.4)


def test_dots_are_drawn_where_the_markers_are(look):
    shift = np.tile([2.3, -4.6], (MARKERS, 1))
    optics = TactileRenderer(look, 1)
    still, image = optics.render(STILL, NOBODY), optics.render(shift, NOBODY)
    for rest in look.rest_px:
        # Flecks and coloured shadows pull a centroid by a constant.
        before, after = centroid_px(still, rest), centroid_px(image, rest + shift[0])
        assert before == pytest.approx(rest, abs=0.9)
        assert after - before == pytest.approx(shift[0], abs=0.35)


def test_sub_pixel_motion_is_visible(look):
    optics = TactileRenderer(look, 1)
    inner = [10, 31, 52]
    first = optics.render(STILL, NOBODY)
    second = optics.render(np.tile([0.30, -0.20], (MARKERS, 1)), NOBODY)
    for marker in inner:
        at = look.rest_px[marker]
        moved = centroid_px(second, at) - centroid_px(first, at)
        assert moved == pytest.approx([0.30, -0.20], abs=0.08)


def test_colours_are_those_of_the_real_frame(look):
    image = TactileRenderer(look, 1).render(STILL, NOBODY).astype(float)
    between = image[100:103, 136:140].reshape(-1, 3).mean(axis=0)
    cores = np.array([image[round(v), round(u)] for u, v in look.rest_px]).mean(axis=0)
    assert cores == pytest.approx([37, 40, 30], abs=6)
    assert image.reshape(-1, 3).mean(axis=0) == pytest.approx([103, 90, 66], abs=10)
    assert between[0] > between[1] > between[2]
    violet, teal = image[110:130, 165:175].mean(axis=(0, 1)), image[5:12, 165:175].mean(axis=(0, 1))
    assert violet[2] - violet[1] > teal[2] - teal[1] + 20


def test_dot_width_follows_radius_and_edge(look):
    for variant, radius in ((look, 7.6), (replace(look, radius_px=6.1, edge_px=0.55), 6.1)):
        optics = TactileRenderer(variant, 3)
        mean = np.mean([optics.render(STILL, NOBODY).astype(float) for _ in range(8)], axis=0)
        area = []
        for u, v in variant.rest_px[[20, 31, 40]]:
            patch = mean[round(v) - 14 : round(v) + 15, round(u) - 14 : round(u) + 15].mean(axis=2)
            half = 0.5 * (patch.min() + np.median(patch[0]))
            area.append((patch < half).sum())
        assert np.sqrt(np.mean(area) / np.pi) == pytest.approx(radius, abs=0.4)


def test_noise_and_grain_have_their_sizes(look):
    optics = TactileRenderer(look, 5)
    far = np.full((MARKERS, 2), 1e4)
    frames = np.array([optics.render(far, NOBODY)[::2, ::2].astype(float) for _ in range(30)])
    # Rounding adds 1/12 to the variance.
    assert frames.std(axis=0, ddof=1).mean() == pytest.approx(np.hypot(1.5, 0.29), rel=0.1)
    still = frames.mean(axis=0)
    flat = still - cv2.GaussianBlur(still, (0, 0), 6.0)
    assert flat.std() == pytest.approx(2.0, rel=0.1)


def test_noise_differs_between_frames_and_repeats_with_the_seed(look):
    first, again = TactileRenderer(look, 9), TactileRenderer(look, 9)
    frames = [first.render(STILL, NOBODY) for _ in range(2)]
    assert np.array_equal(frames[0], again.render(STILL, NOBODY))
    assert not np.array_equal(frames[0], frames[1])
    a, b = (frame.astype(float) - np.mean(frames, axis=0) for frame in frames)
    assert np.abs(a - b).max() > 3.0
    assert not np.array_equal(frames[0], TactileRenderer(look, 10).render(STILL, NOBODY))


def test_a_smear_hides_its_dot_only(look):
    hidden = NOBODY.copy()
    hidden[31] = True
    image = TactileRenderer(look, 1).render(STILL, hidden)
    shade = darkness(image)
    depth = np.array([shade[round(v), round(u)] for u, v in look.rest_px])
    assert depth[31] < 0.5 * np.delete(depth, 31).min()


def test_what_did_not_move_is_not_drawn_again_and_looks_as_if_it_were(look):
    moved, hidden = np.tile([1.5, 2.0], (MARKERS, 1)), NOBODY.copy()
    hidden[31] = True
    course = [(STILL, NOBODY), (STILL, NOBODY), (STILL, hidden), (STILL, NOBODY),
              (moved, NOBODY), (moved, NOBODY), (STILL, NOBODY)]  # fmt: skip
    optics = TactileRenderer(look, 4)
    for number, shown in enumerate(course):
        image, other = optics.render(*shown), TactileRenderer(look, 4)
        for before in range(number):
            other.render(STILL + 5.0 + before, NOBODY)
        assert np.array_equal(image, other.render(*shown)), number


def test_dots_stretch_with_the_gel(look):
    strain = np.zeros((MARKERS, 2))
    strain[:, 0] = 0.2 * (look.rest_px[:, 0] - 160.0)
    optics = TactileRenderer(look, 1)
    image = optics.render(strain, NOBODY)
    u, v = look.rest_px[31] + strain[31]
    dark = darkness(image) > 20.0
    width = dark[round(v), round(u) - 15 : round(u) + 16].sum()
    height = dark[round(v) - 15 : round(v) + 16, round(u)].sum()
    assert width / height == pytest.approx(1.2, abs=0.1)


def test_dots_beyond_the_border_are_cut_and_nothing_fails(look):
    for shift in ((0.0, -30.0), (0.0, 400.0), (-25.0, 0.0), (1e4, -1e4)):
        image = TactileRenderer(look, 1).render(np.tile(shift, (MARKERS, 1)), NOBODY)
        assert image.shape == (240, 320, 3)
    gone = TactileRenderer(look, 1).render(np.full((MARKERS, 2), 1e4), np.ones(MARKERS, dtype=bool))
    assert darkness(gone).max() < 20.0


def test_the_other_finger_is_mirrored(look):
    other = mirror_appearance(look)
    assert np.all(np.diff(other.rest_px.reshape(7, 9, 2)[..., 0], axis=1) > 0.0)
    assert other.rest_px[0].tolist() == [319 - 285.9, 20.4]
    assert mirror_appearance(other).rest_px == pytest.approx(look.rest_px)
    left = TactileRenderer(look, 1).render(np.full((MARKERS, 2), 1e4), NOBODY).astype(float)
    right = TactileRenderer(other, 2).render(np.full((MARKERS, 2), 1e4), NOBODY).astype(float)
    smooth = [cv2.GaussianBlur(image, (0, 0), 5.0) for image in (left, right[:, ::-1])]
    assert np.abs(smooth[0] - smooth[1]).max() < 3.0
