"""Early ticks passed to the estimator equal those of the episode."""

import pytest

from tests.backend.brisk import brisk_method
from tests.backend.runs.oracle_bench import Oracle, OracleSession, request
from touchdown.backend.config.method import EARLY_TICKS, PolicySettings
from touchdown.backend.core.events import ActionChosen, Event
from touchdown.backend.core.scheduling import RepaintHold
from touchdown.backend.core.values import ContactPatch, Episode


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


def test_nobody_draws_beside_a_decision(monkeypatch: pytest.MonkeyPatch) -> None:
    method = brisk_method().model_copy(update={"policy": PolicySettings(max_probes=1)})
    bench = OracleSession(preset="quiet", method=method)
    session, after = bench.session, []
    session.repaint_hold = RepaintHold(lambda: 0.0)

    def choose(fact: Event) -> None:
        if isinstance(fact, ActionChosen):
            after.append(session.repaint_hold.on)

    session.events.subscribe(choose)
    asked: list[bool] = []
    answer = Oracle.estimate

    def estimate(self: Oracle, episode: Episode) -> ContactPatch:
        asked.append(session.repaint_hold.on)
        return answer(self, episode)

    monkeypatch.setattr(Oracle, "estimate", estimate)
    session.run(request())
    assert asked == [True] * len(asked)
    assert after == [False] * len(asked)
    assert asked
