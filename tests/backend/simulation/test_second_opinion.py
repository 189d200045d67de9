"""MuJoCo beside the exact analysis: agreement in clear cases, report of contradictions."""

from __future__ import annotations

import pytest

from tests.backend.brisk import brisk_bench, brisk_method
from touchdown.backend.bench.assembly import simulated_session
from touchdown.backend.core.events import Event, TrialFinished
from touchdown.backend.core.values import Outcome
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.geometry.tower import Tower, TowerVerdict
from touchdown.backend.runs import messages
from touchdown.backend.runs.requests import StackRequest
from touchdown.backend.simulation import scene as scoring
from touchdown.backend.simulation.scene import Scene

STILL = (0.0, 0.0)


def scene() -> Scene:
    catalogue = load_pieces()
    tower = Tower((catalogue.bottom("short").body(),))
    return Scene(catalogue.top("pot"), tower, start_mm=(12.0, 0.0), seed=1)


def test_a_centred_piece_stands_for_both() -> None:
    assert scoring.mujoco_opinion(scene(), (0.0, 0.0), 0.0, STILL) == (None, False)


def test_a_piece_over_the_edge_falls_for_both_and_the_motion_is_shown() -> None:
    opinion = scoring.mujoco_opinion(scene(), (12.0, 0.0), 0.0, STILL)
    assert opinion is not None
    fall, contradicted = opinion
    assert fall is not None
    assert not contradicted
    top = fall.names.index("pot")
    assert fall.pose[-1, top, 2] < fall.pose[0, top, 2]


def test_the_kick_of_the_fingers_counts_for_both() -> None:
    at = (9.0, 0.0)
    assert scoring.true_margin_mm(scene(), at, 0.0) > 0.5
    opinion = scoring.mujoco_opinion(scene(), at, 0.0, (3.0, 0.0))
    assert opinion is not None
    assert opinion[0] is not None
    assert not opinion[1]


def test_a_disagreement_beyond_its_error_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = scoring.simulate_release
    monkeypatch.setattr(scoring, "simulate_release", lambda *a, **k: (True, plain(*a, **k)[1]))
    opinion = scoring.mujoco_opinion(scene(), (0.0, 0.0), 0.0, STILL)
    assert opinion is not None
    assert opinion[1]


def ended(margin_mm: float, fallen: bool, monkeypatch: pytest.MonkeyPatch) -> TrialFinished:
    """Pick and place at a true margin; the engine says ``fallen``."""
    plain = scoring.simulate_release
    monkeypatch.setattr(scoring, "simulate_release", lambda *a, **k: (fallen, plain(*a, **k)[1]))
    monkeypatch.setattr(scoring, "true_margin_mm", lambda *_: margin_mm)
    monkeypatch.setattr(scoring, "judge_tower", lambda *_: TowerVerdict((margin_mm,), ("pot",)))
    session = simulated_session(brisk_bench(), method=brisk_method(), animate=True)
    ends: list[Event] = []
    session.events.subscribe(ends.append)
    session.run(StackRequest(strategy="pick-and-place"))
    session.close()
    (end,) = [fact for fact in ends if isinstance(fact, TrialFinished)]
    return end


@pytest.mark.parametrize(
    ("margin_mm", "fallen", "contradicted"),
    [(0.19, True, False), (0.21, True, True), (-0.21, False, True), (-0.21, True, False)],
)
def test_a_trial_says_what_the_second_judge_contradicts(
    margin_mm: float, fallen: bool, contradicted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    end = ended(margin_mm, fallen, monkeypatch)
    assert end.contradicted is contradicted
    assert (messages.CONTRADICTED in end.reason) == contradicted
    # The exact judge decides all the same.
    assert end.outcome is (Outcome.PLACED if margin_mm > 0 else Outcome.FELL)


def test_without_the_engine_the_trial_says_that_nobody_was_asked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(scoring, "mujoco_available", lambda: False)
    assert ended(1.0, True, monkeypatch).contradicted is None
