"""Drives one plan at a time: publishes its facts, waits for it, pauses, cancels, stops.

    idle -> preparing -> running <-> pausing -> paused -> running
                         running | pausing | paused -> cancelling -> finishing -> idle

STOP is out of band: it latches the interlock first and ends the run from any state. At every
checkpoint a run stands while a sensor is degraded, and pauses by itself where that lasts.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

from backend.core.facts import (
    ActionChosen,
    ApprovalAwaited,
    Fact,
    FaultRaised,
    HandOverAwaited,
    MountingAwaited,
    OutcomeAwaited,
    PatchEstimated,
    Paused,
    PhaseEntered,
    Released,
    RunFinished,
    RunStarted,
    Said,
    SetUpAwaited,
    TrialStarted,
)
from backend.core.faults import (
    Fault,
    FaultError,
    InputError,
    RefusedError,
    StaleSampleError,
    TouchdownError,
)
from backend.core.hub import Hub
from backend.devices.interlock import Interlock
from backend.runs.plan import (
    CancelledError,
    Checkpoint,
    Plan,
    StoppedError,
    Waiting,
    stopped_words,
    timeout_fault,
)
from backend.runs.requests import RunState, RunStatus
from backend.runs.stale import stale_fault

_ASKS: dict[type[Fact], str] = {
    SetUpAwaited: "set the scene",
    HandOverAwaited: "a hand at the jaws",
    MountingAwaited: "say whether it was fitted anew",
    OutcomeAwaited: "say the outcome",
}
STAND_S = 1.0
"""A run stands this long at a checkpoint for a degraded sensor; then it pauses."""
_ACTIVE = {RunState.RUNNING, RunState.PAUSING, RunState.PAUSED, RunState.PREPARING}


class Engine:
    """Runs plans. ``tick`` is called by whoever owns the bench's time (a thread or a loop)."""

    def __init__(
        self,
        hub: Hub,
        interlock: Interlock,
        now_s: Callable[[], float],
        unwell: Callable[[], Fault | None] = lambda: None,
    ) -> None:
        self._hub, self._interlock, self._now_s = hub, interlock, now_s
        self._unwell = unwell
        self._stand_until_s: float | None = None
        """Set while the plan is at a checkpoint and a sensor was degraded there."""
        self._lock = threading.RLock()
        self._status = RunStatus(RunState.IDLE)
        self._plan: Plan[object] | None = None
        self._waiting: Waiting | None = None
        self._deadline_s = 0.0
        self._throw: TouchdownError | None = None
        self._result: object | None = None
        self._error: Exception | None = None
        self._obstacle: Fault | None = None
        """Why the last pause came by itself, None if it was asked for."""
        self._idle = threading.Event()
        self._idle.set()

    # -- what the operator may ask, from any thread ---------------------------------------------

    def status(self) -> RunStatus:
        """Return a frozen snapshot."""
        with self._lock:
            return self._status

    @property
    def busy(self) -> bool:
        """Whether a plan is being driven."""
        return self._plan is not None

    def begin(self, plan: Plan[object]) -> None:
        """Take ``plan``; it starts with the next tick. ``RefusedError`` if one is running."""
        with self._lock:
            if self._plan is not None:
                raise RefusedError("BUSY", "A run is going on: cancel it first.")
            if self._interlock.latched:
                raise RefusedError("LATCHED", "The bench is stopped: press Reset first.")
            self._plan, self._waiting, self._throw = plan, None, None
            self._result, self._error, self._stand_until_s = None, None, None
            self._status = RunStatus(RunState.PREPARING, text="Preparing")
            self._idle.clear()

    def pause(self) -> None:
        """Pause at the next safe place (arm lifted)."""
        self._change({RunState.RUNNING}, RunState.PAUSING)

    def resume(self) -> None:
        """Go on after a pause."""
        self._change({RunState.PAUSING, RunState.PAUSED}, RunState.RUNNING)

    def cancel(self) -> None:
        """End in an orderly way: lift, keep the piece."""
        with self._lock:
            if self._status.state in _ACTIVE:
                self._throw = CancelledError("cancelled by the operator")
                self._status = replace(self._status, state=RunState.CANCELLING)

    def wait_idle(self, timeout_s: float) -> bool:
        """Block until no plan is driven; for scripts, never for a window."""
        return self._idle.wait(timeout_s)

    def abandon(self, error: BaseException) -> None:
        """Latch a fault and end the run, if any: the bench's time ended with ``error``."""
        fault = Fault(
            "BENCH-DIED",
            f"The bench thread ended: {type(error).__name__}: {error}.",
            "Nothing moves any more; the gripper was not opened.",
            "Copy the details for the maintainers, then start Touchdown again.",
        )
        self._fail(FaultError(fault))

    # -- the bench's time -----------------------------------------------------------------------

    def tick(self) -> None:
        """Drive the plan until it waits; call once per advance of the bench."""
        with self._lock:
            plan = self._plan
            if plan is None:
                return
            if self._interlock.latched and not isinstance(self._throw, StoppedError | FaultError):
                self._throw = self._why_stopped()
                if self._status.state in (RunState.PAUSING, RunState.PAUSED):
                    # A plan that is paused would not come to tell how its trial ended.
                    self._status = replace(self._status, state=RunState.FINISHING)
        for _ in range(10_000):
            self._interlock.renew_lease(self._now_s())
            if not self._may_go_on():
                return
            if not self._advance(plan):
                return

    def run(self, plan: Plan[object], advance: Callable[[], None]) -> object:
        """Drive ``plan`` to its end on this thread; ``advance`` moves the bench by one step.

        Returns the plan's value; raises what ended it if that was an error. A run that an obstacle
        paused, and that nobody resumed when it was told, is cancelled: nobody else would.
        """
        self.begin(plan)
        while self.busy:
            self.tick()
            self._end_if_left_paused()
            if self.busy:
                advance()
        if self._error is not None:
            raise self._error
        return self._result

    # -- inside ---------------------------------------------------------------------------------

    def _end_if_left_paused(self) -> None:
        with self._lock:
            if self._status.state is RunState.PAUSED and self._obstacle is not None:
                self._throw = CancelledError(f"nobody resumed it: {self._obstacle.what}")
                self._status = replace(self._status, state=RunState.CANCELLING)

    def _may_go_on(self) -> bool:
        with self._lock:
            if self._throw is not None:
                return True
            if self._status.state is RunState.PAUSED:
                return False
            waiting = self._waiting
        if self._stand_until_s is not None and not self._sensors_well(self._stand_until_s):
            return False
        if waiting is None:
            return True
        if waiting.until():
            self._waiting = None
            return True
        if self._now_s() > self._deadline_s:
            self._throw, self._waiting = timeout_fault(waiting), None
            return True
        return False

    def _advance(self, plan: Plan[object]) -> bool:
        """Send or throw once; return False if the plan ended or paused."""
        with self._lock:
            throw, self._throw = self._throw, None
            self._stand_until_s = None
        try:
            if throw is None:
                step = plan.send(None)
            else:
                self._waiting = None
                step = plan.throw(throw)
        except StopIteration as end:
            self._finish(end.value)
            return False
        except (TouchdownError, ArithmeticError, ValueError, LookupError, OSError) as error:
            self._fail(error)
            return False
        if isinstance(step, Fact):
            self._publish(step)
        elif isinstance(step, Waiting):
            self._waiting = step
            self._deadline_s = self._now_s() + step.timeout_s
        elif isinstance(step, Checkpoint):
            return self._checkpoint(step)
        return True

    def _checkpoint(self, place: Checkpoint) -> bool:
        obstacle = place.obstacle
        with self._lock:
            asked = self._status.state is RunState.PAUSING
            if not asked and (obstacle is None or self._status.state is not RunState.RUNNING):
                # ``tick`` asks for the sensors before the plan goes on.
                self._stand_until_s = self._now_s() + STAND_S
                return True
        self._pause(obstacle)
        return False

    def _pause(self, obstacle: Fault | None) -> None:
        with self._lock:
            self._obstacle = obstacle
            text = "Paused" if obstacle is None else obstacle.what
            self._status = replace(self._status, state=RunState.PAUSED, text=text)
        if obstacle is not None:
            self._publish(Paused(self._now_s(), obstacle))

    def _sensors_well(self, until_s: float) -> bool:
        """Whether the plan may leave its checkpoint; pauses the run where it waited in vain."""
        unwell = self._unwell()
        if unwell is None:
            return True
        with self._lock:
            asked = self._status.state is RunState.PAUSING
        if asked:
            self._pause(None)
        elif self._now_s() > until_s and self._status.state is RunState.RUNNING:
            self._pause(unwell)
        return False

    def _publish(self, fact: Fact) -> None:
        with self._lock:
            self._status = _followed(self._status, fact)
        self._hub.publish(fact)

    def _change(self, allowed: set[RunState], state: RunState) -> None:
        with self._lock:
            if self._status.state in allowed:
                self._status = replace(self._status, state=state)

    def _finish(self, result: object) -> None:
        with self._lock:
            self._plan, self._waiting, self._result = None, None, result
            self._status = replace(
                self._status, state=RunState.IDLE, run_id="", phase="", awaiting=None, asks=""
            )
            self._interlock.drop_lease()
        self._idle.set()

    def _fail(self, error: Exception) -> None:
        """End after an escaped error; a failed clean-up cannot prevent ``RunFinished``."""
        now_s = self._now_s()
        fault = error.fault if isinstance(error, FaultError) else _fault_of(error)
        stopped = isinstance(error, StoppedError)
        run_id, was_busy = self._status.run_id, self.busy
        self._finish(None)
        self._error = error
        if not stopped:
            if not isinstance(error, InputError):
                self._interlock.raise_fault(fault)
            self._hub.publish(FaultRaised(now_s, fault))
        if was_busy:
            ending: Literal["stopped", "failed"] = "stopped" if stopped else "failed"
            self._hub.publish(RunFinished(now_s, run_id, ending, str(error)))

    def _why_stopped(self) -> TouchdownError:
        faults = self._interlock.faults
        if faults:
            return FaultError(faults[0])
        return StoppedError(stopped_words(self._interlock.stopped_by))


def _followed(status: RunStatus, fact: Fact) -> RunStatus:
    """Return the status after ``fact``."""
    if isinstance(fact, RunStarted):
        return replace(
            status, state=RunState.RUNNING, run_id=fact.run_id, trials=fact.trials, text="Running"
        )
    if isinstance(fact, TrialStarted):
        return replace(status, trial=fact.trial, probe=0, felt=0, phase="", awaiting=None, asks="")
    if isinstance(fact, PhaseEntered):
        return replace(status, phase=fact.phase, probe=fact.probe, awaiting=None, asks="")
    if type(fact) in _ASKS or isinstance(fact, Released):
        return replace(status, asks=_ASKS.get(type(fact), ""))
    if isinstance(fact, PatchEstimated):
        return replace(status, felt=fact.probe)
    if isinstance(fact, ActionChosen):
        return replace(status, text=fact.action.reason)
    if isinstance(fact, ApprovalAwaited):
        return replace(status, awaiting=fact.action)
    if isinstance(fact, Said):
        return replace(status, text=fact.text)
    return status


def _fault_of(error: Exception) -> Fault:
    if isinstance(error, StaleSampleError):
        return stale_fault(error)
    if isinstance(error, InputError):
        return Fault("INPUT", error.what, f"In {error.where}. Nothing was moved.", error.fix)
    return Fault(
        code=error.reason if isinstance(error, RefusedError) else type(error).__name__.upper(),
        what=str(error) or type(error).__name__,
        consequence="The run ended; the gripper was not opened.",
        next_step="Read the message, remove the cause, then press Reset.",
    )
