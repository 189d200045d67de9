"""States of the engine: pause at checkpoints, cancel with clean-up, stop from anywhere."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from touchdown.backend.core.clock import ManualClock
from touchdown.backend.core.event_bus import EventBus
from touchdown.backend.core.events import Event, FaultRaised, Paused, RunFinished, RunStarted, Said
from touchdown.backend.core.faults import Fault, InputError, RefusedError
from touchdown.backend.devices.interlock import Interlock
from touchdown.backend.runs import Engine, Plan, RunState
from touchdown.backend.runs.plan import (
    CancelledError,
    PausePoint,
    StoppedError,
    Wait,
    stopped_message,
)


class Rig:
    """Engine with a manual clock and its published events."""

    def __init__(self) -> None:
        self.clock, self.events, self.interlock = ManualClock(), EventBus(), Interlock()
        self.engine = Engine(self.events, self.interlock, self.clock.now_s)
        self.facts: list[Event] = []
        self.events.subscribe(self.facts.append)

    def advance(self) -> None:
        self.clock.advance(20_000)

    def tick(self, times: int = 1) -> None:
        for _ in range(times):
            self.engine.tick()
            self.advance()

    def texts(self) -> list[str]:
        return [fact.text for fact in self.facts if isinstance(fact, Said)]


@pytest.fixture
def rig() -> Rig:
    return Rig()


def started() -> RunStarted:
    return RunStarted(0.0, "r1", "pot", "short", "paper", 0, 1, True, "{}")


def waits(now_s: Callable[[], float], seconds: float) -> Wait:
    until_s = now_s() + seconds
    return Wait(lambda: now_s() >= until_s, 100.0, "time")


def two_steps(rig: Rig) -> Plan[str]:
    yield started()
    try:
        for name in ("one", "two"):
            yield PausePoint()
            yield Said(rig.clock.now_s(), name)
            yield waits(rig.clock.now_s, 0.1)
    except CancelledError:
        yield Said(rig.clock.now_s(), "lifted")
        yield waits(rig.clock.now_s, 0.1)
        yield Said(rig.clock.now_s(), "clean")
        return "cancelled"
    return "done"


def test_facts_come_in_order_and_the_value_is_returned(rig):
    assert rig.engine.run(two_steps(rig), rig.advance) == "done"
    assert rig.texts() == ["one", "two"]
    assert rig.clock.now_s() == pytest.approx(0.2, abs=0.05)
    assert rig.engine.status().state is RunState.IDLE


def test_pause_waits_for_a_checkpoint_and_resumes(rig):
    rig.engine.begin(two_steps(rig))
    with pytest.raises(RefusedError, match="BUSY"):
        rig.engine.begin(two_steps(rig))
    rig.tick()
    rig.engine.pause()
    assert rig.engine.status().state is RunState.PAUSING
    rig.tick(20)
    assert rig.engine.status().state is RunState.PAUSED
    assert rig.texts() == ["one"]
    rig.engine.resume()
    rig.tick(20)
    assert rig.texts() == ["one", "two"]
    assert rig.engine.status().state is RunState.IDLE


@pytest.mark.parametrize("paused", [False, True])
def test_cancel_lets_the_plan_clean_up(rig, paused):
    rig.engine.begin(two_steps(rig))
    rig.tick()
    if paused:
        rig.engine.pause()
        rig.tick(20)
    assert rig.engine.cancel()
    assert rig.engine.status().state is RunState.CANCELLING
    rig.tick(20)
    assert rig.texts() == ["one", "lifted", "clean"]
    assert not rig.engine.busy
    assert not rig.engine.cancel()


@pytest.mark.parametrize("before", ["preparing", "running", "pausing", "paused", "cancelling"])
def test_stop_ends_the_run_from_every_state_without_clean_up(rig, before):
    rig.engine.begin(two_steps(rig))
    if before != "preparing":
        rig.tick()
    if before in ("pausing", "paused"):
        rig.engine.pause()
    if before == "paused":
        rig.tick(20)
    if before == "cancelling":
        rig.engine.cancel()
        rig.tick()
    assert rig.engine.status().state.value == before
    rig.interlock.stop("operator")
    rig.tick()
    assert not rig.engine.busy
    assert "clean" not in rig.texts()
    ending = rig.facts[-1]
    assert ending.ending == "stopped"
    with pytest.raises(RefusedError, match="LATCHED"):
        rig.engine.begin(two_steps(rig))
    rig.interlock.reset()
    rig.engine.begin(two_steps(rig))


def test_a_plan_may_end_itself_in_an_orderly_way_after_stop(rig):
    def plan() -> Plan[str]:
        yield started()
        try:
            yield waits(rig.clock.now_s, 10.0)
        except StoppedError as cause:
            yield Said(0.0, str(cause))
        return "noticed"

    rig.engine.begin(plan())
    rig.tick()
    rig.interlock.stop("F12")
    rig.tick()
    assert rig.texts() == ["stopped by F12"]
    assert not rig.engine.busy
    assert stopped_message("") == "stopped", "after an early reset"


def test_a_wait_that_never_ends_becomes_a_latched_fault(rig):
    def plan() -> Plan[None]:
        yield started()
        yield Wait(lambda: False, 1.0, "a device that is dead")

    with pytest.raises(Exception, match="a device that is dead"):
        rig.engine.run(plan(), rig.advance)
    assert [f.code for f in rig.interlock.faults] == ["TIMEOUT"]
    assert any(isinstance(fact, FaultRaised) for fact in rig.facts)
    assert isinstance(rig.facts[-1], RunFinished)


def test_an_unforeseen_error_cannot_prevent_the_end_of_the_run(rig):
    def plan() -> Plan[None]:
        yield started()
        raise ValueError("broken maths")

    with pytest.raises(ValueError, match="broken maths"):
        rig.engine.run(plan(), rig.advance)
    assert rig.interlock.latched
    ending = rig.facts[-1]
    assert ending.ending == "failed"


def test_bad_input_is_shown_and_does_not_latch(rig):
    def plan() -> Plan[None]:
        raise InputError("No such piece.", "pieces/nope.toml", "Choose another.")
        yield started()

    with pytest.raises(InputError):
        rig.engine.run(plan(), rig.advance)
    assert not rig.interlock.latched
    assert any(isinstance(fact, FaultRaised) for fact in rig.facts)


def test_the_lease_lives_while_a_plan_is_driven_and_not_after(rig):
    rig.engine.begin(two_steps(rig))
    rig.tick()
    assert rig.interlock.has_lease(rig.clock.now_s())
    rig.tick(20)
    assert not rig.interlock.has_lease(rig.clock.now_s())


SLOW = Fault("DEGRADED", "The wrist sensor is slow.", "Paused.", "Look.", "force_torque")


class Unwell(Rig):
    """Engine with a degraded sensor."""

    def __init__(self) -> None:
        super().__init__()
        self.fault: Fault | None = SLOW
        self.engine = Engine(self.events, self.interlock, self.clock.now_s, lambda: self.fault)

    def paused(self) -> list[Fault]:
        return [fact.fault for fact in self.facts if isinstance(fact, Paused)]


def test_a_run_stands_for_a_sensor_that_is_soon_well_again():
    rig = Unwell()
    rig.engine.begin(two_steps(rig))
    rig.tick(40)
    assert rig.engine.status().state is RunState.RUNNING
    assert rig.texts() == []
    rig.fault = None
    rig.tick(20)
    assert rig.texts() == ["one", "two"]
    assert rig.paused() == []


def test_a_sensor_that_stays_degraded_pauses_the_run_until_it_is_resumed():
    rig = Unwell()
    rig.engine.begin(two_steps(rig))
    rig.tick(60)
    assert rig.engine.status().state is RunState.PAUSED
    assert (rig.texts(), rig.paused()) == ([], [SLOW])
    rig.engine.resume()
    rig.tick(2)
    assert rig.engine.status().state is RunState.PAUSED, "resumed too early it pauses again"
    rig.fault = None
    rig.tick(20)
    assert rig.texts() == [], "no motion begins by itself"
    rig.engine.resume()
    rig.tick(20)
    assert rig.texts() == ["one", "two"]


@pytest.mark.parametrize("ticks", [10, 60])
def test_a_run_that_stands_for_a_sensor_can_be_paused_cancelled_and_stopped(ticks):
    rig = Unwell()
    rig.engine.begin(two_steps(rig))
    rig.tick(ticks)
    rig.engine.pause()
    rig.tick(1)
    assert rig.engine.status().state is RunState.PAUSED
    rig.engine.cancel()
    rig.tick(20)
    assert rig.texts() == ["lifted", "clean"]
    other = Unwell()
    other.engine.begin(two_steps(other))
    other.tick(ticks)
    other.interlock.stop()
    other.tick(2)
    assert other.engine.status().state is RunState.IDLE


def test_a_script_whose_sensor_stays_degraded_is_cancelled():
    rig = Unwell()
    assert rig.engine.run(two_steps(rig), rig.advance) == "cancelled"
    assert rig.clock.now_s() < 3.0


def told_to_its_end(rig: Rig) -> Plan[str]:
    yield started()
    try:
        while True:
            yield PausePoint()
            yield waits(rig.clock.now_s, 0.1)
    except StoppedError as cause:
        yield Said(rig.clock.now_s(), str(cause))
        yield Said(rig.clock.now_s(), "trial told")
    return "stopped"


@pytest.mark.parametrize("paused", [False, True])
def test_a_stopped_run_tells_how_its_trial_ended_also_out_of_a_pause(rig, paused):
    rig.engine.begin(told_to_its_end(rig))
    rig.tick()
    if paused:
        rig.engine.pause()
        rig.tick(20)
        assert rig.engine.status().state is RunState.PAUSED
    rig.interlock.stop("operator")
    rig.tick(2)
    assert rig.texts() == ["stopped by operator", "trial told"]
    assert rig.engine.status().state is RunState.IDLE
