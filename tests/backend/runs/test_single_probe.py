"""A single probe requested by the operator without a piece."""

from __future__ import annotations

from tests.backend.brisk import brisk_bench, brisk_method
from touchdown.backend.bench.assembly import simulated_session
from touchdown.backend.core.events import Event, PhaseEntered, RunFinished
from touchdown.backend.runs.recorder import RecordingOptions
from touchdown.backend.runs.requests import ProbeRequest, SceneChoice


def test_after_the_piece_was_let_go_a_probe_says_that_and_what_to_do() -> None:
    session = simulated_session(
        brisk_bench("quiet"), keep=RecordingOptions(None), method=brisk_method()
    )
    session.prepare(SceneChoice(estimates=False))
    facts: list[Event] = []
    session.events.subscribe(facts.append)
    assert session.hand is not None
    for order in (lambda hand: hand.grip(8.0), lambda hand: hand.open(confirmed=True)):
        order(session.hand)
        session.advance()
        while session.hand.active:
            session.advance()
    session.run(ProbeRequest())
    assert [f.phase for f in facts if isinstance(f, PhaseEntered)] == ["grip"], "nothing is pressed"
    (ended,) = [f for f in facts if isinstance(f, RunFinished)]
    assert ended.ending == "failed"
    assert ended.reason.startswith("The gripper closed on nothing: no piece is between the jaws.")
    assert "set a new simulated scene (Ctrl+N in Operate)" in ended.reason
    assert not session.interlock.latched
    session.close()
