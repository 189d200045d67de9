"""References are accepted from a gel at rest only, never from a gel in contact."""

from __future__ import annotations

from itertools import count
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.backend.brisk import brisk_bench, brisk_method
from tests.backend.sensing.known_truth import GELSIGHT, REST_FRAME, bump_field, rest_dots, warp
from tests.backend.sensing.test_real_gels import LARGE
from touchdown.backend.bench.assembly import simulated_session
from touchdown.backend.cli.track import rest_reference
from touchdown.backend.config.method import PolicySettings
from touchdown.backend.core.events import Event, PhaseEntered
from touchdown.backend.core.faults import InputError, RefusedError
from touchdown.backend.core.streams import SampleStream, Stream
from touchdown.backend.core.values import FINGERS, TactileFrame
from touchdown.backend.devices.gelsight.emulator import small_dots
from touchdown.backend.runs.recorder import RecordingOptions
from touchdown.backend.runs.requests import StackRequest
from touchdown.backend.sensing.live import LiveSensing, RawStreams
from touchdown.backend.sensing.picture_files import read_pictures

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


def test_the_loop_refuses_a_later_reference_in_contact() -> None:
    frames = {finger: Stream[TactileFrame](finger, 64) for finger in FINGERS}
    fields = {finger: Stream(finger, 64) for finger in FINGERS}
    raw = RawStreams(frames, SampleStream("ft", 6, 10), SampleStream("arm", 3, 10))
    sensing = LiveSensing(raw, fields, SampleStream("wrench", 6, 10), np.zeros(6))
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
    frames = {finger: Stream[TactileFrame](finger, 64) for finger in FINGERS}
    fields = {finger: Stream(finger, 64) for finger in FINGERS}
    raw = RawStreams(frames, SampleStream("ft", 6, 10), SampleStream("arm", 3, 10))
    sensing = LiveSensing(raw, fields, SampleStream("wrench", 6, 10), np.zeros(6))
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
