"""Limits change between motions only, and never without a line on disk."""

import json
from dataclasses import replace

import pytest

from touchdown.backend.bench.assembly import SimulatedBenchChoice, simulated_session
from touchdown.backend.core.events import Said
from touchdown.backend.core.faults import InputError, RefusedError
from touchdown.backend.devices.interlock import Limits
from touchdown.backend.devices.jog import JogOrder
from touchdown.backend.runs.event_log import LIMIT_LOG_NAME, log_limit_change
from touchdown.backend.runs.recorder import RecordingOptions
from touchdown.backend.runs.requests import SceneChoice

LOWER = replace(Limits(), jog_mm_s=30.0)


@pytest.fixture
def session(tmp_path):
    made = simulated_session(
        SimulatedBenchChoice(preset="quiet"), keep=RecordingOptions(tmp_path / "runs")
    )
    made.prepare(SceneChoice(estimates=False))
    for _ in range(60):
        made.advance()
    yield made
    made.close()


def lines(folder):
    return [json.loads(line) for line in (folder / LIMIT_LOG_NAME).read_text().splitlines()]


def test_each_change_is_one_line_with_before_and_after(tmp_path):
    log_limit_change(tmp_path, "Bench 2", "anna", Limits(), LOWER)
    log_limit_change(tmp_path, "Bench 2", "ben", LOWER, replace(LOWER, press_n=20.0))
    first, second = lines(tmp_path)
    assert (first["bench"], first["person"]) == ("Bench 2", "anna")
    assert first["changed"] == {"jog_mm_s": [50.0, 30.0]}
    assert second["changed"] == {"press_n": [25.0, 20.0]}


def test_a_change_holds_from_now_on_and_is_said(session, tmp_path):
    said = []
    session.events.subscribe(lambda fact: said.append(fact) if isinstance(fact, Said) else None)
    session.change_limits(LOWER, "anna")
    assert session.interlock.limits == LOWER
    assert "anna" in said[0].text
    assert len(lines(tmp_path / "runs")) == 1
    with pytest.raises(RefusedError, match=r"40\.0 mm/s"):
        session.hand.jog.renew(JogOrder(1, 1, session.clock_s(), "z", "XYZ", 40.0))


def test_nothing_changes_while_the_arm_is_moved(session):
    session.hand.jog.renew(JogOrder(1, 1, session.clock_s(), "z", "XYZ", 5.0))
    session.advance()
    with pytest.raises(RefusedError, match="manual control"):
        session.change_limits(LOWER, "anna")
    assert session.interlock.limits == Limits()


def test_a_disk_that_refuses_leaves_the_former_limits(session, tmp_path):
    (tmp_path / "runs").write_text("a file in the way")
    with pytest.raises(InputError, match="former limits hold"):
        session.change_limits(LOWER, "anna")
    assert session.interlock.limits == Limits()
