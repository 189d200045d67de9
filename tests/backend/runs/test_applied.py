"""An arm with a wrong frame reaches the true position after calibration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.backend.runs.blind_bench import BlindBench
from tests.backend.runs.skewed_arm import SkewedArm
from touchdown.backend.calibration.applied import UNCALIBRATED, calibrated_positions
from touchdown.backend.calibration.estimators import BOARD_LIMIT_MM
from touchdown.backend.calibration.records import CalibrationStore
from touchdown.backend.calibration.result import CalibrationEstimate, Quantity
from touchdown.backend.core.values import Pose
from touchdown.backend.runs import touch_probing
from touchdown.backend.runs.calibrate import measure_board
from touchdown.backend.runs.calibrations import contact_height_mm
from touchdown.backend.runs.jig import approach_with_piece, pick_piece, return_piece
from touchdown.backend.runs.motions import descent_start
from touchdown.backend.runs.requests import CalibrateRequest
from touchdown.backend.runs.touch_probing import BELOW_MM, touch_height_mm

OFF_MM = np.array([0.45, -0.4, -0.6])
TILT_RAD = np.array([0.01, 0.008, 0.0])
WANTED_MM = np.array([4.0, -3.0])
ABOUT = "pot on square15"


def touch_there(bench):
    """Touch at ``WANTED_MM`` as a campaign does; return position, expected and measured contact
    height.
    """
    yield from pick_piece(bench)
    centre = bench.placed.origin((0.0, 0.0), 0.2, bench.bottom)
    there = (centre.x_mm + WANTED_MM[0], centre.y_mm + WANTED_MM[1])
    start = descent_start(bench, there)
    yield from approach_with_piece(bench, start)
    felt_mm = yield from touch_height_mm(bench, np.array(there), start.z_mm, BELOW_MM)
    yield from return_piece(bench)
    return np.array(there), start.z_mm - bench.settings.probe.start_height_mm, felt_mm


def test_a_wrong_prior_is_put_right_by_the_board(tmp_path, monkeypatch):
    monkeypatch.setattr(touch_probing, "SEARCH_MM", 1.6)
    request = CalibrateRequest("board", seed=5)
    skewed = []

    def skew(arm):
        skewed.append(SkewedArm(arm, OFF_MM, TILT_RAD))
        return skewed[0]

    blind = BlindBench(request.scene(), "off", arm=skew)
    assert blind.bench.jig is not None
    jig_mm = [blind.bench.jig.x_mm, blind.bench.jig.y_mm, blind.bench.jig.z_mm]
    jig = Pose(*skewed[0].believed(np.array(jig_mm)).tolist())
    blind.bench = replace(blind.bench, jig=jig)
    found = blind.run(lambda bench: measure_board(bench, request))
    assert found.acceptable
    store = CalibrationStore(tmp_path, "simulated")
    store.accept(found.to_event(0.0, "board", ABOUT), {})
    used = store.in_use({}, required=False)
    placed = calibrated_positions(used)
    misses: dict[str, tuple[float, float]] = {}
    for name, known in (("calibrated", placed), ("not", UNCALIBRATED)):
        bench = replace(blind.bench, placed=known)
        there_mm, expected_mm, felt_mm = blind.run(lambda _, bench=bench: touch_there(bench))
        hand_mm = skewed[0].true(np.array([*there_mm, felt_mm]))[:2]
        off_mm = hand_mm - blind.centres_mm[-1] - WANTED_MM
        misses[name] = (np.abs(off_mm).max(), abs(felt_mm - expected_mm))
    assert max(misses["calibrated"]) <= BOARD_LIMIT_MM
    assert misses["not"][0] > 0.3
    assert misses["not"][1] > 0.4
    # Of another bottom it says nothing; with another piece, nothing of the height.
    assert placed.origin((0.0, 0.0), 0.2, "short") == UNCALIBRATED.origin((0.0, 0.0), 0.2, "short")
    assert placed.board is not None
    assert not placed.board.is_of("barrel", "square15")
    # The guard of the arm goes by the height that was felt, of this piece on this bottom alone.
    pot = blind.bench.piece
    assert contact_height_mm(pot, "square15", used) == found.value("z_mm")
    assert (
        contact_height_mm(pot, "short", used)
        == contact_height_mm(pot, "square15", {})
        == pot.grip_height_mm
    )
    assert abs(found.value("z_mm") - pot.grip_height_mm) > 0.3


def test_the_hand_stands_off_a_known_bottom_by_the_face(tmp_path):
    estimate = CalibrationEstimate(
        (Quantity("face_x_mm", 0.3, 0.05, "mm"), Quantity("face_y_mm", -0.2, 0.05, "mm")),
        np.eye(2), np.zeros(2), 0.05, 0.2, "mm",
    )  # fmt: skip
    store = CalibrationStore(tmp_path, "simulated")
    store.accept(estimate.to_event(0.0, "tool"), {})
    placed = calibrated_positions(store.in_use({}, required=False))
    at = placed.origin((10.0, 5.0), 0.2, "short")
    assert (at.x_mm, at.y_mm) == pytest.approx((9.7, 5.2))
    assert at.sigma_mm == pytest.approx(np.hypot(0.2, 0.05))
