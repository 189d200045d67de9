"""The homography of the board: exact on exact points, within a pixel from a picture."""

from __future__ import annotations

import argparse
import io
import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from tests.backend.sensing.known_truth import (
    GELSIGHT,
    REST_FRAME,
    bump_field,
    plain_detector,
    rest_dots,
    true_places,
    warp,
)
from touchdown.backend.bench.assembly import make_scene
from touchdown.backend.cli import track
from touchdown.backend.cli.output import VerbOutput
from touchdown.backend.config import ProbeSettings, SimulationSettings
from touchdown.backend.core.faults import InputError
from touchdown.backend.core.streams import SampleStream, Stream
from touchdown.backend.core.values import (
    FINGERS,
    MARKERS,
    MarkerField,
    MarkerState,
    Recording,
    TactileFrame,
)
from touchdown.backend.geometry import BOARD_DOTS_MM, circle, load_pieces
from touchdown.backend.geometry import face_points as lattice_points
from touchdown.backend.runs.requests import SceneChoice
from touchdown.backend.sensing.picture_files import count_pictures, draw_markers, read_pictures
from touchdown.backend.sensing.scene_camera import (
    Homography,
    calibrate_scene_camera,
    fit_homography,
    locate_camera,
    observe_offset,
)
from touchdown.backend.sensing.slip import (
    TorsionSlipDetector,
    TurnDetector,
    press_slip_mm,
    slip_since_loading,
)
from touchdown.backend.sensing.tracker import MarkerTracker
from touchdown.backend.simulation import conditions as nuisance
from touchdown.backend.simulation import mechanics
from touchdown.backend.simulation.finger_camera import load_gel_appearance
from touchdown.backend.simulation.marker_fields import build_gel
from touchdown.backend.simulation.mechanics import advance_probes, begin_probes
from touchdown.backend.simulation.scene_camera import (
    BOTTOM,
    EYE_MM,
    FOCAL_PX,
    HEIGHT_PX,
    WIDTH_PX,
    camera_matrix,
    render_scene,
)

TRUE = camera_matrix()[:, [0, 1, 3]] / camera_matrix()[2, 3]


def scene_of(piece: str, bottom: str):
    choice = SceneChoice(piece, (bottom,), 3, jig=True)
    return make_scene(load_pieces(), choice, SimulationSettings())


@pytest.fixture(scope="module")
def scene():
    return scene_of("pot", "circle25")


def test_exact_points_give_the_homography() -> None:
    rng = np.random.default_rng(1)
    board = rng.uniform(-50, 50, (9, 2))
    seen = Homography(TRUE, 0.0).to_px(board)
    fitted = fit_homography(board, seen)
    np.testing.assert_allclose(fitted.matrix, TRUE, rtol=1e-7, atol=1e-9)
    assert fitted.residual_px < 1e-8
    theirs, _ = cv2.findHomography(board, seen)
    np.testing.assert_allclose(fitted.matrix, theirs, rtol=1e-5, atol=1e-7)


def test_noisy_points_leave_a_residual() -> None:
    rng = np.random.default_rng(2)
    board = rng.uniform(-50, 50, (40, 2))
    seen = Homography(TRUE, 0.0).to_px(board) + rng.normal(0, 0.5, (40, 2))
    fitted = fit_homography(board, seen)
    assert 0.4 < fitted.residual_px < 0.9
    assert np.abs(fitted.to_px(board) - seen).max() < 3.0


def test_a_picture_of_the_bench_is_a_calibration(scene) -> None:
    fitted = calibrate_scene_camera(render_scene(scene, (-80.0, 0.0), 0.0, 3.0))
    there = np.array([[0.0, 0.0], [12.5, 0.0], [0.0, -12.5], [-9.0, 9.0]])
    assert np.abs(fitted.to_px(there) - Homography(TRUE, 0.0).to_px(there)).max() < 0.5
    assert Homography.parse(fitted.text()).text() == fitted.text()


def test_the_camera_is_located_from_its_homography() -> None:
    focal_px, axes, eye_mm = locate_camera(Homography(TRUE, 0.0), (WIDTH_PX, HEIGHT_PX))
    assert focal_px == pytest.approx(FOCAL_PX, rel=1e-9)
    np.testing.assert_allclose(eye_mm, EYE_MM, rtol=1e-9)
    inner = np.array([[focal_px, 0.0, WIDTH_PX / 2], [0.0, focal_px, HEIGHT_PX / 2], [0, 0, 1]])
    again = inner @ np.column_stack([axes.T, -axes.T @ eye_mm])
    np.testing.assert_allclose(again, camera_matrix(), rtol=1e-8, atol=1e-8)
    # Straight down, or the picture of a drawing: any focal length fits.
    assert locate_camera(Homography(np.diag([5.0, -5.0, 1.0]), 0.0), (640, 480)) is None


def test_holes_and_gaps_of_a_bottom_are_drawn_open() -> None:
    fitted = calibrate_scene_camera(render_scene(scene_of("pot", "circle25"), (-80, 0), 0.0, 3.0))
    for bottom, open_mm in (("ring24", (0.0, 0.0)), ("feet3", (0.0, 0.0)), ("channel20", (0, 6))):
        scene = scene_of("pot", bottom)
        image = render_scene(scene, (500.0, 0.0), 0.0, 0.0)
        face = scene.surface
        lattice = lattice_points(circle(30.0))
        at = np.rint(fitted.to_px(lattice)).astype(int)
        lit = (image[at[:, 1], at[:, 0]] == BOTTOM).all(axis=1)
        near = np.abs(np.stack([face.contains(lattice + d) for d in np.eye(2)]).sum(axis=0) - 1)
        clear = near == 1
        assert (lit == face.contains(lattice))[clear].mean() > 0.97
        x_px, y_px = np.rint(fitted.to_px(np.array([open_mm]))[0]).astype(int)
        assert tuple(image[y_px, x_px]) != BOTTOM


def test_the_face_is_drawn_where_the_homography_says(scene) -> None:
    fitted = calibrate_scene_camera(render_scene(scene, (-80.0, 0.0), 0.0, 3.0))
    with_piece = render_scene(scene, (6.0, -4.0), 0.0, 0.0).astype(int)
    without = render_scene(scene, (500.0, 0.0), 0.0, 0.0).astype(int)
    changed = np.argwhere(np.abs(with_piece - without).sum(axis=2) > 0)[:, ::-1]
    ring = np.array([6.0, -4.0]) + scene.piece.face.polygon(200)
    # The lowest edge of the piece in the picture is the near side of its face.
    lowest_px = fitted.to_px(ring)[:, 1].max()
    assert abs(changed[:, 1].max() - lowest_px) < 1.5


def test_too_few_points_points_on_a_line_and_hidden_dots_are_refused(scene) -> None:
    for points in (np.zeros((3, 2)), np.zeros((0, 2))):
        with pytest.raises(InputError, match="too few"):
            fit_homography(points, points)
    line = np.column_stack([np.arange(6.0), 2 * np.arange(6.0)])
    with pytest.raises(InputError, match="line"):
        fit_homography(line, line)
    image = render_scene(scene, (-80.0, 0.0), 0.0, 3.0)
    x, y = Homography(TRUE, 0.0).to_px(BOARD_DOTS_MM[:1])[0].astype(int)
    hidden = image.copy()
    hidden[y - 30 : y + 30, x - 30 : x + 30] = 0
    with pytest.raises(InputError, match="3 dots are seen"):
        calibrate_scene_camera(hidden)


@pytest.mark.parametrize("text", ["", "{}", '{"matrix": [1], "residual_px": 0}',
                                  '{"matrix": [0,0,0,0,0,0,0,0,0], "residual_px": 0}'])  # fmt: skip
def test_a_damaged_homography_is_refused(text) -> None:
    with pytest.raises(InputError):
        Homography.parse(text)


STIFFNESS_N_MM = 8.0
ONSET_S = 1.0
TOUCH_MM = 30.0


def pressed(noise_n: float = 0.1, depth_mm: float = 1.0) -> Recording:
    """A press of 1.5 s at constant speed and a hold, as the wrist and the arm report it."""
    t_s = np.arange(0.7, 3.1, 0.001)
    down_mm = depth_mm * np.clip((t_s - ONSET_S) / 1.5, 0.0, 1.0)
    wrench = np.zeros((len(t_s), 6))
    wrench[:, 2] = STIFFNESS_N_MM * down_mm
    wrench += noise_n * np.random.default_rng(1).standard_normal(wrench.shape)
    pose_t_s = np.arange(0.7, 3.1, 0.01)
    height = TOUCH_MM - depth_mm * np.clip((pose_t_s - ONSET_S) / 1.5, 0.0, 1.0)
    pose = np.column_stack([np.zeros((len(height), 2)), height])
    return Recording(t_s, wrench, (), (), pose_t_s, pose, np.zeros(6))


@pytest.mark.parametrize("slip_mm", [0.0, 0.1, 0.3, 0.8])
@pytest.mark.parametrize("press_n", [0.5, 1.0, 2.0])
def test_the_distance_between_the_lines_is_the_slip(slip_mm: float, press_n: float) -> None:
    height_mm = TOUCH_MM - press_n / STIFFNESS_N_MM - slip_mm
    found = slip_since_loading(pressed(), ONSET_S, height_mm, press_n)
    assert found == pytest.approx(slip_mm, abs=0.02)


def test_what_cannot_be_judged_is_nan() -> None:
    assert math.isnan(slip_since_loading(pressed(depth_mm=0.01), ONSET_S, 30.0, 1.0))
    assert math.isnan(slip_since_loading(pressed(), ONSET_S, 30.0, math.nan))
    blind = pressed()
    no_arm = Recording(
        blind.wrench_t_s, blind.wrench, (), (), np.zeros(0), np.zeros((0, 3)), np.zeros(6)
    )
    assert math.isnan(slip_since_loading(no_arm, ONSET_S, 30.0, 1.0))


CLIP = GELSIGHT / "blue_box_exp2_camera_2.avi"


def call(*words: str, as_json: bool = True) -> str:
    parser = argparse.ArgumentParser()
    track.add_arguments(parser)
    stream = io.StringIO()
    assert track.run(parser.parse_args(list(words)), VerbOutput(json=as_json, stream=stream)) == 0
    return stream.getvalue()


@pytest.fixture(scope="module")
def short_clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of 12 frames: the rest frame, then the bump field growing to 6 px."""
    folder = tmp_path_factory.mktemp("frames")
    image, _ = rest_dots()
    for k, a in enumerate(np.linspace(0, 6, 12)):
        cv2.imwrite(str(folder / f"{k}.png"), warp(image, bump_field, float(a)))
    return folder


def test_json_has_the_promised_shape_and_true_values(short_clip: Path) -> None:
    answer = json.loads(call(str(short_clip)))
    assert answer["grid"] == "7x9"
    frames = answer["frames"]
    assert [frame["index"] for frame in frames] == list(range(12))
    assert all(set(frame) == {"index", "ms", "quality", "markers"} for frame in frames)
    last = frames[-1]["markers"]
    keys = {"row", "col", "x_px", "y_px", "dx_px", "dy_px", "state"}
    assert all(set(marker) == keys for marker in last)
    assert [(m["row"], m["col"]) for m in last] == [(r, c) for r in range(7) for c in range(9)]
    assert {marker["state"] for marker in last} == {"seen"}
    _, dots = rest_dots()
    truth = true_places(dots, bump_field, 6.0) - dots
    moved = np.array([(marker["dx_px"], marker["dy_px"]) for marker in last])
    assert np.sqrt(((moved - truth) ** 2).sum(axis=1).mean()) < 0.06


def test_displacements_count_from_the_reference_file(short_clip: Path) -> None:
    one = call(str(short_clip / "11.png"), "--reference", str(REST_FRAME))
    moved = np.array([m["dx_px"] for m in json.loads(one)["frames"][0]["markers"]])
    _, dots = rest_dots()
    truth = (true_places(dots, bump_field, 6.0) - dots)[:, 0]
    assert np.abs(moved - truth).max() < 0.3


def test_overlay_and_table_for_people(short_clip: Path, tmp_path: Path) -> None:
    video = tmp_path / "drawn.mp4"
    text = call(str(short_clip), "--overlay", str(video), as_json=False)
    assert "100.00 %" in text
    assert count_pictures(video) == 12
    assert next(iter(read_pictures(video))).image.shape == (240, 320, 3)


def test_rings_are_drawn_around_the_dots() -> None:
    frame = next(read_pictures(REST_FRAME))
    field = MarkerTracker("left").track(frame)
    drawn = draw_markers(frame, field)
    assert drawn.shape == (720, 960, 3)
    u, v = np.rint(3 * (field.position_px[31] + 0.5)).astype(int)
    assert tuple(drawn[v, u + 27]) == pytest.approx((120, 230, 120), abs=40)


@pytest.mark.parametrize(
    "name", ["plug_3D_exp3_camera_0.avi", "artificial_strawberry_exp2_camera_2.avi"]
)
def test_a_small_dot_gel_is_refused_by_name(name: str) -> None:
    with pytest.raises(InputError) as refused:
        call(str(GELSIGHT / name))
    assert "8x10 small-dot gel recognised" in refused.value.what
    assert name in refused.value.where


def test_bad_input_names_the_file(tmp_path: Path) -> None:
    broken = tmp_path / "broken.png"
    broken.write_bytes(REST_FRAME.read_bytes()[:200])
    text = tmp_path / "words.avi"
    text.write_text("no video")
    square = tmp_path / "square.png"
    cv2.imwrite(str(square), np.zeros((300, 300, 3), np.uint8))
    empty = tmp_path / "empty"
    empty.mkdir()
    for path in (broken, text, square, empty, tmp_path / "missing.png"):
        with pytest.raises(InputError) as refused:
            call(str(path))
        assert refused.value.where == str(path)
    with pytest.raises(InputError) as refused:
        call(str(REST_FRAME), "--overlay", str(tmp_path / "no" / "x.mp4"))
    assert "x.mp4" in refused.value.where


def test_a_folder_is_read_in_the_order_of_its_numbers(tmp_path: Path) -> None:
    for number in (10, 2, 1):
        image = np.full((240, 320, 3), number, np.uint8)
        cv2.imwrite(str(tmp_path / f"f{number}.png"), image)
    shutil.copy(GELSIGHT / "README.md", tmp_path / "notes.md")
    frames = list(read_pictures(tmp_path))
    assert [int(frame.image[0, 0, 0]) for frame in frames] == [1, 2, 10]
    assert [frame.t_s for frame in frames] == [0.0, 0.04, 0.08]


def test_a_clip_has_its_450_frames_at_its_own_rate() -> None:
    assert count_pictures(CLIP) == 450
    first, second, *_ = list(read_pictures(CLIP))
    assert second.t_s - first.t_s == pytest.approx(0.04)


def test_larger_pictures_are_scaled_to_the_same_places(tmp_path: Path) -> None:
    large = tmp_path / "large.png"
    image = cv2.imread(str(REST_FRAME))
    cv2.imwrite(str(large), cv2.resize(image, (1280, 960), interpolation=cv2.INTER_CUBIC))
    scaled = next(read_pictures(large))
    plain = TactileFrame("left", 0, 0.0, image)
    own, other = (MarkerTracker("left").track(f).position_px for f in (plain, scaled))
    assert np.abs(own - other).max() < 0.1


NOISE_PX = 0.05
GRIP_HEIGHT_MM, WIDTH_MM = 33.0, 30.0


class Disc:
    def contains(self, points_mm: np.ndarray, /) -> np.ndarray:
        return np.hypot(points_mm[..., 0], points_mm[..., 1]) <= 9.0


def face_points() -> np.ndarray:
    axis = np.arange(-13.0, 14.0)
    points = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    return points[np.hypot(points[:, 0], points[:, 1]) <= 12.7]


def pressed_press_slip(mu_grip: float, count: int = 12) -> tuple[list[Recording], np.ndarray]:
    """Return presses at random places, slightly tilted, and their true vertical slip (count,)."""
    rng = np.random.default_rng(11)
    spread = SimulationSettings(preset="off")
    draw = (
        nuisance.draw_mounting(spread, rng),
        nuisance.draw_gripping(spread, 10.0, rng),
        nuisance.draw_probe(spread, rng),
    )
    conditions = replace(
        nuisance.conditions_from_draws(
            spread, ProbeSettings(), GRIP_HEIGHT_MM, WIDTH_MM, [draw] * count
        ),
        mu_grip=np.full(count, mu_grip),
        slips=np.ones(count, dtype=bool),
        tilt_rad=rng.normal(0.0, 0.004, (count, 2)),
    )
    state = begin_probes(face_points(), Disc(), rng.uniform(-7, 7, (count, 2)), conditions)
    gel = build_gel((0.058, 0.058))
    fields: list[list[MarkerField]] = [[] for _ in range(count)]
    times, heights = np.arange(-7, 51) * 0.04 + 0.013, []
    for number, t_s in enumerate(times):
        command = np.zeros((count, 3))
        command[:, 2] = -2.0 * t_s if t_s < 0 else -1.5 * min(1.0, t_s / 1.5)
        height, shown_px = command[:, 2], np.zeros((count, 2, 63, 2))
        if t_s > 0:
            spring = mechanics.springs(conditions, state.relaxed, 0.04)
            state, solved = advance_probes(state, command, 0.04)
            unloaded = spring.hidden.copy()
            unloaded[:, :, :3] += solved.slip
            zero = mechanics.elastic_zero(command, unloaded, conditions.width_mm)
            height = height + (spring.give * (solved.q - zero)[:, :3])[:, 2]
            shown_px = gel.displacement_px(solved.strain, solved.normal_n, conditions.grip_force_n)
        heights.append(height)
        noisy = shown_px + NOISE_PX * rng.standard_normal(shown_px.shape)
        for k in range(count):
            for i, finger in enumerate(FINGERS):
                moved = noisy[k, i].copy()
                fields[k].append(
                    MarkerField(finger, number, t_s, moved + 99, moved, np.zeros(63, np.uint8), 1.0)
                )
    recordings = []
    for k in range(count):
        pose = np.zeros((len(times), 3))
        pose[:, 2] = [height[k] for height in heights]
        wrench = np.zeros((len(times), 6))
        recordings.append(
            Recording(times.copy(), wrench, tuple(fields[k]), (), times.copy(), pose, np.zeros(6))
        )
    return recordings, np.abs(solved.slip[:, :, 1]).max(axis=1)


@pytest.mark.parametrize(
    ("mu_grip", "least_mm", "most_mm"), [(0.8, 0.0, 0.0), (0.4, 0.0, 0.11), (0.33, 0.15, 0.4)]
)
def test_slip_of_the_simulated_grasp(mu_grip: float, least_mm: float, most_mm: float) -> None:
    recordings, true_mm = pressed_press_slip(mu_grip)
    assert least_mm <= np.median(true_mm)
    assert true_mm.max() <= most_mm
    found_mm = np.array([press_slip_mm(recording, 0.0, 2.0) for recording in recordings])
    np.testing.assert_allclose(found_mm, true_mm, atol=0.04)


def test_what_cannot_be_judged_is_not_a_number() -> None:
    recording = pressed_press_slip(0.8, 1)[0][0]
    blind = replace(recording, pose_t_s=np.zeros(0), pose_mm=np.zeros((0, 3)))
    one_finger = replace(recording, fields=tuple(f for f in recording.fields if f.finger == "left"))
    still = replace(recording, pose_mm=np.zeros_like(recording.pose_mm))
    for incomplete in (blind, one_finger, still):
        assert np.isnan(press_slip_mm(incomplete, 0.0, 2.0))


LARGE = (
    "artificial_strawberry_exp2_camera_0.avi",
    "plug_3D_exp3_camera_2.avi",
    "screw_driver_red_exp1_camera_2.avi",
    "avocado_real_exp1_camera_2.avi",
    "blue_box_exp2_camera_2.avi",
)
SMALL = ("artificial_strawberry_exp2_camera_2.avi", "plug_3D_exp3_camera_0.avi")


def ordered_independently(dots: np.ndarray) -> np.ndarray:
    """Rows by v, which must be apart, then columns by u: no lattice and no tracking."""
    by_row = dots[np.argsort(dots[:, 1])].reshape(7, 9, 2)
    assert (by_row[1:, :, 1].min(axis=1) > by_row[:-1, :, 1].max(axis=1)).all()
    return np.concatenate([row[np.argsort(row[:, 0])] for row in by_row])


def test_rest_frame_has_the_published_places() -> None:
    table = np.loadtxt(GELSIGHT / "rest_positions.csv", delimiter=",", skiprows=1)
    frame = next(read_pictures(REST_FRAME))
    field = MarkerTracker("left").track(frame)
    assert (field.state == MarkerState.SEEN).all()
    assert field.quality == 1.0
    away = np.linalg.norm(field.position_px - table[:, 2:], axis=1)
    assert away.max() <= 0.3


def test_pressed_cuboid_frame_shows_63() -> None:
    frame = next(read_pictures(GELSIGHT / "cuboid_10-2-284.png"))
    tracker = MarkerTracker("left")
    field = tracker.track(frame)
    assert (field.state == MarkerState.SEEN).all()
    assert tracker.grid.complete
    assert "63" in tracker.grid.message
    independent = ordered_independently(plain_detector(frame.image))
    assert np.linalg.norm(field.position_px - independent, axis=1).max() < 2.0


def marked_dots(name: str) -> dict[int, np.ndarray]:
    """Dots marked by eye (63, 2) in px, by frame; the head of the file says how."""
    lines = (GELSIGHT / "marks.csv").read_text("utf-8").splitlines()
    rows = [line.split(",") for line in lines if line.startswith(name)]
    return {int(row[1]): np.array(row[2:], dtype=float).reshape(63, 2) for row in rows}


@pytest.mark.slow
@pytest.mark.parametrize("name", LARGE)
def test_450_frames_without_a_swap(name: str) -> None:
    tracker, marked = MarkerTracker("left"), marked_dots(name)
    assert len(marked) == 20
    seen, near, compared = [], 0, 0
    for frame in read_pictures(GELSIGHT / name):
        field = tracker.track(frame)
        seen.append(int((field.state == MarkerState.SEEN).sum()))
        assert (field.state != MarkerState.LOST).all()
        grid = field.position_px.reshape(7, 9, 2)
        assert np.diff(grid[:, :, 0], axis=1).min() > 16
        assert np.diff(grid[:, :, 1], axis=0).min() > 16
        if frame.sequence in marked:
            assert (field.state == MarkerState.SEEN).all()
            away = np.linalg.norm(field.position_px - marked[frame.sequence], axis=1)
            assert away.max() < 2.0
        if frame.sequence % 10 == 0:
            dots = plain_detector(frame.image)
            own = field.position_px[field.state == MarkerState.SEEN]
            near += int((cKDTree(dots).query(own)[0] <= 1.0).sum())
            compared += len(own)
            same = ordered_independently(dots)
            assert np.linalg.norm(field.position_px - same, axis=1).max() < 2.0
    assert len(seen) == 450
    assert seen[0] == 63
    assert np.sum(seen) >= 0.99 * 63 * 450
    assert near >= 0.98 * compared


@pytest.mark.parametrize("name", SMALL)
def test_small_dot_gel_is_named_and_never_misread(name: str) -> None:
    tracker = MarkerTracker("left")
    for frame in read_pictures(GELSIGHT / name):
        field = tracker.track(frame)
        assert field.quality == 0.0
        assert (field.state == MarkerState.LOST).all()
        assert "8x10 small-dot gel recognised" in tracker.grid.message
        if frame.sequence == 100:
            break


def test_sixty_starts_give_the_same_bits() -> None:
    frame = next(read_pictures(GELSIGHT / LARGE[0]))
    starts = {MarkerTracker("left").track(frame).position_px.tobytes() for _ in range(60)}
    assert len(starts) == 1


@pytest.mark.parametrize("gain", [0.75, 1.25])
def test_light_does_not_move_markers(gain: float, tmp_path: Path) -> None:
    picture = cv2.imread(str(REST_FRAME))
    lit = tmp_path / "lit.png"
    cv2.imwrite(str(lit), np.clip(gain * picture, 0, 255).astype(np.uint8))
    plain = next(read_pictures(REST_FRAME))
    before = MarkerTracker("left").track(plain).position_px
    after = MarkerTracker("left").track(next(read_pictures(lit))).position_px
    assert np.sqrt(((after - before) ** 2).sum(axis=1).mean()) < 0.05


@pytest.fixture(scope="module")
def face():
    return load_pieces().piece("pot").face.polygon(96)


@pytest.fixture(scope="module")
def board():
    """Calibrate with the piece in its jig, where it hides no dot."""
    return calibrate_scene_camera(drawn("pot", "circle15", (-80.0, 0.0)))


def drawn(piece, bottom, at_mm):
    """Return a picture of the piece pressed at a known place."""
    return render_scene(scene_of(piece, bottom), at_mm, 0.0, 0.0)


@pytest.mark.parametrize("bottom", ["circle15", "square15", "rect12x28"])
@pytest.mark.parametrize("at", [(0.0, 0.0), (6.0, -4.0), (-9.0, 5.0), (2.0, 9.0)])
@pytest.mark.parametrize("slip", [(0.0, 0.0), (1.0, 0.0), (-3.0, 0.5), (1.5, -2.0)])
def test_the_face_is_found_within_three_sigma(face, board, bottom, at, slip):
    true = np.add(at, slip)
    image = drawn("pot", bottom, tuple(true))
    _, packed = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])
    image = cv2.imdecode(packed, cv2.IMREAD_COLOR)
    seen = observe_offset(image, board, face, np.array(at))
    assert seen is not None
    assert np.abs(seen.offset_mm - true).max() < 0.25
    assert np.hypot(*(seen.offset_mm - true)) < 3 * seen.sigma_mm
    assert seen.sigma_mm < 0.2


def test_noise_and_blur_move_it_little(face, board):
    image = drawn("pot", "circle15", (4.0, 3.0))
    rng = np.random.default_rng(3)
    blurred = cv2.GaussianBlur(image, (0, 0), 1.2).astype(float)
    noisy = np.clip(blurred + rng.normal(0, 6, image.shape), 0, 255).astype(np.uint8)
    seen = observe_offset(noisy, board, face, np.array([3.0, 3.0]))
    assert seen is not None
    assert np.abs(seen.offset_mm - (4.0, 3.0)).max() < 0.35


def test_a_piece_farther_off_than_it_is_looked_for_or_none_is_not_measured(face, board):
    plain = np.full((480, 640, 3), 128, np.uint8)
    assert observe_offset(plain, board, face, np.zeros(2)) is None
    image = drawn("pot", "circle15", (12.0, 0.0))
    seen = observe_offset(image, board, face, np.zeros(2))
    assert seen is None or np.hypot(*(seen.offset_mm - (12.0, 0.0))) < 3 * seen.sigma_mm


REST_PX = load_gel_appearance().rest_px
PERIOD_S = 0.04


class Gels:
    """Two fingers whose markers rotate about their centre by given angles, and shift."""

    def __init__(self):
        self.fields = {finger: Stream[MarkerField](finger, 256) for finger in FINGERS}
        self.watch = TorsionSlipDetector(self.fields)
        self._count = 0

    def show(self, left_rad, right_rad, lost=0):
        """Process one frame of each finger; return True if a rotation was detected."""
        for finger, angle in zip(FINGERS, (left_rad, right_rad), strict=True):
            t_s = PERIOD_S * self._count + (0.02 if finger == "right" else 0.0)
            turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            middle = REST_PX.mean(axis=0)
            moved = (REST_PX - middle) @ turn.T + middle - REST_PX + [0.1, -0.4 * self._count]
            state = np.full(MARKERS, MarkerState.SEEN, np.uint8)
            moved[:lost], state[:lost] = 50.0, MarkerState.LOST
            field = MarkerField(finger, self._count, t_s, REST_PX + moved, moved, state, 1.0)
            self.fields[finger].put(t_s, field)
        self._count += 1
        return self.watch.update()


@pytest.fixture
def gels():
    made = Gels()
    for _ in range(5):
        assert not made.show(0.0, 0.0)
    return made


class Held:
    """Both fingers and a wrist at rest with noise, for ``TurnDetector``."""

    def __init__(self):
        self.fields = {finger: Stream[MarkerField](finger, 2048) for finger in FINGERS}
        self.wrench = SampleStream("wrench", 6, 65536)
        self.rng, self.now_s, self._count = np.random.default_rng(4), 0.0, 0
        self.watch = TurnDetector(self.fields, self.wrench)

    def rest(self, frames, turn_rad=0.0, load=(0.0,) * 6, turn_from=0):
        """Let frames pass; from frame ``turn_from`` on the markers turn and the hand is loaded."""
        began_s = self.now_s
        for k in range(frames):
            on = k >= turn_from
            angle = turn_rad * on
            rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            middle = REST_PX.mean(axis=0)
            moved = (REST_PX - middle) @ rotation.T + middle - REST_PX
            state = np.full(MARKERS, MarkerState.SEEN, np.uint8)
            t_s = self.now_s + np.linspace(0.001, PERIOD_S, 20)
            noise = self.rng.standard_normal((20, 6)) * np.repeat([0.1, 0.004], 3)
            self.wrench.put(t_s, noise + np.array(load) * on)
            self.now_s += PERIOD_S
            for finger in FINGERS:
                seen = moved + 0.05 * self.rng.standard_normal(moved.shape)
                at_px = REST_PX + seen
                field = MarkerField(finger, self._count, self.now_s, at_px, seen, state, 1.0)
                self.fields[finger].put(self.now_s, field)
            self._count += 1
        return began_s, self.now_s


def test_a_turn_within_a_hold_stands_out_of_noise_alone():
    held = Held()
    assert not held.watch.learn(*held.rest(10))
    assert held.watch.hold(*held.rest(25)) == 0.0
    assert held.watch.learn(*held.rest(30))
    quiet = [held.watch.hold(*held.rest(25)) for _ in range(40)]
    # A norm of 12 values; their deviations were measured on 30 frames.
    assert 2.0 < np.median(quiet) < 4.5
    assert max(quiet) < 8.0
    assert held.watch.hold(*held.rest(25, 0.02, turn_from=8)) > 10.0
    assert held.watch.hold(*held.rest(25, load=(0.0, 0.5, 0, 0.0, 0, 0), turn_from=8)) > 10.0


def test_a_piece_that_leans_more_from_hold_to_hold_grows():
    held = Held()
    held.watch.learn(*held.rest(30))
    for _ in range(6):
        assert held.watch.growth() == 0.0
        held.watch.keep(*held.rest(25))
    assert held.watch.growth() < 8.0
    held.watch.keep(*held.rest(25, load=(0.0, 0.1, 0, 0.012, 0, 0)))
    assert held.watch.growth() > 10.0
    assert held.watch.load() == pytest.approx([0.0, 0.1, 0, 0.012, 0, 0], abs=0.02)
    assert np.isnan(TurnDetector(held.fields, held.wrench).load()).all()


def test_a_signal_that_is_missing_gives_no_score():
    held = Held()
    held.watch.learn(*held.rest(30))
    since, now = held.rest(25)
    held.wrench.put(np.array([now + 0.001]), np.full((1, 6), np.nan))
    assert np.isfinite(held.watch.hold(since, now + 0.002))
    assert held.watch.hold(now + 10.0, now + 11.0) == 0.0
    still = Held()
    still.rng = SimpleNamespace(standard_normal=np.zeros)
    assert not still.watch.learn(*still.rest(30))  # a frozen sensor has no noise


@pytest.mark.promise("G1")
@pytest.mark.parametrize("angle", [-0.05, -0.0055, 0.0055, 0.05])
def test_a_piece_that_turns_is_seen_in_the_next_picture(gels, angle):
    assert gels.show(angle, -angle)
    assert gels.watch.turned_rad == pytest.approx(abs(angle), rel=1e-6)


def test_one_that_turns_over_some_pictures_is_seen_as_well(gels):
    assert any(gels.show(0.0027 * k, 0.0027 * k) for k in range(1, 5))


@pytest.mark.promise("G1")
@pytest.mark.parametrize(
    "turns",
    [[(0.0009 * k, 0.0009 * k) for k in range(40)], [(0.02 * (k % 2), 0.0) for k in range(20)],
     [(0.02, 0.0)] * 10 + [(0.02, 0.02)] * 10],
    ids=["a slow press", "one gel alone", "one gel after the other"],
)  # fmt: skip
def test_other_turns_of_the_gels_are_no_piece(gels, turns):
    assert not any(gels.show(*both) for both in turns)


def test_markers_that_are_lost_turn_nothing(gels):
    assert not any(gels.show(0.0, 0.0, lost=9 * (k % 3)) for k in range(20))
    assert gels.show(0.01, 0.01, lost=9)
    assert gels.watch.turned_rad == pytest.approx(0.01, rel=0.05)
