"""The physics engine beside the exact judge: agrees when clear, is named when it does not."""

from __future__ import annotations

import pytest

from backend.objects.catalogue import load_catalogue
from backend.objects.tower import Tower
from backend.simulation import scoring
from backend.simulation.scene import Scene

STILL = (0.0, 0.0)


def scene() -> Scene:
    catalogue = load_catalogue()
    tower = Tower((catalogue.bottom("short").body(),))
    return Scene(catalogue.top("pot"), tower, start_mm=(12.0, 0.0), seed=1)


def test_a_centred_piece_stands_for_both() -> None:
    assert scoring.second_opinion(scene(), (0.0, 0.0), 0.0, STILL) == (None, False)


def test_a_piece_over_the_edge_falls_for_both_and_the_motion_is_shown() -> None:
    opinion = scoring.second_opinion(scene(), (12.0, 0.0), 0.0, STILL)
    assert opinion is not None
    fall, contradicted = opinion
    assert fall is not None
    assert not contradicted
    top = fall.names.index("pot")
    assert fall.pose[-1, top, 2] < fall.pose[0, top, 2]


def test_the_kick_of_the_fingers_counts_for_both() -> None:
    at = (9.0, 0.0)
    assert scoring.margin_mm(scene(), at, 0.0) > 0.5
    opinion = scoring.second_opinion(scene(), at, 0.0, (3.0, 0.0))
    assert opinion is not None
    assert opinion[0] is not None
    assert not opinion[1]


def test_a_disagreement_beyond_its_error_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = scoring.simulate_release
    monkeypatch.setattr(scoring, "simulate_release", lambda *a, **k: (True, plain(*a, **k)[1]))
    opinion = scoring.second_opinion(scene(), (0.0, 0.0), 0.0, STILL)
    assert opinion is not None
    assert opinion[1]
