"""What the estimator gets while the piece is still pressed is what the episode will hold."""

import pytest

from backend.config.method import EARLY_TICKS
from backend.core.facts import ActionChosen
from tests.backend.runs.oracle_bench import OracleSession, request


@pytest.mark.parametrize("preset", ["quiet", "hard"])
def test_the_early_ticks_are_those_of_the_episode_bit_for_bit(preset: str) -> None:
    bench = OracleSession(preset=preset)
    bench.session.run(request())
    decided = 0
    for oracle in bench.oracles:
        # A probe that was rejected was prepared for and never asked about.
        taken = {early.tobytes() for early in oracle.prepared}
        for episode in oracle.asked:
            assert episode.observation[:EARLY_TICKS].tobytes() in taken
            decided += 1
        assert all(early.shape == (EARLY_TICKS, 258) for early in oracle.prepared)
    assert decided == len(bench.of(ActionChosen)) > 0
