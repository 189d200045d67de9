"""What the Collect half says: recorder, time left, an empty pair, notes of the origin."""

import math
from types import SimpleNamespace

import pytest

from touchdown.app.collect.origin import (
    CampaignPace,
    OriginCheckNote,
    RecorderGauge,
    duration_text,
    origin_note,
    residual_text,
)
from touchdown.app.collect.probes import PairProbes, ProbeRecord, displacement_text, grip_text
from touchdown.app.collect.requests import probe_text
from touchdown.backend.geometry.pieces import load_pieces


@pytest.mark.promise("W18")
def test_the_gauge_counts_bytes_of_the_last_two_minutes(tmp_path):
    gauge = RecorderGauge()
    assert gauge.bytes_a_minute(0.0) == 0.0
    for second in range(0, 61, 10):
        gauge.note(float(second), 2_000_000)
    assert gauge.bytes_a_minute(60.0) == pytest.approx(12e6)
    assert gauge.bytes_a_minute(1000.0) == 0.0
    assert "GB free, 0.0 MB/min" in gauge.words(tmp_path, 1000.0)
    assert "does not answer" in gauge.words(tmp_path / "gone", 1000.0)


def test_the_time_left_follows_the_last_probes():
    pace = CampaignPace()
    pace.restart(0.0)
    assert pace.words(10) == ""
    for k in range(1, 5):
        pace.note(12.0 * k)
    assert pace.words(10) == "10 left, about 2 min at 12.0 s each"
    assert pace.words(0) == ""
    assert duration_text(3 * 86400) == "3 days"
    assert duration_text(3.5 * 3600) == "3 h 30 min"


def test_a_pair_without_a_probe_has_holes_only():
    catalogue = load_pieces()
    harvest = PairProbes(catalogue.piece("pot").face, catalogue.piece("circle15").face)
    assert harvest.covered.covered == 0.0
    assert harvest.newest == ""
    assert len(harvest.distribution(0, "").points_mm) == 0


def test_notes_that_make_no_sense_are_refused():
    assert origin_note(None) is None
    for bad in (3, {}, {"residual_mm": [1], "sigma_mm": 1, "at": "", "agrees": 1, "used": 0}):
        with pytest.raises(ValueError, match="no note"):
            origin_note(bad)
    far = OriginCheckNote((1.0, 0.0), 0.1, False, "2026-01-01 10:00")
    assert "does not agree" in residual_text(far)


def test_a_grip_in_words():
    assert grip_text("0190-campaign/mounting-2/grip-3") == "2.3"
    assert grip_text("g1") == "g1"


def test_a_displacement_in_words():
    assert displacement_text((1.234, -0.3)) == "+1.2, \N{MINUS SIGN}0.3"
    assert displacement_text((1.234, -0.3), 2, " mm") == "+1.23, \N{MINUS SIGN}0.30 mm"
    assert displacement_text((math.nan, math.nan), 2, " mm") == "none"


@pytest.mark.parametrize(
    ("offset_mm", "item", "said"),
    [((1.5, -0.25), 4, "x, y +1.50, \N{MINUS SIGN}0.25 mm, item 5, 1a2b3c4d"),
     ((math.nan, math.nan), None, "No displacement, no plan, 1a2b3c4d")],
)  # fmt: skip
def test_a_probe_says_what_is_not_known_of_it(offset_mm, item, said):
    quality = SimpleNamespace(accepted=True, slip_mm=0.0, dropped_frames=0)
    entry = SimpleNamespace(
        quality=quality, deleted=False, flagged=False, plan_item=item, uuid="0190-1a2b3c4d"
    )
    words = probe_text(ProbeRecord(entry, offset_mm), asking=False, running=False, back=True)
    assert words.where == said
