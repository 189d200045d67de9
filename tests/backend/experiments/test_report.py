"""The report shows what the facts say: panels, maps, hulls, outcome, and that it was simulated."""

from __future__ import annotations

import base64
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from touchdown.backend.core.events import (
    ActionChosen,
    BeliefUpdated,
    Event,
    RunStarted,
    StabilityJudged,
    TrialFinished,
    TrialStarted,
)
from touchdown.backend.core.values import BeliefMap, Outcome, PlaceAction, Stability, SupportKind
from touchdown.backend.experiments.run_report import write_run_report

HULL = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 2.0], [0.0, 2.0]])


def belief() -> BeliefMap:
    log_odds = np.zeros((5, 7))
    log_odds[0, 0], log_odds[4, 6] = -20.0, 20.0
    return BeliefMap(log_odds, np.ones((5, 7), dtype=bool), (-3.0, -2.0), 1.0, 1)


def facts(outcome: Outcome = Outcome.PLACED, probes: int = 2, piece: str = "pot") -> list[Event]:
    told: list[Event] = [
        RunStarted(0.0, "r", piece, "short", "paper", 3, 1, True, "{}"),
        TrialStarted(0.0, 1, 3, (1.0, 2.0)),
    ]
    for n in range(1, probes + 1):
        kind = "release" if n == probes else "shift"
        told += [
            BeliefUpdated(1.0, belief(), n),
            StabilityJudged(
                1.0, Stability(True, 1.0, SupportKind.AREA, HULL, (1.0, 1.0), "belief"), n
            ),
            ActionChosen(1.0, PlaceAction(kind, (0.5, 0.0), None, False, f"reason {n}"), n, 2.0),
        ]
    told.append(TrialFinished(2.0, 1, 3, outcome, "it <stands>", probes, 0, 1.25))
    return told


def page(tmp_path: Path, *runs: list[Event]) -> str:
    path = tmp_path / "report.html"
    write_run_report(path, runs, {"short": np.array([[0.0, 0], [1, 0], [0, 1]])})
    return path.read_text("utf-8")


def test_one_panel_per_probe_and_one_row_per_trial(tmp_path: Path) -> None:
    text = page(tmp_path, facts(probes=2), facts(Outcome.FELL, probes=3))
    assert text.count('<div class="probe">') == 5
    assert "1 of 2 placed" in text
    assert "SIMULATED BENCH" in text
    assert "reason 3" in text
    assert "+1.25 mm" in text


@pytest.mark.promise("D9")
def test_text_from_outside_is_escaped(tmp_path: Path) -> None:
    text = page(tmp_path, facts(piece="<script>alert(1)</script>"))
    assert "<script>" not in text
    assert "it &lt;stands&gt;" in text


def test_the_page_needs_nothing_from_elsewhere(tmp_path: Path) -> None:
    text = page(tmp_path, facts())
    assert not re.findall(r"(?:href|src)=\"(?!data:)", text)


def test_the_picture_is_the_belief_with_y_up(tmp_path: Path) -> None:
    text = page(tmp_path, facts(probes=1))
    data = re.search(r"data:image/png;base64,([A-Za-z0-9+/=]+)", text)
    assert data is not None
    image = cv2.imdecode(np.frombuffer(base64.b64decode(data[1]), np.uint8), cv2.IMREAD_COLOR)
    assert image.shape == (5, 7, 3)
    brightness = image.astype(int).sum(axis=2)
    assert np.unravel_index(brightness.argmax(), brightness.shape) == (0, 6)
    assert np.unravel_index(brightness.argmin(), brightness.shape) == (4, 0)


def test_the_hull_is_drawn_where_it_is(tmp_path: Path) -> None:
    text = page(tmp_path, facts(probes=1))
    drawn = re.findall(r'<polygon points="([^"]+)"', text)
    corners = [[float(v) for v in pair.split(",")] for pair in drawn[1].split()]
    assert np.array(corners) * [1, -1] == pytest.approx(HULL)


def test_an_interrupted_trial_says_so(tmp_path: Path) -> None:
    text = page(tmp_path, facts()[:-1])
    assert "interrupted" in text
    assert "0 of 1 placed" in text
