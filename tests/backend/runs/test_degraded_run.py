"""A slow sensor pauses a run at its checkpoint; a failed one ends it.

On the bench's own time, with a sensor slowed by an injected fault.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.backend.brisk import brisk_bench
from tests.backend.runs.oracle_bench import OracleSession, request
from tests.backend.runs.test_hand import hold, order, position
from tests.backend.runs.test_stack import last_trial
from touchdown.backend.bench.assembly import simulated_session
from touchdown.backend.core.events import (
    EpisodeRecorded,
    FaultRaised,
    Paused,
    Released,
    RunFinished,
)
from touchdown.backend.core.faults import RefusedError
from touchdown.backend.core.values import Outcome
from touchdown.backend.emulation.disturbances import Disturbance, DisturbanceScript
from touchdown.backend.episodes.episode_file import read_episode
from touchdown.backend.runs.recorder import RecordingOptions
from touchdown.backend.runs.requests import RunState, SceneChoice

MOST_S = 40.0


class Slowed(OracleSession):
    """Run whose wrist sensor delivers 300 of 1000 samples/s from the first probe on."""

    def __init__(self, runs: Path | None) -> None:
        super().__init__("force_torque:slow=300@2.0", runs=runs)
        self.session.start(request())

    def go_on_until(self, what: str) -> None:
        """Advance until ``what`` is the state of the run, or the pause of a degraded sensor."""
        while what != self.state():
            self.session.engine.tick()
            self.session.advance()
            assert self.session.clock_s() < MOST_S, self.state()

    def state(self) -> str:
        """Return the state; "stands" while the checkpoint waits for the sensor."""
        session = self.session
        stands = session.engine._stand_until_s is not None and session.degraded
        running = session.status().state is RunState.RUNNING
        return "stands" if stands and running else session.status().state.value

    def fail(self, kind: str) -> None:
        """Let the wrist sensor fail permanently."""
        bench = self.benches[-1]
        bench._script = DisturbanceScript(
            (Disturbance("force_torque", kind, self.session.clock_s()),)
        )


@pytest.mark.promise("S9")
@pytest.mark.parametrize(
    ("until", "kind"), [("stands", "nan"), ("stands", "stop"), ("paused", "stop")]
)
def test_a_sensor_lost_while_its_run_stands_degraded_ends_it_and_keeps_the_probe(
    until: str, kind: str, tmp_path: Path
) -> None:
    bench = Slowed(tmp_path)
    bench.go_on_until(until)
    (kept,) = bench.of(EpisodeRecorded)
    assert isinstance(kept, EpisodeRecorded)
    assert [fact.fault.code for fact in bench.of(Paused)] == ["DEGRADED"] * (until == "paused")
    bench.fail(kind)
    failed_s = bench.session.clock_s()
    bench.go_on_until("idle")
    assert bench.session.clock_s() - failed_s < 0.4
    (raised,) = bench.of(FaultRaised)
    assert (raised.fault.code, raised.fault.device) == ("FT-STALE", "force_torque")
    assert last_trial(bench).outcome is Outcome.ABORTED
    assert bench.of(RunFinished)[-1].ending == "failed"
    assert bench.of(Released) == []
    assert bench.session._scene.gripper.status().holding, "the piece is kept"
    (file,) = tmp_path.rglob("*.mcap")
    assert read_episode(file).quality.accepted
    bench.session.close()


@pytest.mark.promise("S6")
def test_with_a_slow_sensor_the_arm_only_jogs_away_and_holds_what_it_holds() -> None:
    made = simulated_session(
        brisk_bench(faults=("force_torque:slow=300@0",)), keep=RecordingOptions(None)
    )
    made.prepare(SceneChoice(estimates=False))
    while made.clock_s() < 1.3:
        made.advance()
    assert [(one.device, one.how) for one in made.degraded] == [("force_torque", "slow")]
    with pytest.raises(RefusedError, match="delivered less than half") as refused:
        made.hand.jog.renew(order(made, axis="x"))
    assert refused.value.reason == "DEGRADED"
    with pytest.raises(RefusedError, match="only \\+Z is possible"):
        made.hand.jog.step("z", "XYZ", -0.5, 2.0)
    with pytest.raises(RefusedError, match="Turn once it is well"):
        made.hand.jog.step("rz", "XYZ", 0.01, 0.05)
    before = position(made)
    hold(made, 0.3, hold=2, speed=5.0)
    assert position(made)[2] > before[2]
    made.hand.jog.end(2)
    made.hand.grip(8.0)
    while made.hand.active:
        made.advance()
    assert made._scene.gripper.status().holding
    made.close()
