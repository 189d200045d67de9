"""Targets of the known-truth test and of its extensions (docs/tracking.md)."""

from __future__ import annotations

from dataclasses import replace
from itertools import count
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.backend.bench.brisk import brisk_bench, brisk_method
from tests.backend.sensing.known_truth import (
    CASES,
    GELSIGHT,
    REST_FRAME,
    Case,
    Score,
    bump_field,
    known_truth,
    plain_detector,
    rest_dots,
    score,
    shear_field,
    shots,
    tracker_follower,
    upward_field,
    warp,
)
from tests.backend.sensing.test_picture_files import LARGE
from touchdown.backend.bench.assembly import simulated_session
from touchdown.backend.cli.track import rest_reference
from touchdown.backend.config.method import PolicySettings
from touchdown.backend.core.events import Event, PhaseEntered
from touchdown.backend.core.faults import InputError, RefusedError
from touchdown.backend.core.streams import RawStreams, SampleStream, Stream
from touchdown.backend.core.values import FINGERS, MarkerField, MarkerState, Recording, TactileFrame
from touchdown.backend.devices.gelsight.emulator import small_dots
from touchdown.backend.runs import RecordingOptions, StackRequest
from touchdown.backend.sensing import (
    STILL_S,
    LiveSensing,
    assemble_episode,
    has_moved,
    read_pictures,
)
from touchdown.backend.sensing.detector import Blobs, Detector, order_grid
from touchdown.backend.sensing.jpeg_damage import DamageCheckingTracker, shifted_along_rows
from touchdown.backend.sensing.live import looks_still
from touchdown.backend.sensing.tracker import HiddenMarkers, nearest_dots

LINE_FAST = np.concatenate([np.linspace(0, 30, 6), np.full(10, 30.0), np.linspace(30, 0, 6)])


@pytest.fixture(scope="module")
def scores() -> dict[Case, Score]:
    return known_truth()


def noise() -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(1))


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=lambda c: f"{c.amplitude:.0f}-{c.fault}")
def test_known_truth_targets(scores: dict[Case, Score], case: Case) -> None:
    result = scores[case]
    clean = 0.05 if case.amplitude == 6 else 0.06
    assert result.rms_seen <= (0.10 if case.fault in ("flick", "occl") else clean)
    assert result.end_drift <= 0.05
    assert result.wrong == 0
    assert result.lost == 0


@pytest.mark.slow
def test_dropped_frames_are_no_worse_than_clean_ones(scores: dict[Case, Score]) -> None:
    for amplitude in (6.0, 14.0):
        clean, dropped = scores[Case(amplitude, "none")], scores[Case(amplitude, "drop")]
        assert dropped.rms <= clean.rms + 0.002
        assert dropped.end_drift <= clean.end_drift + 0.005


@pytest.mark.slow
@pytest.mark.parametrize(("amplitude", "limit_px"), [(6.0, 1.0), (14.0, 2.0)])
def test_covered_dots_are_flagged_and_inferred(
    scores: dict[Case, Score], amplitude: float, limit_px: float
) -> None:
    result = scores[Case(amplitude, "occl")]
    assert result.late_flags == 0
    assert result.worst_covered <= limit_px


@pytest.mark.parametrize(
    ("amplitude", "field", "line", "most_px"),
    [(36.0, shear_field, None, 0.11), (30.0, bump_field, LINE_FAST, 0.10),
     (30.0, shear_field, LINE_FAST, 0.10)],
    ids=["more than a pitch", "six px per frame", "six px per frame, sheared"],
)  # fmt: skip
def test_long_and_fast_motion_keeps_identities(amplitude, field, line, most_px) -> None:
    moves = shots(Case(amplitude, "none"), noise(), field=field, line=line)
    result = score(moves, tracker_follower())
    assert result.wrong == 0
    assert result.rms_seen <= result.rms <= most_px
    assert result.end_drift <= 0.05


def test_a_row_that_leaves_the_image_comes_back_as_itself() -> None:
    line = np.concatenate([np.linspace(0, 20, 21), np.full(20, 20.0), np.linspace(20, 0, 21)])
    seen_at_top = []
    follow = tracker_follower()

    def watched(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        position, state = follow(image)
        seen_at_top.append(int((state[:9] == 0).sum()))
        return position, state

    result = score(shots(Case(20.0, "none"), noise(), field=upward_field, line=line), watched)
    assert min(seen_at_top) == 0
    assert seen_at_top[-1] == 9
    assert result.wrong == 0
    assert result.rms <= 0.10
    assert result.end_drift <= 0.05


@pytest.mark.parametrize("strength", [1.0, 4.0])
def test_printed_texture_between_the_dots_misleads_nobody(strength: float) -> None:
    rest, dots = rest_dots()
    pressed = cv2.imread(str(GELSIGHT / "cuboid_10-2-284.png"))
    texture = pressed - cv2.GaussianBlur(pressed.astype(float), (0, 0), 8)
    away = np.ones((240, 320))
    for place in (*dots, *plain_detector(pressed)):
        cv2.circle(away, (int(place[0]), int(place[1])), 11, 0, -1)
    soft = cv2.GaussianBlur(away, (0, 0), 1.5)[..., None]
    base = np.clip(rest + strength * soft * texture, 0, 255).astype(np.uint8)
    result = score(shots(Case(14.0, "none"), noise(), base=base), tracker_follower())
    assert result.wrong == 0
    assert result.rms <= 0.08


def test_dots_hidden_while_the_load_goes_are_found_again() -> None:
    line = np.concatenate([np.linspace(0, 14, 40), np.linspace(14, 0, 60), np.zeros(10)])
    moves = shots(Case(14.0, "occl"), noise(), line=line, occluded=range(40, 100))
    result = score(moves, tracker_follower())
    assert result.lost == 6 * 10  # covered for 60 frames, lost after 50
    assert result.worst_covered <= 2.0
    assert result.end_drift <= 0.05
    assert result.wrong == 0


REST_PX = 30.0 + 30.0 * np.stack(np.meshgrid(np.arange(9.0), np.arange(7.0)), axis=-1).reshape(
    -1, 2
)
MIDDLE = 3 * 9 + 4
GREY = np.full((240, 320, 3), 120, np.uint8)


class ToldTracker:
    """A marker tracker that sees what it is told."""

    def __init__(self) -> None:
        self.looks = np.full((63, 2), 50.0)
        self.position, self.state = REST_PX.copy(), np.full(63, MarkerState.SEEN, np.uint8)

    def remember(self) -> None:
        return None

    def recall(self, memory: None) -> None:
        return None

    def track(self, frame: TactileFrame) -> MarkerField:
        at, state = self.position.copy(), self.state.copy()
        return MarkerField("left", frame.sequence, frame.t_s, at, at - REST_PX, state, 1.0)


class Watched:
    """The check of damage around a ``ToldTracker``."""

    def __init__(self) -> None:
        self.told, self.checked, self.count = ToldTracker(), DamageCheckingTracker("left"), 0
        self.checked.tracker = self.told  # type: ignore[assignment]

    def refuses(self, moved: dict[int, tuple[float, float]], unseen: tuple[int, ...] = ()) -> bool:
        """Show one picture with some markers moved from rest and some unseen."""
        self.told.position, self.told.state[:] = REST_PX.copy(), MarkerState.SEEN
        for marker, step in moved.items():
            self.told.position[marker] += step
        self.told.state[list(unseen)] = MarkerState.INFERRED
        self.count += 1
        frame = TactileFrame("left", self.count, 0.04 * self.count, GREY, from_jpeg=True)
        return self.checked.track(frame) is None


@pytest.mark.parametrize(
    ("step", "refused"), [((0.0, 3.0), False), ((0.0, 4.5), True), ((-4.5, 0.0), True)]
)
def test_a_marker_that_leaves_its_neighbours_is_damage(step, refused) -> None:
    watched = Watched()
    assert not watched.refuses({})
    assert watched.refuses({MIDDLE: step}) is refused


def test_all_markers_may_not_jump_at_once() -> None:
    # A smooth jump away from the first markers: only its size tells that it is damage.
    share = np.clip(np.arange(63) // 9 / 3.0, 0.0, 1.0)
    jump = {k: (0.0, 7.6 * float(share[k])) for k in range(63)}
    watched = Watched()
    assert not watched.refuses({})
    assert watched.refuses(jump)


def test_a_marker_that_is_not_seen_cannot_be_torn_from_its_neighbours() -> None:
    watched = Watched()
    assert not watched.refuses({}, unseen=(MIDDLE,))
    assert not watched.refuses({MIDDLE: (0.0, 5.0)}, unseen=(MIDDLE,))
    assert not watched.refuses({MIDDLE: (0.0, 0.0)})


def test_a_marker_is_steady_after_three_pictures_in_a_row() -> None:
    watched = Watched()
    for unseen in ((MIDDLE,), (), (), (MIDDLE,)):
        assert not watched.refuses({}, unseen=unseen)
    for unseen in ((), (), ()):
        assert not watched.refuses({}, unseen=unseen)
    assert watched.refuses({}, unseen=(MIDDLE,))


def test_a_row_that_slides_along_itself_is_damage_and_one_across_is_not() -> None:
    along, across = np.zeros((2, 63, 2))
    along[18:27, 0] = -1.2
    across[18:27, 1] = 1.2
    assert shifted_along_rows(along)
    assert not shifted_along_rows(across)
    along[18:27, 0] = 0.7
    assert not shifted_along_rows(along)


def test_a_dot_at_the_end_of_the_reach_is_in_reach() -> None:
    dots = np.array([[13.0, 14.0]])
    assert nearest_dots(np.array([[10.0, 10.0]]), dots, 5.0).tolist() == [0]
    assert nearest_dots(np.array([[10.0, 10.0]]), dots, 4.999).tolist() == [-1]


@pytest.mark.parametrize("dots", [1, 2])
def test_false_dots_outside_the_grid_are_left_over(dots: int) -> None:
    outside = REST_PX[8 : 8 + 9 * dots : 9] + np.array([30.0, 0.0])
    ordered = order_grid(Blobs(np.concatenate([REST_PX, outside]), np.ones(63 + dots, dtype=bool)))
    assert ordered.report.complete
    np.testing.assert_array_equal(ordered.index, np.arange(63))


@pytest.mark.parametrize(
    ("step", "kept"),
    [((2.0, -1.5), (2.0, -1.5)), ((-3.0, 0.0), (-3.0, 0.0)), ((12.0, -16.0), (4.8, -6.4))],
)
def test_a_hidden_marker_keeps_its_deviation_of_at_most_eight_pixels(step, kept) -> None:
    hidden, seen = HiddenMarkers(REST_PX), np.ones(63, dtype=bool)
    position = REST_PX + np.array([4.0, -3.0])
    smooth = position[MIDDLE].copy()
    position[MIDDLE] += step
    hidden.fill(position, seen)
    seen = seen.copy()
    seen[MIDDLE] = False
    np.testing.assert_allclose(hidden.fill(position, seen)[MIDDLE] - smooth, kept, atol=1e-9)


def test_the_centre_of_a_slanted_dot_does_not_depend_on_the_start() -> None:
    dot = np.zeros((8 * 240, 8 * 320), np.float32)
    cv2.ellipse(dot, (1296, 950), (64, 32), 40.0, 0.0, 360.0, 1.0, -1)
    dark = cv2.GaussianBlur(cv2.resize(dot, (320, 240), interpolation=cv2.INTER_AREA), (0, 0), 1.0)
    detector = Detector()
    detector.look(np.dstack([(180.0 * (1.0 - 0.7 * dark)).astype(np.uint8)] * 3))
    away = np.array([[0.0, 0.0], [2.0, 1.0], [-2.0, 2.0], [3.0, -3.0], [4.0, 0.0], [0.0, -4.0]])
    found = detector.refine(np.array([161.5, 118.25]) + away).position_px
    np.testing.assert_allclose(found, np.broadcast_to([161.5, 118.25], found.shape), atol=0.1)
    assert np.ptp(found, axis=0).max() < 0.01


@pytest.mark.parametrize(("after_s", "missing"), [(4.74, 0), (6.0, 3), (7.05, 0)])
def test_frames_missing_outside_the_probe_do_not_count(after_s: float, missing: int) -> None:
    """The probe lasts from 5 to 7 s; after ``after_s`` three numbers of each finger are missing."""
    rest, seen = np.zeros((63, 2)), np.zeros(63, np.uint8)
    fields = [
        MarkerField(finger, k + 3 * (t_s > after_s), t_s, rest + 100.0, rest, seen, 1.0)
        for finger in FINGERS
        for k, t_s in enumerate((4.713 + 0.04 * np.arange(60)).tolist())
    ]
    t_s, pose_t_s = 4.7 + 1e-3 * np.arange(2400), 4.7 + 0.01 * np.arange(240)
    wrench, pose_mm = np.full((2400, 6), 5.0), np.full((240, 3), 30.0)
    recording = Recording(t_s, wrench, tuple(fields), (), pose_t_s, pose_mm, np.zeros(6))
    episode = assemble_episode(recording, onset_s=5.0, offset_mm=np.array([3.0, -1.0]), piece="pot")
    assert episode.quality.dropped_frames == 2 * missing


PRESSED = GELSIGHT / "cuboid_10-2-284.png"


def test_a_real_gel_at_rest_is_accepted() -> None:
    table = np.loadtxt(GELSIGHT / "rest_positions.csv", delimiter=",", skiprows=1)
    away = np.linalg.norm(rest_reference(REST_FRAME).position_px - table[:, 2:], axis=1)
    assert away.max() <= 0.3


@pytest.mark.promise("C7")
@pytest.mark.parametrize("name", [PRESSED.name, *LARGE])
def test_every_real_gel_in_contact_is_refused(name: str, tmp_path: Path) -> None:
    # One frame of each, so that it is not the motion of the clip that is refused.
    first = tmp_path / f"{name}.png"
    cv2.imwrite(str(first), next(read_pictures(GELSIGHT / name)).image)
    with pytest.raises(InputError, match="no-contact shape") as refused:
        rest_reference(first)
    assert refused.value.where == str(first)
    assert "--template" in refused.value.fix


@pytest.mark.promise("C6")
def test_a_gel_of_its_own_shape_is_checked_against_its_own_template() -> None:
    with pytest.raises(InputError, match="no-contact shape"):
        rest_reference(PRESSED, template=REST_FRAME)
    # Of a sensor known by nothing but this picture it is the rest by what the user says.
    assert rest_reference(PRESSED, template=PRESSED).frames == 1
    with pytest.raises(InputError, match="no-contact shape"):
        rest_reference(REST_FRAME, template=PRESSED)


def test_a_gel_that_moves_is_refused(tmp_path: Path) -> None:
    image, _ = rest_dots()
    for k, a in enumerate(np.linspace(0.0, 2.0, 10)):
        cv2.imwrite(str(tmp_path / f"{k}.png"), warp(image, bump_field, float(a)))
    with pytest.raises(InputError, match="moves by") as refused:
        rest_reference(tmp_path)
    assert refused.value.where == str(tmp_path)


def test_both_simulated_fingers_are_accepted_in_air_and_refused_in_the_press(
    tmp_path: Path,
) -> None:
    once = brisk_method().model_copy(update={"policy": PolicySettings(max_probes=1)})
    session = simulated_session(brisk_bench(), keep=RecordingOptions(None), method=once)

    def grab(fact: Event) -> None:
        if isinstance(fact, PhaseEntered) and (fact.phase, fact.probe) in (
            ("approach", 1),
            ("lift", 1),
        ):
            for finger in FINGERS:
                newest = session.frames[finger].newest()
                assert newest is not None
                cv2.imwrite(str(tmp_path / f"{fact.phase}-{finger}.png"), newest.image)

    session.events.subscribe(grab)
    session.run(StackRequest("pot", ("short",), seed=7))
    session.close()
    for finger in FINGERS:
        assert rest_reference(tmp_path / f"approach-{finger}.png").frames == 1
        with pytest.raises(InputError, match="no-contact shape"):
            rest_reference(tmp_path / f"lift-{finger}.png")


def live_sensing() -> LiveSensing:
    frames = {finger: Stream[TactileFrame](finger, 64) for finger in FINGERS}
    fields = {finger: Stream(finger, 64) for finger in FINGERS}
    raw = RawStreams(frames, SampleStream("ft", 6, 10), SampleStream("arm", 3, 10))
    return LiveSensing(raw, fields, SampleStream("wrench", 6, 10), np.zeros(6))


def test_the_press_force_is_that_of_the_newest_samples_and_unknown_once_they_are_old() -> None:
    sensing = live_sensing()
    assert np.isnan(sensing.press_n(0.0, 0.2))
    wrench = np.zeros((15, 6))
    wrench[:, 2] = np.arange(15)
    for k in range(15):
        sensing.wrench.put(np.array([0.001 * k]), wrench[k : k + 1])
    assert sensing.press_n(0.014, 0.2) == pytest.approx(9.5), "the last ten"
    assert sensing.press_n(0.2115, 0.2) == pytest.approx(13.0), "younger than 0.2 s"
    assert np.isnan(sensing.press_n(0.3, 0.2))


def test_markers_that_stand_still_on_an_idle_bench_are_tracked_every_tenth_of_a_second() -> None:
    sensing, clock, (image, _) = live_sensing(), count(), rest_dots()

    def tracked(*presses_px: float, still_s: float = STILL_S, from_jpeg: bool = False) -> list[int]:
        """Return which of the pictures were tracked."""
        first = sensing.raw.frames["left"].count
        before = sensing.fields["left"].count
        for press_px, k in zip(presses_px, clock, strict=False):
            shown = warp(image, bump_field, press_px)
            frame = TactileFrame("left", k, k / 25, shown, from_jpeg=from_jpeg)
            sensing.raw.frames["left"].put(k / 25, frame)
            sensing.update(still_s)
        return [f.sequence - first for f in sensing.fields["left"].since(before)[0]]

    assert tracked(*[0.0] * 4, still_s=0.0) == [0, 1, 2, 3]
    assert tracked(*[0.0] * 9) == [2, 5, 8]
    assert tracked(0.6, 1.2, 1.8, 2.4, 3.0, 3.6) == [2, 3, 4, 5], "motion is seen and followed"
    assert tracked(*[3.6] * 7) == [0, 3, 6]
    assert tracked(*[3.6] * 26, still_s=0.5) == [12, 25], "nobody sees them"
    assert tracked(*[3.6] * 4, still_s=0.0) == [0, 1, 2, 3], "a run needs every picture"
    assert tracked(*[3.6] * 4, from_jpeg=True) == [0, 1, 2, 3], (
        "damage is judged between neighbours"
    )


def test_markers_of_unknown_place_or_quality_do_not_stand_still() -> None:
    sensing, (image, _) = live_sensing(), rest_dots()
    sensing.raw.frames["left"].put(0.0, TactileFrame("left", 0, 0.0, image))
    sensing.update()
    field = sensing.fields["left"].newest()
    assert field is not None
    assert looks_still(field, field)
    lost = field.position_px.copy()
    lost[5] = np.nan
    for bad in (replace(field, position_px=lost), replace(field, quality=np.nan), None):
        assert not looks_still(field, bad)
        assert not looks_still(bad, field)


def test_a_marker_that_comes_or_goes_has_not_moved_and_one_that_is_seen_elsewhere_has() -> None:
    sensing, (image, _) = live_sensing(), rest_dots()
    sensing.raw.frames["left"].put(0.0, TactileFrame("left", 0, 0.0, image))
    sensing.update()
    field = sensing.fields["left"].newest()
    assert field is not None
    for by_px, state, moved in ((0.29, 0, False), (0.31, 0, True), (9.0, 1, False)):
        place, states = field.position_px.copy(), field.state.copy()
        place[5, 1] += by_px
        states[5] = state
        other = replace(field, position_px=place, state=states)
        assert has_moved(field, other) == has_moved(other, field) == moved
    assert has_moved(None, field)
    assert not has_moved(None, None)


def test_the_loop_refuses_a_later_reference_in_contact() -> None:
    sensing = live_sensing()
    frames, fields = sensing.raw.frames, sensing.fields
    clock = count()

    image, _ = rest_dots()

    def show(*presses_px: float) -> None:
        for press_px, k in zip(presses_px, clock, strict=False):
            shown = warp(image, bump_field, press_px)
            for finger in FINGERS:
                frames[finger].put(k / 25, TactileFrame(finger, k, k / 25, shown))
        sensing.update()

    show(*[0.0] * 10)
    rest = sensing.take_references(10)
    show(2.0, 4.0, *[6.0] * 5)
    with pytest.raises(RefusedError) as refused:
        sensing.take_references(5)
    assert refused.value.reason == "contact"
    # The reference in use stays the one taken at rest.
    newest = fields["left"].newest()
    assert newest is not None
    moved = newest.position_px - rest["left"].position_px
    np.testing.assert_allclose(newest.displacement_px, moved, atol=1e-9)
    show(4.0, 2.0, *[0.0] * 5)
    sensing.take_references(5)


@pytest.mark.promise("C7")
def test_a_reference_of_a_gel_with_another_grid_is_refused_and_names_it() -> None:
    sensing = live_sensing()
    frames = sensing.raw.frames
    image, _ = rest_dots()
    for k in range(3):
        for finger in FINGERS:
            shown = small_dots(image) if finger == "right" else image
            frames[finger].put(k / 25, TactileFrame(finger, k, k / 25, shown))
    sensing.update()
    with pytest.raises(RefusedError, match="right: 8x10 small-dot gel") as refused:
        sensing.take_references(3)
    assert refused.value.reason == "grid"
    assert sensing.references == {}
