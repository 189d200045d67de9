"""Plane and edges against the fit of numpy and against clipped outlines."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from shapely import affinity
from shapely.geometry import box

from touchdown.backend.calibration.estimators import (
    EDGE_SIGMA_MM,
    FELT_SIGMA_MM,
    FORCE_SIGMA_N,
    MOMENT_SIGMA_NM,
    PoseReadings,
    TouchedEdge,
    estimate_board,
    estimate_held_piece,
    estimate_level_payload,
    estimate_payload,
    estimate_tool,
    estimate_wrist,
    fit_edges,
    fit_plane,
)
from touchdown.backend.calibration.result import CalibrationEstimate
from touchdown.backend.config import WristSettings
from touchdown.backend.core import Pose, pose_rotation
from touchdown.backend.core.faults import RefusedError
from touchdown.backend.simulation.wrist_sensor import (
    Load,
    WristLoad,
    WristSampler,
    held_piece_load,
    wrist_wrench,
)

PLACES = np.array([[0, 0], [4, 4], [-4, 4], [4, -4], [-4, -4]], dtype=float)
TOUCHES = np.column_stack([PLACES, 30.0 + 0.004 * PLACES[:, 0] - 0.002 * PLACES[:, 1]])


def felt_edges(
    centre, yaw_rad, board=(40.0, 36.0), piece=(15.0, 15.0), along=8.0
) -> list[TouchedEdge]:
    """Return where a piece that is pushed off the board loses it, by shapely and halving."""
    ground = affinity.translate(
        affinity.rotate(box(-board[0] / 2, -board[1] / 2, board[0] / 2, board[1] / 2),
                        yaw_rad, origin=(0, 0), use_radians=True), *centre)  # fmt: skip
    held = box(-piece[0] / 2, -piece[1] / 2, piece[0] / 2, piece[1] / 2)
    edges = []
    for axis in range(2):
        for side in (-1.0, 1.0):
            for off in (-along, along):
                inside, outside = 0.0, 60.0
                while outside - inside > 1e-6:
                    middle = 0.5 * (inside + outside)
                    place = [off, off]
                    place[axis] = side * middle
                    if affinity.translate(held, *place).intersects(ground):
                        inside = middle
                    else:
                        outside = middle
                edges.append(TouchedEdge(axis, side, off, side * inside))
    return edges


SQUARE = felt_edges((0.0, 0.0), 0.0)


def test_the_plane_is_the_one_that_numpy_fits():
    rng = np.random.default_rng(0)
    touches = TOUCHES + np.array([0, 0, 0.05]) * rng.standard_normal(TOUCHES.shape)
    ours = fit_plane(touches)
    theirs = np.linalg.lstsq(np.column_stack([np.ones(5), PLACES]), touches[:, 2], rcond=None)[0]
    np.testing.assert_allclose(ours.x, theirs)


def test_edges_of_a_board_that_is_off_and_turned_give_place_and_yaw():
    found = fit_edges(felt_edges((0.8, -1.3), 0.02), yaw=True)
    # The turned corner stands out by a part of the second order.
    np.testing.assert_allclose(found.x[:2], [0.8, -1.3], atol=0.03)
    assert found.x[4] == pytest.approx(0.02, abs=2e-4)
    assert np.abs(found.residuals).max() < 0.02


def test_a_board_is_one_estimate_with_its_larger_residual():
    edges = felt_edges((0.8, -1.3), 0.01)
    found = estimate_board(TOUCHES, edges, "board")
    assert found.acceptable
    assert found.value("z_mm") == pytest.approx(30.0 + 0.004 * 0.8 + 0.002 * 1.3, abs=1e-3)
    assert found.value("slope_x_rad") == pytest.approx(0.004)
    bent = TOUCHES.copy()
    bent[0, 2] += 0.5
    assert estimate_board(bent, edges, "board").residual > 0.1
    off = [*edges[:-1], TouchedEdge(1, 1.0, 8.0, edges[-1].at_mm + 1.0)]
    assert not estimate_board(TOUCHES, off, "board").acceptable


@pytest.mark.parametrize(("yaw", "way"), [(0.05, " clockwise"), (-0.05, "counter-clockwise")])
def test_a_bottom_that_is_turned_is_turned_back_not_accepted(yaw, way):
    found = estimate_board(TOUCHES, felt_edges((0.0, 0.0), yaw), "board")
    assert found.residual <= found.limit
    assert not found.acceptable
    assert "2.9°" in found.obstacle
    assert way in found.obstacle
    # Of a piece that is held askew the bottom knows nothing.
    assert estimate_board(TOUCHES, felt_edges((0.0, 0.0), yaw), "piece").obstacle == ""


def test_round_edges_tell_no_yaw():
    found = estimate_board(TOUCHES, felt_edges((0, 0), 0.0, along=0.0), "")
    assert "yaw_rad" not in [q.name for q in found.quantities]
    assert "No yaw" in found.note


MASS_KG, COM_MM = 1.5, np.array([3.0, -2.0, -60.0])
BIAS = np.array([0.8, -1.2, 2.5, 0.03, -0.02, 0.01])
LEANS = np.radians([[0, 0, 0], [20, 0, 0], [-20, 0, 0], [0, 20, 0], [0, -20, 0], [14, 14, 0]])
TURNS = Rotation.from_rotvec(LEANS).as_matrix()
LEVEL = np.tile(np.eye(3), (6, 1, 1))
SIGMAS = np.repeat([FORCE_SIGMA_N, MOMENT_SIGMA_NM], 3)


def readings(turns: np.ndarray) -> np.ndarray:
    """Return the readings of a perfect sensor with a bias, pose by pose."""
    rows = []
    for turn in turns:
        force = turn.T @ [0.0, 0.0, -MASS_KG * 9.80665]
        rows.append(np.concatenate([force, np.cross(1e-3 * COM_MM, force)]) + BIAS)
    return np.array(rows)


def test_perfect_readings_give_the_truth():
    found = estimate_payload(TURNS, readings(TURNS))
    values = np.array([q.value for q in found.quantities])
    np.testing.assert_allclose(values, [MASS_KG, *COM_MM, *BIAS], atol=1e-9)
    assert found.residual < 1e-9
    assert found.acceptable


def test_the_covariance_is_that_of_repeated_measurements():
    rng = np.random.default_rng(2)
    perfect = readings(TURNS)
    values = [
        [q.value for q in estimate_payload(TURNS, noisy).quantities]
        for noisy in perfect + SIGMAS * rng.standard_normal((600, *perfect.shape))
    ]
    told = estimate_payload(TURNS, perfect).covariance
    size = np.sqrt(np.diag(told))
    np.testing.assert_allclose(np.cov(np.array(values).T) / np.outer(size, size),
                               told / np.outer(size, size), atol=0.18)  # fmt: skip


def test_a_cable_that_pulls_in_one_pose_is_not_accepted():
    pulled = readings(TURNS)
    pulled[2, 0] += 1.0
    found = estimate_payload(TURNS, pulled)
    assert found.residual > 0.3
    assert not found.acceptable


@pytest.mark.parametrize(
    ("turns", "reason"),
    [
        (TURNS[:5], "POSES"),
        (LEVEL, "DEGENERATE"),
        # About the vertical nothing changes for gravity.
        (Rotation.from_euler("z", np.arange(6)[:, None]).as_matrix(), "DEGENERATE"),
    ],
)
def test_poses_that_do_not_tell_are_refused(turns, reason):
    with pytest.raises(RefusedError) as refused:
        estimate_payload(turns, readings(turns))
    assert refused.value.reason == reason


def test_a_reading_that_is_no_number_is_refused():
    broken = readings(TURNS)
    broken[0, 0] = np.nan
    for estimate in (
        lambda: estimate_payload(TURNS, broken),
        lambda: estimate_level_payload(broken),
    ):
        with pytest.raises(RefusedError, match="NOT-FINITE"):
            estimate()


def test_a_wrong_sign_is_named():
    assert "ft.sign" in estimate_payload(TURNS, -readings(TURNS)).obstacle
    with pytest.raises(RefusedError, match=r"ft\.sign"):
        estimate_level_payload(-readings(LEVEL))


def test_a_level_hand_gives_mass_and_place_in_the_plane_and_says_what_it_leaves_open():
    level = readings(LEVEL) - BIAS
    found = estimate_level_payload(level)
    assert [q.name for q in found.quantities] == ["mass_kg", "com_x_mm", "com_y_mm"]
    np.testing.assert_allclose([q.value for q in found.quantities], [MASS_KG, *COM_MM[:2]])
    assert found.acceptable
    assert "height" in found.note
    assert not estimate_level_payload(level + BIAS).acceptable


FACE, BOTTOM = np.array([0.4, -0.3]), np.array([1.2, 2.5])


def leaning(yaw: float) -> np.ndarray:
    """Return the readings of a biased sensor rotated by ``yaw``, pose by pose."""
    rows = []
    for turn in TURNS:
        force = turn.T @ [0.0, 0.0, -1.5 * 9.80665]
        at_g = np.concatenate([force, np.cross([1.0, 2.0, 60.0], force)])
        rows.append(wrist_wrench(at_g, 120.0, yaw) + BIAS)
    return np.array(rows)


def scores_of(found: CalibrationEstimate, truth) -> list[float]:
    return [(q.value - t) / q.sigma for q, t in zip(found.quantities, truth, strict=True)]


def test_grips_that_scatter_are_not_accepted():
    scattered = BOTTOM - FACE + np.array([[0.0, 0.0], [0.6, 0.0], [0.0, -0.6]])
    assert not estimate_tool(BOTTOM, 0.1, scattered).acceptable


@pytest.mark.parametrize("yaw", [0.0, 0.02, -0.5, 1.6, 3.0])
def test_the_yaw_of_the_sensor_is_found_whatever_its_bias(yaw):
    found = estimate_wrist(TURNS, leaning(yaw))
    assert found.value("yaw_rad") == pytest.approx(yaw, abs=1e-9)
    assert found.value("mass_kg") == pytest.approx(1.5)
    assert found.residual < 1e-9
    assert bool(found.obstacle) == (abs(yaw) > 0.1)


def test_a_turned_sensor_is_no_payload():
    assert estimate_payload(TURNS, leaning(0.0)).acceptable
    assert not estimate_payload(TURNS, leaning(0.2)).acceptable


def edges_with_noise(rng: np.random.Generator) -> np.ndarray:
    noisy = [replace(edge, at_mm=edge.at_mm + EDGE_SIGMA_MM * rng.standard_normal())
             for edge in SQUARE]  # fmt: skip
    found = fit_edges(noisy, yaw=True)
    return (found.x / np.sqrt(np.diag(found.covariance)))[[0, 1, 4]]


def payload_with_noise(rng: np.random.Generator) -> list[float]:
    perfect = readings(TURNS)
    noisy = perfect + SIGMAS * rng.standard_normal(perfect.shape)
    return scores_of(estimate_payload(TURNS, noisy), [MASS_KG, *COM_MM, *BIAS])


def level_payload_with_noise(rng: np.random.Generator) -> list[float]:
    level = readings(LEVEL) - BIAS
    noisy = level + SIGMAS * rng.standard_normal(level.shape)
    return scores_of(estimate_level_payload(noisy), [MASS_KG, *COM_MM[:2]])


def grips_with_noise(rng: np.random.Generator) -> list[float]:
    grips = BOTTOM - FACE + FELT_SIGMA_MM * rng.standard_normal((5, 2))
    return scores_of(estimate_tool(BOTTOM + 0.1 * rng.standard_normal(2), 0.1, grips), FACE)


def yaw_with_noise(rng: np.random.Generator) -> list[float]:
    perfect = leaning(0.02)
    noisy = perfect + FORCE_SIGMA_N * rng.standard_normal(perfect.shape)
    return scores_of(estimate_wrist(TURNS, noisy), [0.02, 1.5])


@pytest.mark.parametrize(
    "draw",
    [edges_with_noise, payload_with_noise, level_payload_with_noise, grips_with_noise,
     yaw_with_noise],
)  # fmt: skip
def test_the_uncertainties_cover_the_truth_as_often_as_they_say(draw):
    rng = np.random.default_rng(1)
    scores = np.array([draw(rng) for _ in range(400)])
    # 68.3 %, give or take four standard deviations of 400 draws.
    assert (np.abs((np.abs(scores) < 1.0).mean(axis=0) - 0.683) < 0.093).all()
    assert np.abs(np.mean(scores, axis=0)).max() < 4.0 / np.sqrt(400)


def test_too_little_is_refused_by_name():
    edges = SQUARE
    for call, reason in (
        (lambda: fit_plane(TOUCHES[:3]), "TOUCHES"),
        (lambda: fit_plane(TOUCHES[[0, 1, 4, 1]]), "DEGENERATE"),
        (lambda: fit_edges(edges[:5], yaw=True), "EDGES"),
        (lambda: fit_edges([e for e in edges if e.side > 0] * 2, yaw=True), "DEGENERATE"),
        (lambda: fit_edges(felt_edges((0, 0), 0.0, along=0.0), yaw=True), "DEGENERATE"),
        (lambda: estimate_tool(BOTTOM, 0.1, np.zeros((2, 2))), "GRIPS"),
        (lambda: estimate_wrist(TURNS[:5], leaning(0.0)[:5]), "POSES"),
        (lambda: estimate_wrist(LEVEL, leaning(0.0)), "DEGENERATE"),
    ):
        with pytest.raises(RefusedError) as refused:
            call()
        assert refused.value.reason == reason


LEAN = math.radians(14.0)
HELD_POSES = [(0, 0), (LEAN, 0), (-LEAN, 0), (0, LEAN), (0, -LEAN), (0.7 * LEAN, 0.7 * LEAN)]


def read_poses(sampler, load, start_s, settings, rng):
    """Return the readings of a sequence of poses, from samples of the simulated wrist sensor."""
    now_us, rows = round(start_s * 1e6), []
    turns = [pose_rotation(Pose(0.0, 0.0, 0.0, rx, ry)) for rx, ry in HELD_POSES]
    for turn in turns:
        # The pose is repeated with an error that the arm does not report.
        real = pose_rotation(Pose(0.0, 0.0, 0.0, *rng.normal(0.0, 1e-4, 2))) @ turn
        wrench = sampler.payload.wrench_g(real)
        wrench = wrench if load is None else wrench + load.wrench_g(real)
        strain = WristLoad(wrench, wrench, np.zeros(6))
        for _ in range(6):  # move 2 s, settle and average 1 s
            t_s, values = sampler.samples(now_us, now_us + 500_000, strain)
            rows.append((t_s, values))
            now_us += 500_000
    means = [np.concatenate([v for _, v in rows[k + 4 : k + 6]]) for k in range(0, len(rows), 6)]
    times = [rows[k + 4][0][-1] for k in range(0, len(rows), 6)]
    return PoseReadings(
        np.array(times), np.stack(turns), np.stack([m.mean(axis=0) for m in means]),
        np.stack([m.std(axis=0, ddof=1) / math.sqrt(len(m)) for m in means]),
    ), 1e-6 * now_us  # fmt: skip


def weighed(seed, mass_g, com_mm, grasp_mm=0.5, gripper_mm=(4.0, -3.0, 60.0)):
    """Weigh a piece of centre ``com_mm`` (from the face, grip 30 mm above it)."""
    settings, rng = WristSettings(payload_com_mm=gripper_mm), np.random.default_rng(seed)
    sampler = WristSampler(settings, 500_000, seed)
    empty, now_s = read_poses(sampler, None, 0.0, settings, rng)
    g_x, g_z = rng.normal(0.0, grasp_mm, 2)
    load = held_piece_load(mass_g, com_mm, 30.0, (g_x, g_z))
    held, _ = read_poses(sampler, load, now_s + 10.0, settings, rng)
    return estimate_held_piece(empty, held, 30.0 + settings.height_mm)


@pytest.mark.parametrize("mass_g", [100.0, 300.0])
def test_weighed_centres_of_mass_lie_within_two_sigma_of_the_truth(mass_g):
    com = np.array([3.0, -2.0, 18.0])
    found = [weighed(seed, mass_g, tuple(com)) for seed in range(100)]
    sigma = np.array([one.sigma_mm for one in found])
    errors = np.array([one.com_mm for one in found]) - com
    assert sigma[:, :2].max() <= 1.0
    assert errors[:, :2].std(axis=0).max() <= 1.0
    within = (np.abs(errors) <= 2.0 * sigma).sum(axis=0)
    assert within.min() >= 90
    grams = np.array([(one.mass_g - mass_g) / one.mass_sigma_g for one in found])
    assert (np.abs(grams) <= 2.0).sum() >= 90
    # Neither too small nor far too large: the normalised errors have a variance near one.
    assert 0.5 <= (errors[:, 0] / sigma[:, 0]).std() <= 1.2


def test_a_light_piece_is_refused_with_its_weight_and_the_uncertainty():
    with pytest.raises(RefusedError, match=r"weighs 2\d g.*leave its centre of mass uncertain"):
        weighed(1, 24.0, (1.0, 0.0, 20.0))
    with pytest.raises(RefusedError, match="nothing can be weighed"):
        weighed(1, 0.01, (0.0, 0.0, 20.0))


def test_poses_that_are_too_few_or_do_not_lean_are_refused():
    turns = np.stack([np.eye(3)] * 6)
    level = PoseReadings(np.arange(6.0), turns, np.ones((6, 6)), np.full((6, 6), 0.01))
    with pytest.raises(RefusedError, match="DEGENERATE"):
        estimate_held_piece(level, level, 150.0)
    one = PoseReadings(np.arange(2.0), turns[:2], np.ones((2, 6)), np.full((2, 6), 0.01))
    with pytest.raises(RefusedError, match="too few"):
        estimate_held_piece(one, one, 150.0)


def test_without_noise_the_piece_is_found_exactly(monkeypatch):
    turns = np.stack([pose_rotation(Pose(0.0, 0.0, 0.0, rx, ry)) for rx, ry in HELD_POSES])
    hand, piece = (
        Load(1.5, (4.0, -3.0, 60.0)),
        held_piece_load(120.0, (3.0, -2.0, 18.0), 30.0, (0, 0)),
    )
    sigma = np.full((6, 6), 1e-3)
    alone = np.stack([wrist_wrench(hand.wrench_g(turn), 120.0) for turn in turns])
    both = np.stack([wrist_wrench(hand.wrench_g(t) + piece.wrench_g(t), 120.0) for t in turns])
    empty = PoseReadings(np.arange(6.0), turns, alone, sigma)
    held = PoseReadings(10.0 + np.arange(6.0), turns, both, sigma)
    found = estimate_held_piece(empty, held, 150.0)
    assert found.mass_g == pytest.approx(120.0, abs=1e-6)
    assert found.com_mm == pytest.approx((3.0, -2.0, 18.0), abs=1e-6)
    assert "The piece weighs 120.0" in found.words()
