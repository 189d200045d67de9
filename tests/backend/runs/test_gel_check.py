"""Gels are identified at connection: other, exchanged or mirrored ones are refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.backend.runs.gel_bench import LOOKS, Gel, GelBench
from touchdown.backend.devices.gelsight.emulator import other_gel, small_dots
from touchdown.backend.runs.calibrations import GelCheck

FINE = {finger: Gel(look, 3 + seed) for seed, (finger, look) in enumerate(LOOKS.items())}
LEFT = LOOKS["left"]


@pytest.fixture
def bench(tmp_path):
    made = GelBench(tmp_path, FINE)
    made.calibrate()
    yield made
    made.connection.close()


def drawn(rest_px) -> Gel:
    return Gel(replace(LEFT, rest_px=np.asarray(rest_px, dtype=float).reshape(63, 2)), 5)


@pytest.mark.promise("C6")
def test_the_same_gels_are_accepted_in_other_light_and_as_a_setting_mirrors_them(bench):
    bench.gels = {"left": Gel(LEFT, 90, (1.2, -0.8), 0.9), "right": FINE["right"]}
    assert bench.connect() == {}
    bench.mirror = "y"
    assert bench.connect() == {}
    assert bench.connection.ready


@pytest.mark.promise("C6")
def test_gels_that_changed_places_are_refused_and_whose_they_are_is_said(bench):
    bench.gels = {"left": FINE["right"], "right": FINE["left"]}
    bench.log.clear()
    found = bench.faults()
    assert {fault.code for fault in found.values()} == {"GEL-OTHER"}
    assert bench.connection.missing() == ("tactile_left", "tactile_right")
    assert found["tactile_left"].next_step.startswith("It is the gel of the right finger")
    assert "rms, limit 1" in found["tactile_left"].what
    assert bench.log.index("close tactile_left") < bench.log.index("connect arm")


@pytest.mark.promise("C6")
def test_one_other_gel_or_one_turned_round_is_refused_and_the_other_camera_stays(bench):
    bench.gels = {**FINE, "left": Gel(LEFT, 5, fitted=other_gel)}
    found = bench.faults()
    assert list(found) == ["tactile_left"]
    assert "exchanged" in found["tactile_left"].next_step
    assert "run 'touchdown calibrate camera --accept'" in found["tactile_left"].next_step
    # To follow that, any gel of the right grid can be connected.
    bench.connection.prove = GelCheck(
        None, bench.devices, bench.frames, lambda cancel: bench.shoot()
    ).prove
    assert bench.connect() == {}
    bench.connection.prove = bench.check.prove
    turned = LEFT.rest_px.reshape(7, 9, 2)[::-1] * [1, -1] + [0, 239]
    bench.gels = {**FINE, "left": drawn(turned)}
    assert "mirrored in y" in bench.faults()["tactile_left"].next_step


@pytest.mark.promise("C6")
def test_a_held_piece_may_press_the_dots_out_of_their_rest(bench):
    outwards = LEFT.rest_px + 1.5 * np.sign(LEFT.rest_px - [160, 120])
    bench.gels = {"left": drawn(outwards), "right": FINE["left"]}
    assert bench.connect() == {"tactile_left": "GEL-OTHER", "tactile_right": "GEL-OTHER"}
    bench.holding = True
    assert bench.connect() == {"tactile_right": "GEL-OTHER"}


@pytest.mark.promise("C6")
def test_a_calibration_without_a_fingerprint_stays_valid_and_says_so(tmp_path):
    bench = GelBench(tmp_path, FINE)
    bench.calibrate(fingerprint=False)
    standing = bench.store.status("camera", {})
    assert (standing.condition, standing.notice) == ("valid", "no fingerprint of the gels yet")
    bench.gels = {"left": FINE["right"], "right": FINE["left"]}
    assert bench.connect() == {}
    bench.connection.close()


@pytest.mark.promise("C7")
def test_a_camera_without_pictures_and_one_of_another_grid_are_named(bench):
    bench.gels = {"right": Gel(LOOKS["right"], 6, fitted=small_dots)}
    found = bench.faults()
    assert found["tactile_left"].code == "GEL-UNSEEN"
    assert found["tactile_right"].code == "GEL-GRID"
    assert "8x10 small-dot gel" in found["tactile_right"].what
