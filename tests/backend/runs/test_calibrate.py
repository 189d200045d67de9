"""Calibration plans on the simulated bench return its true parameters."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.backend.bench.brisk import on
from tests.backend.runs.blind_bench import BRISK, BlindBench
from touchdown.backend.bench.assembly import SimulatedBenchChoice, simulated_session
from touchdown.backend.calibration import FINGERPRINT_VALUES, CalibrationEstimate, CalibrationStore
from touchdown.backend.config.simulation import SimulationSettings
from touchdown.backend.core import (
    CalibrationMeasured,
    FaultError,
    InputError,
    PieceWeighed,
    RefusedError,
    Said,
)
from touchdown.backend.devices.interlock import LEAST_OVERRIDE, Limits
from touchdown.backend.devices.melfa.faults import VOID
from touchdown.backend.devices.protocols import Arm, CommandedMotion, Motion
from touchdown.backend.devices.streamed.arm import UNFELT
from touchdown.backend.emulation.simulated_disturbances import Disturbance, DisturbanceScript
from touchdown.backend.geometry import load_pieces, pieces_folder, with_true_com
from touchdown.backend.geometry.outlines import circle, rectangle, regular_polygon, square
from touchdown.backend.rig.safety import LAPSED
from touchdown.backend.runs import (
    CalibrateRequest,
    NoEstimator,
    RecordingOptions,
    StackRequest,
    calibrate,
    probe,
)
from touchdown.backend.runs.calibrate import (
    along_edges,
    measure_board,
    measure_payload,
    measure_tool,
    measure_wrist,
    weigh_empty,
    weigh_held,
)
from touchdown.backend.runs.jig import pick_piece
from touchdown.backend.runs.motions import (
    LEASE_TRIES,
    MOVE_S,
    REFERENCE_S,
    TOUCH_TRIES,
    middle_of_overlap,
    take_piece,
    zero_wrench,
)
from touchdown.backend.runs.motions import move_to as motions_move_to
from touchdown.backend.runs.stack import grasped_piece
from touchdown.backend.sensing.zeroing import take_reference
from touchdown.backend.simulation.devices.arm import SimArm


@pytest.fixture
def near(monkeypatch) -> None:
    """Search edges close to their expected position, with fewer touches."""
    monkeypatch.setattr(probe, "SEARCH_MM", 0.8)


def measured(blind: BlindBench, measure, request: CalibrateRequest) -> CalibrationEstimate:
    found = blind.run(lambda bench: measure(bench, request))
    assert isinstance(found, CalibrationEstimate)
    return found


def test_a_leaning_hand_weighs_the_gripper():
    request = CalibrateRequest("payload", seed=3)
    wrist = {"payload_kg": 1.2, "payload_com_mm": (4.0, -3.0, 50.0)}
    blind = BlindBench(request.scene(), changes={"wrist": wrist})
    found = measured(blind, measure_payload, request)
    assert found.acceptable
    truth = {"mass_kg": 1.2, "com_x_mm": 4.0, "com_y_mm": -3.0, "com_z_mm": 50.0 - 120.0}
    for quantity in found.quantities[:4]:
        assert abs(quantity.value - truth[quantity.name]) < 4.0 * quantity.sigma + 0.01
    # Level again, and clear of everything.
    assert blind.bench.arm.pose(1.0).rx_rad == pytest.approx(0.0, abs=1e-6)


def test_a_turned_sensor_is_found_by_the_weight():
    request = CalibrateRequest("wrist", seed=4)
    yaw = math.radians(5.0)
    blind = BlindBench(request.scene(), changes={"wrist": {"yaw_rad": yaw}})
    found = measured(blind, measure_wrist, request)
    assert found.value("yaw_rad") == pytest.approx(yaw, abs=4.0 * found.quantities[0].sigma)
    assert "5.0°" in found.obstacle


def test_an_arm_that_keeps_level_gives_what_it_can_and_says_so(monkeypatch):
    monkeypatch.setattr(SimArm, "rotates", property(lambda _self: False))
    request = CalibrateRequest("payload")
    blind = BlindBench(request.scene())
    found = measured(blind, measure_payload, request)
    assert found.value("mass_kg") == pytest.approx(1.5, abs=0.02)
    assert "height" in found.note
    with pytest.raises(RefusedError, match="CANNOT-TURN"):
        measured(BlindBench(request.scene()), measure_wrist, request)


def test_a_move_may_take_as_long_as_the_override_makes_it():
    blind = BlindBench(CalibrateRequest("payload").scene())
    blind.interlock.override_speed(LEAST_OVERRIDE)
    here = blind.bench.arm.pose(1.0)
    high = replace(here, z_mm=here.z_mm + 160.0)
    begun_s = blind.bench.now_s()
    # 5 mm/s: longer than any move at full speed.
    blind.run(lambda bench: motions_move_to(bench, high, "the hand to rise"))
    assert blind.bench.now_s() - begun_s > MOVE_S
    assert blind.bench.arm.pose(1.0).z_mm == pytest.approx(high.z_mm, abs=0.01)


class Lapsing:
    """Simulated arm whose first ``times`` motions are held by a lapsed lease."""

    def __init__(self, arm: Arm, times: int) -> None:
        self._arm, self.left = arm, times

    def __getattr__(self, name: str) -> object:
        return getattr(self._arm, name)

    def move_to(self, *order: object) -> Motion:
        motion = self._arm.move_to(*order)
        if self.left:
            self.left -= 1
            self._arm.halt()
            motion = CommandedMotion({})
            motion.end(LAPSED)
        return motion


@pytest.mark.parametrize("times", [LEASE_TRIES - 1, LEASE_TRIES])
def test_a_move_whose_permission_lapsed_is_ordered_again_but_not_for_ever(times):
    blind = BlindBench(CalibrateRequest("payload").scene(), arm=lambda arm: Lapsing(arm, times))
    here = blind.bench.arm.pose(1.0)
    high = replace(here, z_mm=here.z_mm + 5.0)
    if times < LEASE_TRIES:
        blind.run(lambda bench: motions_move_to(bench, high, "the hand to rise"))
        assert blind.bench.arm.pose(1.0).z_mm == pytest.approx(high.z_mm, abs=0.01)
    else:
        with pytest.raises(FaultError, match="LEASE-LAPSED"):
            blind.run(lambda bench: motions_move_to(bench, high, "the hand to rise"))


@pytest.mark.parametrize("bursts", [1, 40])
def test_a_spoilt_tare_of_the_empty_hand_is_taken_again_for_so_long(bursts):
    blind = BlindBench(CalibrateRequest("payload").scene())
    found = (Disturbance("force_torque", "nan", 0.2 + 0.15 * n, 0.1) for n in range(bursts))
    blind.simulated._script = DisturbanceScript(tuple(found))
    if bursts == 1:
        blind.run(zero_wrench)
    else:
        with pytest.raises(FaultError, match="TARE-REFUSED"):
            blind.run(zero_wrench)
    assert (blind.bench.now_s() >= REFERENCE_S) == (bursts > 1)


def test_a_held_piece_is_not_weighed_as_gripper():
    request = CalibrateRequest("payload")
    blind = BlindBench(request.scene())

    def grip_first(bench):
        yield from take_piece(bench)
        return (yield from measure_payload(bench, request))

    with pytest.raises(RefusedError, match="HOLDING"):
        blind.run(grip_first)


def test_the_board_is_where_the_bench_was_built_with_it(near):
    request = CalibrateRequest("board", seed=4, origin_mm=(0.3, -0.2))
    blind = BlindBench(request.scene())
    found = measured(blind, measure_board, request)
    assert found.residual <= found.limit
    assert len(found.residuals) == 13
    assert not any(isinstance(fact, Said) and "once more" in fact.text for fact in blind.facts)
    at_mm = np.array([found.value("x_mm"), found.value("y_mm")])
    assert np.abs(at_mm - blind.centres_mm[0]).max() <= 0.12
    # The simulated face touches at one height wherever it is.
    for slope in ("slope_x_rad", "slope_y_rad"):
        assert abs(found.value(slope)) < 0.02
    assert found.value("yaw_rad") == pytest.approx(0.0, abs=0.015)
    assert not blind.bench.gripper.status().holding


def test_a_board_beyond_its_limit_is_felt_once_more(near, monkeypatch):
    """One wrong edge spoils a round but not the calibration."""
    felt = []
    edge_mm = probe.edge_mm

    def felt_wrong(*args):
        at_mm = yield from edge_mm(*args)
        felt.append(at_mm)
        return at_mm + (0.32 if len(felt) == 1 else 0.0)

    monkeypatch.setattr(probe, "edge_mm", felt_wrong)
    request = CalibrateRequest("board", seed=4)
    blind = BlindBench(request.scene())
    found = measured(blind, measure_board, request)
    assert len(felt) == 16
    assert found.acceptable
    assert len(found.residuals) == 26
    at_mm = np.array([found.value("x_mm"), found.value("y_mm")])
    assert np.abs(at_mm - blind.centres_mm[0]).max() <= 0.12
    assert any(isinstance(fact, Said) and "once more" in fact.text for fact in blind.facts)


def test_the_face_is_found_in_the_hand_over_three_grips(near):
    request = CalibrateRequest("tool", bottom="circle15", seed=4)
    blind = BlindBench(request.scene())
    found = measured(blind, measure_tool, request)
    assert found.acceptable
    face_mm = np.array([found.value("face_x_mm"), found.value("face_y_mm")])
    assert len(blind.centres_mm) == 3
    assert np.abs(face_mm + np.mean(blind.centres_mm, axis=0)).max() <= 0.12


@pytest.mark.promise("R5")
@pytest.mark.parametrize(("voids", "fault"), [(2, UNFELT), (6, VOID)])
def test_a_void_touch_is_made_again_but_not_for_ever(voids, fault, monkeypatch):
    """With the faults of a real arm during a short dropout of replies or samples."""
    pressed = []
    press = SimArm.press

    def lost(arm, command):
        motion = press(arm, command)
        pressed.append(motion)
        if len(pressed) <= voids:
            motion.end(fault)
        return motion

    monkeypatch.setattr(SimArm, "press", lost)
    blind = BlindBench(CalibrateRequest("board", seed=4).scene())

    def height(bench):
        yield from pick_piece(bench)
        return (yield from probe.find_height(bench, np.zeros(2)))

    if voids == TOUCH_TRIES:
        with pytest.raises(FaultError, match="PRESS-VOID"):
            blind.run(height)
    else:
        assert blind.run(height) == pytest.approx(blind.bench.piece.grip_height_mm, abs=0.1)
    assert len(pressed) == min(voids + 1, TOUCH_TRIES)
    told = [fact.text for fact in blind.facts if isinstance(fact, Said)]
    assert [("is void" in text, "Touching again" in text) for text in told] == (
        len(pressed) - 1
    ) * [(True, True)]


def test_edges_are_felt_where_one_of_both_outlines_runs_along_the_other():
    round_on_square = along_edges(circle(15.0), rectangle(12.0, 28.0))
    assert (round_on_square.mm, round_on_square.yaw_of) == ((12.0, 4.0), "board")
    assert along_edges(square(30.0), circle(10.0)).yaw_of == "piece"
    assert along_edges(square(40.0), square(20.0)).mm == (8.0, 8.0)
    for face, bottom in (
        (circle(15.0), circle(20.0)),
        (square(15.0), square(15.0)),
        (circle(15.0), regular_polygon(6, 20.0)),
    ):
        assert along_edges(face, bottom).yaw_of == ""


def test_the_middle_of_an_overlap_is_its_centroid():
    middle = middle_of_overlap(square(10.0), square(10.0), np.array([4.0, -2.0]))
    np.testing.assert_allclose(middle, [2.0, -1.0], atol=1e-6)


@pytest.mark.slow
def test_pressing_at_the_rim_tells_how_the_cameras_sit(monkeypatch):
    # A few pictures per second: every one of them is drawn and tracked. Each side is pressed once.
    monkeypatch.setattr(calibrate, "PUSH_ROUNDS", 1)
    looks = []

    def taken(fields):
        looks.append(fields)
        if len(looks) <= 3:
            raise RefusedError("MARKERS", "62 of 63 markers are seen.")
        return take_reference(fields)

    monkeypatch.setattr(calibrate, "take_reference", taken)
    settings = SimulationSettings.model_validate({"tactile": {"rate_hz": 8.0}})
    session = simulated_session(
        SimulatedBenchChoice(given=settings), keep=RecordingOptions(None), method=BRISK
    )
    session.interlock.limits = Limits(contact_speed_mm_s=4.0)
    told = []
    on(session, CalibrationMeasured, told.append)
    session.run(CalibrateRequest("camera", seed=2))
    session.close()
    (found,) = told
    assert found.acceptable
    assert "agree with the settings" in found.note
    # A dot that was not seen for a moment was waited for.
    assert len(looks) == 5
    assert "known again by their dots" in found.note
    assert len(found.gels_px) == 2 * FINGERPRINT_VALUES
    # The pictures are those of a real gel: 0.058 by 0.060 mm per px.
    scales = dict(zip(found.names, found.values, strict=True))
    for finger in ("left", "right"):
        assert scales[f"{finger}_u_mm_px"] == pytest.approx(0.0585, rel=0.01)
        assert scales[f"{finger}_v_mm_px"] == pytest.approx(0.0602, rel=0.01)
    assert found.residual == pytest.approx(1.7, abs=0.4)


GRASP, TACTILE, WRIST = (
    {"shear_n_mm": 2.0},
    {"lost_share": 0.5, "lost_frames": 20},
    {"white_n": 0.4},
)
RESTLESS = ("number of markers", "noise at rest", "drift at rest")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "faults", "out"),
    [
        ({}, (), ()),
        ({"grasp": GRASP}, (), ("motion of the markers",)),
        ({"tactile": TACTILE, "wrist": WRIST}, ("force_torque:drift=0.02@0",), RESTLESS),
    ],
)
def test_the_daily_check_names_what_is_changed_on_the_bench(
    changes, faults, out, tmp_path, monkeypatch
):
    for name, value in (("DAY_RESTS", 2), ("DAY_REST_S", 1.5), ("DAY_PRESSES", 1)):
        monkeypatch.setattr(calibrate, name, value)
    changes = {**changes, "tactile": {**changes.get("tactile", {}), "rate_hz": 8.0}}
    settings = SimulationSettings.model_validate(changes)
    choice = SimulatedBenchChoice(given=settings, disturbances=faults)
    with simulated_session(choice, keep=RecordingOptions(None), method=BRISK) as session:
        session.interlock.limits = Limits(contact_speed_mm_s=4.0)
        session.calibrations = CalibrationStore(tmp_path, "simulated")
        told = []
        on(session, CalibrationMeasured, told.append)
        session.run(CalibrateRequest("day", seed=2))
        (found,) = told
        assert found.acceptable == (not out), found.obstacle
        said = session.day_checks.obstacle()
        assert [word for word in out if word not in said] == [], said
        assert ("left_stiffness_px_n" in found.names) == (len(out) < 2), "nothing was gripped"
        assert not session.devices["gripper"].status().holding


HEAVY = """
title = "Block"
roles = ["top"]
height_mm = 40.0
com_height_mm = 18.0
com_xy_mm = "unknown"
mass_g = 150.0
grip_height_mm = 28.0
face = { shape = "rectangle", x_mm = 20.0, y_mm = 24.0 }
"""


@pytest.fixture
def block() -> None:
    """Add a heavy piece whose centre of mass is unknown."""
    pieces_folder().mkdir(parents=True)
    (pieces_folder() / "block.toml").write_text(HEAVY)


def test_an_unknown_centre_of_mass_is_weighed_with_its_uncertainty(block):
    blind = BlindBench(StackRequest(piece="block", seed=5).scene())
    assert not blind.bench.piece.com_known
    true_mm = with_true_com(load_pieces().top("block"), 5).com_xy_mm

    def plan(bench):
        empty = yield from weigh_empty(bench)
        yield from take_piece(bench)
        return (yield from weigh_held(bench, empty))

    here = blind.bench.arm.pose(1.0)
    after = blind.run(plan)
    (said,) = [
        fact.text for fact in blind.facts if isinstance(fact, Said) and "weighs" in fact.text
    ]
    assert 0.25 <= after.com_sigma_mm <= 1.0
    assert np.hypot(*np.subtract(after.piece.com_xy_mm, true_mm)) <= 2.0 * after.com_sigma_mm
    assert grasped_piece(after).com_sigma_mm == after.com_sigma_mm
    (weighed,) = [fact for fact in blind.facts if isinstance(fact, PieceWeighed)]
    assert weighed.com_xy_mm == after.piece.com_xy_mm
    assert weighed.mass_g == pytest.approx(150.0, abs=4.0 * weighed.mass_sigma_g)
    assert "The piece weighs 1" in said
    back = blind.bench.arm.pose(1.0)
    assert (back.x_mm, back.y_mm, back.z_mm, back.rx_rad) == pytest.approx(
        (here.x_mm, here.y_mm, here.z_mm, 0.0), abs=0.05
    )


def test_a_light_piece_cannot_be_weighed_and_stays_in_the_hand():
    blind = BlindBench(StackRequest(piece="pot", seed=5).scene())

    def plan(bench):
        empty = yield from weigh_empty(bench)
        yield from take_piece(bench)
        yield from weigh_held(bench, empty)

    with pytest.raises(RefusedError, match="TOO-LIGHT"):
        blind.run(plan)
    assert blind.bench.gripper.status().holding


@pytest.mark.parametrize(
    ("piece", "weigh", "what", "fix"),
    [
        ("pot", True, "'pot' is too light to be weighed: the wrist sensor knows", "without weigh"),
        ("light", True, "too light to be weighed.*2.0 mm times the weight of 15 g", "com_xy_mm in"),
        ("block", False, "The centre of mass of 'block' is unknown", "--weigh"),
    ],
)
def test_what_cannot_be_weighed_or_is_not_is_refused_before_the_run(block, piece, weigh, what, fix):
    light = HEAVY.replace("mass_g = 150.0", "mass_g = 15.0")
    (pieces_folder() / "light.toml").write_text(light)
    session = simulated_session(
        SimulatedBenchChoice(), keep=RecordingOptions(None), estimate=lambda _: NoEstimator()
    )
    with pytest.raises(InputError, match=what) as refused:
        session.run(StackRequest(piece=piece, strategy="fused", weigh=weigh))
    assert fix in refused.value.fix
    session.close()
