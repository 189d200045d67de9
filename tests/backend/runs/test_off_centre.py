"""Stacking of a piece whose centre of mass is off the centre of its face."""

from __future__ import annotations

import numpy as np
import pytest

from tests.backend.runs.oracle_bench import OracleSession, request
from touchdown.backend.core.events import (
    ActionChosen,
    EpisodeRecorded,
    StabilityJudged,
    TrialFinished,
)
from touchdown.backend.core.values import Outcome
from touchdown.backend.geometry.pieces import load_pieces


def test_a_mug_is_released_with_its_centre_of_mass_over_the_support() -> None:
    com = np.array(load_pieces().top("mug").com_xy_mm)
    bench = OracleSession(preset="quiet")
    bench.session.run(request(piece="mug"))
    (end,) = bench.of(TrialFinished)
    assert isinstance(end, TrialFinished)
    assert end.outcome is Outcome.PLACED
    probed, judged, chosen = map(bench.of, (EpisodeRecorded, StabilityJudged, ActionChosen))
    assert len(probed) == len(judged) == len(chosen) == end.probes > 1
    for probe, verdict in zip(probed, judged, strict=True):
        assert isinstance(probe, EpisodeRecorded)
        assert isinstance(verdict, StabilityJudged)
        off_mm = np.asarray(verdict.stability.centre_mm) - probe.episode.offset_mm
        np.testing.assert_allclose(off_mm, com, atol=1e-9)
    # Face and bottom are discs of 20 mm: the support is a lens, whose edges are theirs.
    truth = bench.benches[-1].truth()
    assert truth.stands is True
    over = np.asarray(truth.offset_mm) + com
    inside = 10.0 - max(np.hypot(*over), np.hypot(*com))
    assert end.margin_mm == pytest.approx(inside, abs=0.1)
    bench.session.close()
