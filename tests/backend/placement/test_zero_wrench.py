"""Strategy that releases where the press causes no moment."""

from __future__ import annotations

import numpy as np
import pytest

from touchdown.backend.config.method import BeliefSettings, StackSettings
from touchdown.backend.core.faults import InputError
from touchdown.backend.core.values import ContactPatch
from touchdown.backend.geometry.outlines import circle, face_points
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.placement.strategies import (
    GraspedPiece,
    PlaceDecision,
    ProbeObservation,
    make_strategy,
)

FACE = face_points(circle(15.0))


def press(at_mm: tuple[float, float], rise_n: float = 7.6) -> np.ndarray:
    """Observation of a force growing by ``rise_n`` at ``at_mm``, sensor 150 mm above the face."""
    fz = np.linspace(0.4, 0.4 + rise_n, 20)
    x, y = at_mm
    seen = np.zeros((20, 258), np.float32)
    seen[:, -6:] = np.stack([0 * fz, 0 * fz, fz, 1e-3 * y * fz, -1e-3 * x * fz, 0 * fz], axis=1)
    return seen


def zero_wrench(
    *presses: np.ndarray, com: tuple[float, float] = (0.0, 0.0)
) -> tuple[PlaceDecision, bool]:
    settings = StackSettings(belief=BeliefSettings(half_extent_mm=16.0), strategy="zero-wrench")
    reasoner = make_strategy(GraspedPiece(com, 30.0, sensor_height_mm=120.0), settings, (0.0, 0.0))
    patch = ContactPatch(FACE.copy(), np.full(len(FACE), 0.9))
    for seen in presses:
        concluded = reasoner.conclude(ProbeObservation(seen, patch, (0.0, 0.0)))
    return concluded, reasoner.stable_at((0.0, 0.0))


def test_zero_wrench_lets_go_where_the_push_turns_nothing_and_follows_it_otherwise() -> None:
    under, stable = zero_wrench(press((0.3, -0.4)))
    assert (under.action.kind, stable) == ("release", True)
    beside, stable = zero_wrench(press((-5.0, 0.0)))
    assert (beside.action.kind, stable) == ("shift", False)
    assert beside.action.step_mm == pytest.approx((-3.0, 0.0), abs=1e-3)
    assert beside.stability.margin_mm == pytest.approx(-5.0, abs=1e-3)
    assert not under.map.log_odds.any()


def test_zero_wrench_lets_a_mug_go_where_the_push_acts_under_its_centre_of_mass() -> None:
    mug = load_pieces().top("mug").com_xy_mm
    under, stable = zero_wrench(press((1.8, -1.0)), com=mug)
    assert (under.action.kind, stable) == ("release", True)
    assert under.stability.centre_mm == pytest.approx(mug)
    beside, _ = zero_wrench(press((3.5, 1.5)), com=mug)
    # From the centre of mass to the push: 1.8 and 2.4 mm.
    assert beside.stability.margin_mm == pytest.approx(-3.0, abs=1e-3)
    assert beside.action.step_mm == pytest.approx((1.8, 2.4), abs=1e-3)


def test_zero_wrench_needs_a_push_and_gives_up_in_the_end() -> None:
    faint, stable = zero_wrench(press((0.0, 0.0), rise_n=1.0))
    assert (faint.action.kind, stable) == ("shift", False)
    last, _ = zero_wrench(*[press((5.0, 0.0))] * 8)
    assert last.action.kind == "give_up"


def test_without_the_height_of_the_sensor_no_moment_can_be_read() -> None:
    with pytest.raises(InputError, match="height of the wrist sensor"):
        make_strategy(
            GraspedPiece((0.0, 0.0), 30.0), StackSettings(strategy="zero-wrench"), (0.0, 0.0)
        )


def test_letting_go_untested_concludes_nothing() -> None:
    with pytest.raises(InputError, match="does not probe"):
        make_strategy(
            GraspedPiece((0.0, 0.0), 30.0), StackSettings(strategy="pick-and-place"), (0.0, 0.0)
        )
