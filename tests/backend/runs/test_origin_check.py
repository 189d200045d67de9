"""The origin check finds the true position of the bottom within its uncertainty."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tests.backend.bench.brisk import PROBE, brisk_method
from tests.backend.runs.blind_bench import BlindBench
from tests.backend.runs.test_collect import collecting
from touchdown.backend.calibration.applied import HandPosition
from touchdown.backend.core.events import OriginChecked, RunFinished
from touchdown.backend.episodes.mcap_container import read_first
from touchdown.backend.runs.collector import check_origin
from touchdown.backend.runs.motions import take_piece
from touchdown.backend.runs.requests import SceneChoice
from touchdown.backend.simulation.conditions import true_offset_mm

pytestmark = pytest.mark.slow
# Some thirty touches, each from 1 mm above instead of 3: the way through the air is no claim.
LOW = brisk_method().model_copy(update={"probe": PROBE.model_copy(update={"start_height_mm": 1.0})})


def test_an_origin_that_is_right_agrees():
    blind = BlindBench(SceneChoice("pot", ("circle15",), seed=2), preset="quiet")

    def grip_and_check(bench):
        yield from take_piece(bench)
        return (yield from check_origin(bench, HandPosition(0.0, 0.0, 0.1)))

    check = blind.run(grip_and_check)
    assert check.agrees
    assert np.abs(check.residual_mm - blind.centres_mm[0]).max() <= 0.15


OFF_MM = (0.8, -1.3)


def test_the_felt_centre_is_where_the_bottom_is(tmp_path):
    with collecting(tmp_path / "ds", method=LOW) as collected:
        truth = []

        def look(fact):
            if isinstance(fact, OriginChecked):
                # The true displacement at the command (0, 0): what the origin should cancel.
                holding = collected.session._stage.scoring.bench._world.holding
                truth.append(-true_offset_mm(np.zeros((1, 2)), holding.conditions)[0])

        collected.session.events.subscribe(look)
        collected.run(count=1, check_origin=True, origin_mm=OFF_MM)
        (fact,) = collected.of(OriginChecked)
        assert collected.of(RunFinished)[-1].ending == "finished"
        error = np.array(fact.residual_mm) + OFF_MM - truth[0]
        # The piece in the grasp is part of the truth here, so that only touch and arm remain.
        assert np.abs(error).max() <= 0.15
        assert not fact.agrees
        path = collected.dataset.folder / collected.entries[0].path
        words = read_first(path).metadata["bench"]
        assert json.loads(words["origin"])["origin_mm"] == list(OFF_MM)
        np.testing.assert_allclose(
            json.loads(words["origin_check"])["residual_mm"], fact.residual_mm
        )


def test_a_bottom_far_away_is_refused(tmp_path):
    with collecting(tmp_path / "ds", method=LOW) as collected:
        collected.run(count=1, check_origin=True, origin_mm=(5.0, 0.0))
        ended = collected.of(RunFinished)[-1]
        assert ended.ending == "failed"
        assert "more than 3 mm" in ended.reason
        assert collected.entries == []
