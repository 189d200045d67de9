"""Labels compared with those of the most similar signals, on constructed signals."""

from __future__ import annotations

import math
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull, QhullError
from shapely.geometry import MultiPoint, Point

from touchdown.backend.annotations import Dataset, EpisodeContext, Label
from touchdown.backend.bench.assembly import shipped_model
from touchdown.backend.core.values import (
    ContactPatch,
    Episode,
    EpisodeQuality,
    FloatArray,
    SupportKind,
)
from touchdown.backend.geometry.outlines import circle, face_points, rectangle, square, true_patch
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.placement import (
    Ensemble,
    Estimator,
    OffsetFit,
    OffsetGrid,
    convex_hull,
    resting_contact,
    score_labels,
    sigmas_apart,
)
from touchdown.backend.placement.equilibrium import (
    centre_of_pressure_mm,
    inside_hull,
    pressed_at_mm,
    signed_margin_mm,
)
from touchdown.backend.placement.estimator import mix_fits
from touchdown.backend.placement.label_review import (
    ALIKE_FEWEST,
    DOUBT_FEWEST,
    FLOOR_MM,
    displacement_doubt,
    neighbour_residual,
    summarise_signals,
    training_order,
)
from touchdown.backend.simulation.batch import BatchPlan, simulate_episodes

COUNT, WRONG = 1500, 8
MIXED = np.random.default_rng(8).normal(size=(3, 6))


@pytest.fixture(scope="module")
def probes():
    """Places (mm), and six signals that bend with them; to the right they tell nothing of y."""
    rng = np.random.default_rng(3)
    at_mm = rng.uniform(-8, 8, (COUNT, 2))
    at_mm = at_mm[np.abs(at_mm[:, 0]) > 3]
    x, y = at_mm.T
    told_y = np.where(x > 0, 0.0, y)
    felt = np.stack([x, told_y, 0.05 * x**2], axis=1) @ MIXED
    felt += 0.05 * rng.normal(size=felt.shape)
    return at_mm, felt / felt.std(axis=0)


def test_labels_some_mm_off_come_first_where_signals_tell_the_place(probes):
    at_mm, felt = probes
    wrong = np.flatnonzero((at_mm[:, 0] < -4) & (np.abs(at_mm[:, 1]) < 6))[:WRONG]
    labels_mm = at_mm.copy()
    labels_mm[wrong] += [0.0, 2.5]
    found = neighbour_residual(felt, labels_mm)
    assert len(set(np.argsort(-found)[: 2 * WRONG].tolist()) & set(wrong.tolist())) >= WRONG - 1


def test_nothing_is_strange_where_alike_signals_have_labels_all_over(probes):
    at_mm, felt = probes
    blind = np.flatnonzero(at_mm[:, 0] > 3)
    labels_mm = at_mm.copy()
    labels_mm[blind[0], 1] = -at_mm[blind[0], 1]  # as good a guess as any other
    found = neighbour_residual(felt, labels_mm)
    assert found[blind].max() < 4.0


def test_the_distance_is_counted_in_that_of_the_others_by_hand():
    # One signal for all: the fit is the (robust) middle of the others' labels.
    labels_mm = np.zeros((ALIKE_FEWEST + 1, 2))
    labels_mm[0] = [2.0, 0.0]
    found = neighbour_residual(np.zeros((ALIKE_FEWEST + 1, 3)), labels_mm)
    assert found[0] == pytest.approx(2.0 / FLOOR_MM)
    assert found[1:].max() < 0.01


def test_few_episodes_tell_nothing():
    few = ALIKE_FEWEST - 1
    assert np.isnan(neighbour_residual(np.zeros((few, 3)), np.zeros((few, 2)))).all()


# Bench reference, table of section 3.8 (mushroom on circle15): Fx Fy Fz in N, Tx Ty in N·m at the
# wrist, and the centre of pressure in mm. Grip height 33 mm, sensor 120 mm above the pivot.
TABLE = [
    ((0.215, 0.0, 7.794, 0.0, -0.0256), (-0.95, 0.0)),
    ((0.0, 0.297, 7.798, 0.0343, 0.0), (0.0, -1.43)),
    ((0.794, 0.0, 7.699, 0.0, -0.0943), (-3.53, 0.0)),
    ((0.589, 0.795, 7.692, 0.0918, -0.0699), (-2.62, -3.89)),
    ((-1.364, 0.558, 7.511, 0.0643, 0.1619), (6.22, -2.79)),
]


@pytest.mark.parametrize(("five", "expected"), TABLE)
def test_published_centres_of_pressure(
    five: tuple[float, ...], expected: tuple[float, float]
) -> None:
    wrench = np.array([*five, 0.0])
    # Moments are printed to 0.1 N·mm: 0.05 / 7.7 N and the rounding of the forces remain.
    np.testing.assert_allclose(centre_of_pressure_mm(wrench, 153.0), expected, atol=0.03)


def test_the_short_formula_would_mislead() -> None:
    wrench = np.array([*TABLE[2][0], 0.0])
    assert centre_of_pressure_mm(wrench, 0.0)[0] == pytest.approx(12.2, abs=0.06)


def test_forces_at_known_points() -> None:
    rng = np.random.default_rng(4)
    lever_mm = 150.0
    places = np.column_stack((rng.uniform(-10, 10, (6, 2)), np.full(6, -lever_mm)))
    pushes = np.column_stack((rng.normal(0, 1, (6, 2)), rng.uniform(0.5, 3, 6)))
    moment_nm = 1e-3 * np.cross(places, pushes).sum(axis=0)
    wrench = np.concatenate((pushes.sum(axis=0), moment_nm))
    expected = (places[:, :2] * pushes[:, 2:]).sum(axis=0) / pushes[:, 2].sum()
    np.testing.assert_allclose(centre_of_pressure_mm(wrench, lever_mm), expected, atol=1e-9)


def test_without_press_there_is_no_centre() -> None:
    assert np.isnan(centre_of_pressure_mm(np.zeros(6), 153.0)).all()
    assert np.isnan(centre_of_pressure_mm(np.full(6, np.nan), 153.0)).all()
    series = np.zeros((3, 6))
    series[1, 2] = 5.0
    assert np.isfinite(centre_of_pressure_mm(series, 153.0)[:, 0]).tolist() == [False, True, False]


def press(at_mm: tuple[float, float], offset: FloatArray | float = 0.0) -> FloatArray:
    """Wrench (20, 6) at a sensor 150 mm above the face: a force growing at ``at_mm`` of the face,
    with a lateral part; ``offset`` (6,) is what the tare left.
    """
    fz = np.linspace(0.4, 8.0, 20)
    fx, fy = 0.1 * fz, -0.05 * fz
    x, y = at_mm
    tx, ty = y * fz + 150.0 * fy, -x * fz - 150.0 * fx
    zero = np.zeros_like(fz)
    return np.stack([fx, fy, fz, 1e-3 * tx, 1e-3 * ty, zero], axis=1) + offset


def test_what_the_tare_left_does_not_move_the_centre_of_pressure() -> None:
    left = np.array([0.4, -0.4, 0.3, 0.02, -0.03, 0.0])
    assert pressed_at_mm(press((-3.0, 2.0)), 150.0) == pytest.approx([-3.0, 2.0], abs=1e-9)
    assert pressed_at_mm(press((-3.0, 2.0), left), 150.0) == pytest.approx([-3.0, 2.0], abs=1e-9)
    assert np.isnan(pressed_at_mm(0.2 * press((0.0, 0.0)), 150.0)).all()


FACE, BOTTOM = circle(20.0), circle(15.0)
POINTS = face_points(FACE)


class Member:
    """Feels the true patch of one displacement, with a certainty of its own."""

    def __init__(self, name, offset_mm, sure=0.9, piece="pot"):
        self.card = SimpleNamespace(piece=piece, weights_sha256=name)
        touching = true_patch(POINTS, np.array([offset_mm]), BOTTOM)[0]
        self._p = np.where(touching, sure, 1 - sure)

    def estimate(self, _episode):
        return ContactPatch(POINTS.copy(), self._p)


@pytest.fixture(scope="module")
def grid():
    return OffsetGrid.of(POINTS, BOTTOM)


def test_the_mixture_by_hand():
    fit, spread_mm = mix_fits([OffsetFit((1.0, 0.0), 0.3), OffsetFit((3.0, 0.0), 0.5)])
    # Variance between, per axis: (1 + 0) / 2; own: (0.09 + 0.25) / 2.
    assert fit.offset_mm == (2.0, 0.0)
    assert spread_mm == pytest.approx(math.sqrt(0.5))
    assert fit.sigma_mm == pytest.approx(math.sqrt(0.5 + 0.17))


def test_one_member_is_what_it_says_alone(grid):
    member = Member("aa", (6.0, 2.0))
    alone, says = grid.fit(member.estimate(None)), Ensemble([member]).judge(None, grid)
    assert says.fit.offset_mm == pytest.approx(alone.offset_mm)
    assert says.fit.sigma_mm == pytest.approx(alone.sigma_mm)
    assert says.spread_mm == 0.0


def test_members_who_differ_know_less(grid):
    members = [Member("bb", (7.0, 0.0)), Member("aa", (5.0, 0.0))]
    says = Ensemble(members).judge(None, grid)
    fits = [grid.fit(member.estimate(None)) for member in members]
    assert says.fit.offset_mm[0] == pytest.approx(np.mean([f.offset_mm[0] for f in fits]))
    assert says.fit.sigma_mm > max(f.sigma_mm for f in fits) * 0.99
    p = np.mean([member.estimate(None).probability for member in members], axis=0)
    np.testing.assert_allclose(says.patch.probability, p)
    assert Ensemble(members).weights == Ensemble(members[::-1]).weights == "aa+bb"


def test_an_ensemble_is_of_one_piece():
    for members in ([], [Member("a", (0, 0)), Member("b", (0, 0), piece="barrel")]):
        with pytest.raises(ValueError, match="one piece"):
            Ensemble(members)


cells = st.lists(st.tuples(st.integers(-12, 12), st.integers(-12, 12)), max_size=60)
lengths = st.floats(-30, 30, allow_nan=False, width=32)


def cross(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> float:
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


@settings(max_examples=300, deadline=None)
@given(cells)
def test_corners_are_those_of_qhull_or_named_degenerate(points: list[tuple[int, int]]) -> None:
    array = np.array(points, dtype=np.int64).reshape(-1, 2)
    hull = convex_hull(array)
    distinct = np.unique(array, axis=0)
    if len(hull) < 3:
        assert len(hull) == min(len(distinct), 2)
        if len(distinct) > 2:
            assert np.linalg.matrix_rank(distinct - distinct[0]) < 2
        return
    try:
        oracle = ConvexHull(array)
    except QhullError as cause:
        raise AssertionError("qhull finds no area where we do") from cause
    expected = {(x, y) for x, y in array[oracle.vertices].astype(float)}
    assert {(x, y) for x, y in hull} == expected
    turns = [cross(hull[i - 2], hull[i - 1], hull[i]) for i in range(len(hull))]
    assert min(turns) > 0


@settings(max_examples=300, deadline=None)
@given(cells, lengths, lengths)
def test_margin_is_shapelys_signed_distance(
    points: list[tuple[int, int]], x: float, y: float
) -> None:
    array = np.array(points, dtype=np.float64).reshape(-1, 2)
    margin = signed_margin_mm(convex_hull(array), (x, y))
    if not len(array):
        assert margin == -math.inf
        return
    shape = MultiPoint([tuple(p) for p in array]).convex_hull
    place = Point(x, y)
    if shape.geom_type == "Polygon" and shape.covers(place):
        expected = shape.exterior.distance(place)
    else:
        expected = -shape.distance(place)
    assert margin == pytest.approx(expected, abs=1e-9)


@settings(max_examples=200, deadline=None)
@given(
    st.lists(st.tuples(lengths, lengths), min_size=3, max_size=30),
    st.tuples(lengths, lengths),
    st.floats(0, 2 * math.pi),
    st.tuples(lengths, lengths),
)
def test_margin_does_not_depend_on_the_frame(
    points: list[tuple[float, float]],
    place: tuple[float, float],
    angle: float,
    shift: tuple[float, float],
) -> None:
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    array = np.array(points)
    shape = MultiPoint(points).convex_hull
    # A hull thinner than rounding is a line in one frame and an area in another.
    assume(shape.area > 1e-3)
    before = signed_margin_mm(convex_hull(array), place)
    moved = turn @ np.array(place) + shift
    after = signed_margin_mm(convex_hull(array @ turn.T + shift), (moved[0], moved[1]))
    assert after == pytest.approx(before, abs=1e-4)


def test_a_square_by_hand() -> None:
    square = convex_hull(np.array([[0, 0], [4, 0], [4, 4], [0, 4], [2, 2], [2, 0], [4, 4]]))
    assert square.tolist() == [[0, 0], [4, 0], [4, 4], [0, 4]]
    assert signed_margin_mm(square, (2.0, 1.0)) == 1.0
    assert signed_margin_mm(square, (4.0, 2.0)) == 0.0
    assert signed_margin_mm(square, (7.0, 8.0)) == -5.0


def test_inside_agrees_with_the_margin() -> None:
    rng = np.random.default_rng(2)
    hull = convex_hull(rng.integers(-9, 10, (12, 2)))
    places = rng.uniform(-12, 12, (500, 2))
    by_margin = [signed_margin_mm(hull, (x, y)) >= 0 for x, y in places]
    assert inside_hull(hull, places).tolist() == by_margin
    assert inside_hull(hull, hull).all()
    assert not inside_hull(hull[:2], places).any()


LABEL_DOUBT_COUNT, LABEL_DOUBT_WRONG = 300, 8
FLAT_MM = 4.0
"""Within this radius the made-up signals do not depend on the displacement."""


def felt_at(offsets_mm, rng):
    """Six signals that bend with the displacement beyond ``FLAT_MM``; noisier to the right."""
    radius = np.maximum(np.linalg.norm(offsets_mm, axis=1), 1e-9)
    beyond = np.maximum(radius - FLAT_MM, 0.0)[:, None] * offsets_mm / radius[:, None]
    x, y = beyond.T
    clean = np.stack([x, y, np.sin(0.3 * x), np.cos(0.3 * y), 0.1 * x * y, x + y], axis=1)
    noise = 0.1 + 0.4 * (offsets_mm[:, :1] > 0)
    return clean + noise * rng.normal(size=clean.shape)


@pytest.fixture(scope="module")
def judged():
    rng = np.random.default_rng(4)
    true_mm = rng.uniform(-10, 10, (LABEL_DOUBT_COUNT, 2))
    felt = felt_at(true_mm, rng)
    labels_mm = true_mm.copy()
    outside = np.flatnonzero((np.linalg.norm(true_mm, axis=1) > 6.0) & (true_mm[:, 0] < -3))
    wrong = outside[:LABEL_DOUBT_WRONG]
    labels_mm[wrong] += [0.0, 2.0]
    felt /= felt.std(axis=0)
    return displacement_doubt(felt, labels_mm), felt, labels_mm, set(wrong.tolist())


def test_wrong_labels_come_first_and_where_nothing_is_felt_nothing_is_doubted(judged):
    found, felt, labels_mm, wrong = judged
    first = set(np.argsort(-found)[: 2 * LABEL_DOUBT_WRONG].tolist())
    assert len(wrong & first) >= LABEL_DOUBT_WRONG - 1
    inside = np.linalg.norm(labels_mm, axis=1) < FLAT_MM - 3.0
    assert np.percentile(found[inside], 90) < 0.2 * np.median(found[sorted(wrong)])
    assert (found >= 0).all()
    np.testing.assert_array_equal(found, displacement_doubt(felt, labels_mm))


def test_right_labels_are_doubted_alike_where_it_is_noisy_and_where_not(judged):
    found, _, labels_mm, wrong = judged
    right = np.array([k for k in range(LABEL_DOUBT_COUNT) if k not in wrong])
    noisy = labels_mm[right, 0] > 1
    high = [np.percentile(found[right][side], 90) for side in (noisy, ~noisy)]
    assert 1 / 3 < high[0] / high[1] < 3  # the noise itself differs by 5


def test_few_episodes_tell_nothing_label_doubt():
    few = DOUBT_FEWEST - 1
    assert np.isnan(displacement_doubt(np.zeros((few, 3)), np.zeros((few, 2)))).all()


def test_signals_are_few_and_scaled_alike():
    rng = np.random.default_rng(1)
    found = summarise_signals(rng.uniform(0, 1, (50, 200)), rng.normal(3, 9, (50, 6)))
    assert found.shape == (50, 16)
    np.testing.assert_allclose(found.std(axis=0), 1.0)
    np.testing.assert_allclose(found.mean(axis=0), 0.0, atol=1e-9)


EPISODES, LABEL_SCORES_WRONG = 60, 3
QUALITY = EpisodeQuality(True, (), 0, 0.0, 0, 0.0, 0.0)


@pytest.fixture
def dataset(tmp_path):
    """Simulated probes; the labels of the first few were moved by 8 mm."""
    catalogue = load_pieces()
    pot, bottom = catalogue.top("pot"), catalogue.bottom("circle15")
    plan = BatchPlan("pot", "circle15", pot.face, bottom.face, face_points(pot.face), 30.0, 30.0,
                EPISODES, 5, probes_per_grip=1, grips_per_mounting=1)  # fmt: skip
    batch = next(iter(simulate_episodes(plan)))
    rng = np.random.default_rng(0)
    with Dataset.open(tmp_path / "dataset", person="setup") as made:
        pair = made.geometry.store_pair(pot, bottom)
        context = EpisodeContext("s", "circle15", pair, "setup", "g", "m")
        for i in range(EPISODES):
            at = np.array(batch.offset_mm[i])
            turn = rng.uniform(0, 2 * np.pi)
            said = at + (
                8.0 * np.array([np.cos(turn), np.sin(turn)]) if i < LABEL_SCORES_WRONG else 0.0
            )
            x_um, y_um = np.rint(1e3 * said).astype(int).tolist()
            episode = Episode(f"e{i}", "pot", np.array(batch.observation[i]), at, 0.0, QUALITY)
            context = replace(context, grip_id=f"m/grip-{min(i, EPISODES - 2)}")
            made.record(episode, Label(x_um, y_um, 0, 300), source="commanded", context=context)
        yield made


@pytest.mark.slow
def test_wrong_labels_come_first(dataset):
    pot = load_pieces().top("pot")
    models = Ensemble([Estimator.load(shipped_model("pot"), pot)])
    wrong = {entry.uuid for entry in dataset.episodes()[:LABEL_SCORES_WRONG]}
    before = {entry.uuid: dataset.labels.head(entry.uuid) for entry in dataset.episodes()}
    seen = []
    count = score_labels(dataset, lambda piece: models, lambda k, n: seen.append((k, n)) is None)
    assert count == EPISODES
    assert seen[-1] == (EPISODES, EPISODES)
    order = dataset.queue("disagreement", "Ann")
    first = order[: 2 * LABEL_SCORES_WRONG]
    assert len(wrong & set(first)) >= 2  # base rate: 0.3 of these 6
    assert dataset.queue("doubt", "Ann") == []  # too few to tell what is felt where
    assert dataset.queue("disagreement", "Ann") == order
    assert len(wrong & set(dataset.queue("duplicates", "Ann")[: 2 * LABEL_SCORES_WRONG])) >= 2
    first, *others = dataset.queue("training", "Ann")
    assert len(others) == EPISODES - 2  # two probes are of one grip
    assert dataset.scores.of_revision("training", first)[1] == 1.0
    assert {entry.uuid: dataset.labels.head(entry.uuid) for entry in dataset.episodes()} == before
    suggestion = dataset.scores.suggestion(order[0])
    assert suggestion.source == f"model:{models.weights}"


@pytest.mark.slow
def test_stopping_keeps_what_was_found(dataset):
    models = Ensemble([Estimator.load(shipped_model("pot"), load_pieces().top("pot"))])
    assert score_labels(dataset, lambda piece: models, lambda k, n: k < 5) == 5
    order = dataset.queue("training", "Ann")
    assert len(order) == 5
    labels = dataset.labels
    for uuid in order[:2]:
        labels.accept("Ann", uuid, labels.head(uuid).label)
    labels.reject("Bob", order[0], "other")
    labels.reject("Bob", order[2], "other")
    assert score_labels(dataset, lambda piece: models, lambda k, n: k < 5) == 5
    # The accepted one stands for the episodes like it; rejected ones teach nothing.
    assert set(dataset.queue("training", "Ann")) == set(order[3:])
    left = [dataset.scores.of_revision("training", uuid)[1] for uuid in order[3:]]
    assert sorted(left) == [0.5, 1.0]


def clusters(*sizes, spread=0.02):
    """Return signals (n, 4, 258) of groups far apart, and the group (n,) of each."""
    rng, group = np.random.default_rng(3), np.repeat(np.arange(len(sizes)), sizes)
    middles = rng.normal(size=(len(sizes), 4, 258))
    return middles[group] + spread * rng.normal(size=(len(group), 4, 258)), group


def test_the_order_of_labels_takes_one_of_each_grip_as_often_as_their_signals_occur():
    signals, group = clusters(8, 16, 56)
    grips = [f"g{k // 4}" for k in range(80)]  # of four probes of one group
    known = [0, 8, 9, 16]  # part of a grip only
    order = training_order(signals, grips, known)
    assert len({grips[k] for k in order}) == len(order) == 20
    labelled = [k for k in range(80) if k in known or grips[k] in {grips[n] for n in order[:8]}]
    half = np.bincount(group[labelled]) / len(labelled)
    assert half == pytest.approx([0.1, 0.2, 0.7], abs=0.05)
    assert training_order(signals, grips, known, 5) == order[:5]
    assert training_order(signals, grips, range(80)) == []
    assert group[training_order(signals, grips, [], 1)[0]] == 2
    whole = [k for k in range(80) if grips[k] in ("g0", "g5")]
    assert len(training_order(signals, grips, whole)) == 18


def test_larger_grips_of_like_signals_are_labelled_first():
    signals, _ = clusters(12)
    grips = [*"abcdef", *6 * ["many"]]
    order = training_order(signals, grips, [])
    assert grips[order[0]] == "many"
    assert sorted(grips[k] for k in order[1:]) == [*"abcdef"]


def test_each_label_brings_the_labelled_signals_closest_to_all():
    """The maximum mean discrepancy with loops, of signals scaled by hand."""
    rng = np.random.default_rng(5)
    x = rng.normal(size=(24, 3))
    signals = np.zeros((24, 4, 258))
    signals[:, 0, 3], signals[:, 2, 253], signals[:, 3, 257] = x.T * [[0.4], [30.0], [0.02]]
    x = (x - x.mean(axis=0)) / x.std(axis=0)  # each kind of signal counts alike
    apart = [[math.dist(a, b) ** 2 for b in x] for a in x]
    alike = np.exp(-np.array(apart) / (2 * np.median(apart)))
    everything, taken = range(24), [17, 4, 9, 20]

    def gain(k):
        wanted = sum(alike[k][j] for j in everything) / 24
        return wanted - sum(alike[k][j] for j in taken) / (len(taken) + 1)

    for found in training_order(signals, range(24), taken[:4]):
        assert found == max((k for k in everything if k not in taken), key=gain)
        taken.append(found)
    assert len(taken) == 24


POT = face_points(circle(15.0))


def sure(offset_mm, bottom):
    """Return the patch of a model that is right and sure."""
    return ContactPatch(POT.copy(), np.where(true_patch(POT, offset_mm, bottom), 0.98, 0.02))


@pytest.mark.parametrize("bottom", [circle(15.0), square(15.0)])
@pytest.mark.parametrize("offset_mm", [(5.0, 0.0), (-3.2, 4.7), (0.4, -8.1), (7.0, 7.0)])
def test_a_perfect_patch_gives_its_displacement_back(bottom, offset_mm):
    found = OffsetGrid.of(POT, bottom).fit(sure(offset_mm, bottom))
    # Points 1 mm apart leave half of that open along each axis.
    assert np.abs(np.subtract(found.offset_mm, offset_mm)).max() <= 0.56
    assert found.sigma_mm < 0.8


def test_a_face_wholly_inside_the_bottom_does_not_say_where():
    wide = circle(25.0)
    grid = OffsetGrid.of(POT, wide)
    inside, over_edge = grid.fit(sure((0.5, 0.5), wide)), grid.fit(sure((9.0, 0.0), wide))
    assert inside.sigma_mm > 1.5 > 2 * over_edge.sigma_mm


def test_an_ignorant_patch_gives_the_spread_of_the_prior():
    grid = OffsetGrid.of(POT, circle(15.0))
    found = grid.fit(ContactPatch(POT.copy(), np.full(len(POT), 0.5)))
    assert found.offset_mm == pytest.approx((0.0, 0.0), abs=1e-6)
    radii = np.hypot(*grid.offsets_mm.T)
    assert found.sigma_mm == pytest.approx(math.sqrt((radii**2).mean() / 2), rel=0.01)


def test_what_is_no_patch_of_this_face_is_refused():
    grid = OffsetGrid.of(POT, circle(15.0))
    with pytest.raises(ValueError, match="points"):
        grid.fit(ContactPatch(np.zeros((3, 2)), np.zeros(3)))
    with pytest.raises(ValueError, match="probabilities"):
        grid.fit(ContactPatch(POT.copy(), np.full(len(POT), np.nan)))


def test_distance_in_joint_uncertainties():
    assert sigmas_apart((3.0, 4.0), 0.6, OffsetFit((0.0, 0.0), 0.8)) == pytest.approx(5.0)


@pytest.mark.slow
def test_displacements_of_simulated_episodes_are_found_within_their_uncertainty():
    """The shipped model on fresh probes of a bottom it was trained on."""
    catalogue = load_pieces()
    pot, bottom = catalogue.top("pot"), catalogue.bottom("circle15")
    plan = BatchPlan("pot", "circle15", pot.face, bottom.face, POT, 30.0, 30.0, 120, 99,
                probes_per_grip=1, grips_per_mounting=1)  # fmt: skip
    batches = list(simulate_episodes(plan))
    offset = np.concatenate([b.offset_mm for b in batches])
    observation = np.concatenate([b.observation for b in batches])
    model = Estimator.load(
        Path(str(files("touchdown.resources"))) / "models" / "pot.safetensors", pot
    )
    quality = EpisodeQuality(True, (), 0, 0.0, 0, 0.0, 0.0)
    grid = OffsetGrid.of(POT, bottom.face)
    fits = [
        grid.fit(model.estimate(Episode("e", "pot", seen, at, 0.0, quality)))
        for seen, at in zip(observation, offset, strict=True)
    ]
    error = np.array([f.offset_mm for f in fits]) - offset
    prior = float(np.sqrt((offset**2).mean()))
    assert np.sqrt((error**2).mean()) < 0.4 * prior
    relative = error / np.array([[f.sigma_mm] for f in fits])
    assert 0.6 < np.sqrt((relative**2).mean()) < 1.7


@pytest.mark.parametrize(("x_mm", "points"), [(0.0, 177), (5.0, 102), (8.0, 63)])
def test_published_counts_of_circle_15_on_circle_15(x_mm, points):
    assert resting_contact(POT, (0.0, 0.0), circle(15.0), (x_mm, 0.0)).touching.sum() == points


@pytest.mark.parametrize("offset", [(0.0, 0.0), (3.1, -2.2), (6.7, 4.0), (-9.9, 1.3)])
@pytest.mark.parametrize("bottom", [circle(18.0), square(15.0), rectangle(12.0, 28.0)])
def test_hull_and_margin_agree_with_shapely(offset, bottom):
    found = resting_contact(POT, (0.5, -0.25), bottom, offset)
    hull = MultiPoint(found.points_mm[found.touching]).convex_hull
    centre = Point(*found.centre_mm)
    assert found.centre_mm == pytest.approx((offset[0] + 0.5, offset[1] - 0.25))
    distance = hull.exterior.distance(centre)
    expected = distance if hull.covers(centre) else -distance
    assert found.margin_mm == pytest.approx(expected, abs=1e-9)
    assert found.stable == hull.covers(centre)


def test_a_quarter_turn_turns_everything():
    flat = resting_contact(POT, (0.5, 0.0), rectangle(12.0, 28.0), (5.0, 1.0))
    turned = resting_contact(POT, (0.5, 0.0), rectangle(28.0, 12.0), (-1.0, 5.0), math.pi / 2)
    quarter = np.array([[0.0, 1.0], [-1.0, 0.0]])
    assert np.allclose(flat.points_mm @ quarter, turned.points_mm)
    assert (flat.touching == turned.touching).all()
    assert turned.margin_mm == pytest.approx(flat.margin_mm)


def test_without_contact_there_is_no_hull():
    apart = resting_contact(POT, (0.0, 0.0), circle(15.0), (40.0, 0.0))
    assert (apart.support, apart.margin_mm, apart.stable) == (SupportKind.NONE, -math.inf, False)
    assert not apart.touching.any()


def test_near_the_edge_nobody_can_say():
    square_face = face_points(square(10.0))
    near = resting_contact(square_face, (0.9, 0.0), square(10.0), (4.0, 0.0))
    assert near.margin_mm == pytest.approx(0.1)
    assert near.too_close
    assert not resting_contact(square_face, (0.0, 0.0), square(10.0), (3.0, 0.0)).too_close


def test_a_displacement_must_be_a_number():
    with pytest.raises(ValueError, match="finite"):
        resting_contact(POT, (0.0, 0.0), circle(15.0), (math.nan, 0.0))
