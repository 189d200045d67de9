"""Engine that runs one plan at a time, paced by a thread on a live bench.

It publishes the events of the plan and handles waits, pause, cancel and stop. A watchdog reports a
live thread that makes no step.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

from touchdown.backend import core
from touchdown.backend.core import QUESTIONS, ThreadStallDetector
from touchdown.backend.devices import Interlock
from touchdown.backend.runs.plan import (
    CancelledError,
    PausePoint,
    Plan,
    StoppedError,
    Wait,
    stale_fault,
    stopped_message,
    timeout_fault,
)
from touchdown.backend.runs.requests import RunState, RunStatus

DEGRADED_WAIT_S = 1.0  # A run waits this long at a checkpoint for a degraded sensor, then it pauses
_ACTIVE = {RunState.RUNNING, RunState.PAUSING, RunState.PAUSED, RunState.PREPARING}


class Engine:
    """Runs plans. ``tick`` is called by the owner of the bench time: a thread or a loop."""

    def __init__(
        self,
        hub: core.EventBus,
        interlock: Interlock,
        now_s: Callable[[], float],
        unwell: Callable[[], core.Fault | None] = lambda: None,
    ) -> None:
        self._hub, self._interlock, self._now_s = hub, interlock, now_s
        self._unwell = unwell
        # Set while the plan waits at a checkpoint for a degraded sensor
        self._stand_until_s: float | None = None
        self._lock = threading.RLock()
        self._status = RunStatus(RunState.IDLE)
        self._plan: Plan[object] | None = None
        self._waiting: Wait | None = None
        self._deadline_s = 0.0
        self._throw: core.TouchdownError | None = None
        self._result: object | None = None
        self._error: Exception | None = None
        self._obstacle: core.Fault | None = None  # reason of an automatic pause
        self._idle = threading.Event()
        self._idle.set()
        # Set by ``cancel`` until the next run: ends work that blocks the plan, such as connecting
        self.cancelled: threading.Event = threading.Event()

    # -- what the operator may ask, from any thread ---------------------------------------------

    def status(self) -> RunStatus:
        """Return a frozen snapshot."""
        with self._lock:
            return self._status

    @property
    def busy(self) -> bool:
        """True if a plan is running."""
        return self._plan is not None

    def begin(self, plan: Plan[object]) -> None:
        """Take ``plan``; it starts with the next tick. ``RefusedError`` if one is running."""
        with self._lock:
            if self._plan is not None:
                raise core.RefusedError("BUSY", "A run is in progress: cancel it first.")
            if self._interlock.latched:
                raise core.RefusedError("LATCHED", "The bench is stopped: press Reset first.")
            self._plan, self._waiting, self._throw = plan, None, None
            self._result, self._error, self._stand_until_s = None, None, None
            self._status = RunStatus(RunState.PREPARING, text="Preparing")
            self._idle.clear()
            self.cancelled.clear()

    def pause(self) -> None:
        """Pause at the next safe place (arm lifted)."""
        self._change({RunState.RUNNING}, RunState.PAUSING)

    def resume(self) -> None:
        """Continue after a pause."""
        self._change({RunState.PAUSING, RunState.PAUSED}, RunState.RUNNING)

    def cancel(self) -> bool:
        """End the run in order: lift, keep the piece. Return False if none is in progress."""
        with self._lock:
            if self._status.state in _ACTIVE:
                self._throw = CancelledError("cancelled by the operator")
                self._status = replace(self._status, state=RunState.CANCELLING)
                self.cancelled.set()
            return self._status.state is not RunState.IDLE

    def wait_idle(self, timeout_s: float) -> bool:
        """Block until no plan is running. For scripts, never for a window."""
        return self._idle.wait(timeout_s)

    def abandon(self, error: BaseException) -> None:
        """Latch a fault and end the run: the bench thread ended with ``error``."""
        fault = core.Fault(
            "BENCH-DIED",
            f"The bench thread ended: {type(error).__name__}: {error}.",
            "All motion has stopped; the gripper was not opened.",
            "Copy the details for the maintainers, then start Touchdown again.",
        )
        self._fail(core.FaultError(fault))

    # -- the bench's time -----------------------------------------------------------------------

    def tick(self) -> None:
        """Run the plan until it waits; call once per bench step."""
        with self._lock:
            plan = self._plan
            if plan is None:
                return
            if self._interlock.latched and not isinstance(
                self._throw, StoppedError | core.FaultError
            ):
                faults = self._interlock.faults
                stopped = StoppedError(stopped_message(self._interlock.stopped_by))
                self._throw = core.FaultError(faults[0]) if faults else stopped
                if self._status.state in (RunState.PAUSING, RunState.PAUSED):
                    # A paused plan has to run to report how its trial ended.
                    self._status = replace(self._status, state=RunState.FINISHING)
        for _ in range(10_000):
            self._interlock.renew_lease(self._now_s())
            if not self._may_go_on():
                return
            if not self._advance(plan):
                return

    def run(self, plan: Plan[object], advance: Callable[[], None]) -> object:
        """Run ``plan`` to its end on this thread and return its value; raises its error.

        ``advance`` moves the bench by one step. A run that paused by itself and was not resumed is
        cancelled.
        """
        self.begin(plan)
        while self.busy:
            self.tick()
            with self._lock:
                if self._status.state is RunState.PAUSED and self._obstacle is not None:
                    self._throw = CancelledError(f"not resumed: {self._obstacle.what}")
                    self._status = replace(self._status, state=RunState.CANCELLING)
            if self.busy:
                advance()
        if self._error is not None:
            raise self._error
        return self._result

    # -- inside ---------------------------------------------------------------------------------

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
        except (core.TouchdownError, ArithmeticError, ValueError, LookupError, OSError) as error:
            self._fail(error)
            return False
        if isinstance(step, core.Event):
            self._publish(step)
        elif isinstance(step, Wait):
            self._waiting = step
            self._deadline_s = self._now_s() + step.timeout_s
        elif isinstance(step, PausePoint):
            return self._checkpoint(step)
        return True

    def _checkpoint(self, place: PausePoint) -> bool:
        obstacle = place.obstacle
        with self._lock:
            pausing = self._status.state is RunState.PAUSING
            if not pausing and (obstacle is None or self._status.state is not RunState.RUNNING):
                # ``tick`` checks the sensors before the plan continues.
                self._stand_until_s = self._now_s() + DEGRADED_WAIT_S
                return True
        self._pause(obstacle)
        return False

    def _pause(self, obstacle: core.Fault | None) -> None:
        with self._lock:
            self._obstacle = obstacle
            text = "Paused" if obstacle is None else obstacle.what
            self._status = replace(self._status, state=RunState.PAUSED, text=text)
        if obstacle is not None:
            self._publish(core.Paused(self._now_s(), obstacle))

    def _sensors_well(self, until_s: float) -> bool:
        """Return True if the plan may leave its checkpoint; pauses the run after ``until_s``."""
        unwell = self._unwell()
        if unwell is None:
            return True
        with self._lock:
            pausing = self._status.state is RunState.PAUSING
        if pausing:
            self._pause(None)
        elif self._now_s() > until_s and self._status.state is RunState.RUNNING:
            self._pause(unwell)
        return False

    def _publish(self, event: core.Event) -> None:
        with self._lock:
            self._status = _next_status(self._status, event)
        self._hub.publish(event)

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
        """End the run after an escaped error; publishes ``RunFinished`` in every case.

        A cancel between two trials escapes the plan as well: nothing moves then, it is no fault.
        """
        now_s = self._now_s()
        ending: Literal["cancelled", "stopped", "failed"] = "failed"
        if isinstance(error, CancelledError):
            ending = "cancelled"
        elif isinstance(error, StoppedError):
            ending = "stopped"
        run_id, was_busy = self._status.run_id, self.busy
        self._finish(None)
        self._error = None if ending == "cancelled" else error
        if ending == "failed":
            fault = error.fault if isinstance(error, core.FaultError) else _fault_of(error)
            if not isinstance(error, core.InputError):
                self._interlock.raise_fault(fault)
            self._hub.publish(core.FaultRaised(now_s, fault))
        if was_busy:
            self._hub.publish(core.RunFinished(now_s, run_id, ending, str(error)))


def _next_status(status: RunStatus, event: core.Event) -> RunStatus:
    if isinstance(event, core.RunStarted):
        return replace(
            status, state=RunState.RUNNING, run_id=event.run_id, trials=event.trials, text="Running"
        )
    if isinstance(event, core.TrialStarted):
        return replace(
            status, trial=event.trial, probe=0, estimated=0, phase="", awaiting=None, asks=""
        )
    if isinstance(event, core.PhaseEntered):
        return replace(
            status, phase=event.phase, probe=event.probe, awaiting=None, asks="", steps=0
        )
    if isinstance(event, core.Progress):
        return replace(status, step=event.done, steps=event.total)
    if type(event) in QUESTIONS or isinstance(event, core.Released):
        return replace(status, asks=QUESTIONS.get(type(event), ""))
    if isinstance(event, core.PatchEstimated):
        return replace(status, estimated=event.probe)
    if isinstance(event, core.ActionChosen):
        return replace(status, text=event.action.reason)
    if isinstance(event, core.ApprovalAwaited):
        return replace(status, awaiting=event.action)
    if isinstance(event, core.Said):
        return replace(status, text=event.text)
    return status


def _fault_of(error: Exception) -> core.Fault:
    if isinstance(error, core.StaleSampleError):
        return stale_fault(error)
    if isinstance(error, core.InputError):
        return core.Fault("INPUT", error.what, f"In {error.where}. Nothing was moved.", error.fix)
    return core.Fault(
        code=error.reason if isinstance(error, core.RefusedError) else type(error).__name__.upper(),
        what=str(error) or type(error).__name__,
        consequence="The run ended; the gripper was not opened.",
        next_step="Read the message, remove the cause, then press Reset.",
    )


WATCH_PERIOD_S = 0.05
# A thread that slept this long without a step is stalled; reported within 500 ms (P7)
STILL_S = 0.25
# A busy thread without a step is stalled after this time; the longest step takes about 1 s
WORKS_S = 30.0


class ThreadWatchdog:
    """Watches thread ``number`` (native id) every ``WATCH_PERIOD_S``.

    ``steps`` counts its steps, at least one per ``step_s`` of wall time. ``tell`` is called at each
    look while the thread is stalled.
    """

    def __init__(
        self,
        number: int,
        steps: Callable[[], int],
        step_s: float,
        tell: Callable[[core.Fault], None],
    ) -> None:
        self._number, self._steps, self._tell = number, steps, tell
        self._rest, self._still_s = ThreadStallDetector(os.getpid(), number), STILL_S + step_s
        self._seen, self._stepless_s = -1, 0.0

    def look(self, now_s: float) -> None:
        """Judge at ``now_s`` of ``time.monotonic``."""
        rested_s = self._rest.look(now_s)
        steps, said = self._steps(), core.blocking_section_of(self._number)
        if steps != self._seen or said is not None:
            self._seen, self._rest.rested_s, self._stepless_s = steps, 0.0, 0.0
            if said is not None and now_s > said.until_s:
                self._tell(bench_fault(f"It {said.what}, and that comes to no end"))
            return
        self._stepless_s += self._rest.passed_s
        if rested_s >= self._still_s:
            self._tell(bench_fault("It waits without end"))
        elif self._stepless_s >= WORKS_S:
            self._tell(bench_fault("It is busy without end"))


def bench_fault(why: str) -> core.Fault:
    """Return the fault of a stalled bench thread; ``why`` is a sentence without its full stop."""
    return core.Fault(
        "BENCH-STILL",
        f"The bench thread is stalled. {why}.",
        "Nothing is measured and no run continues; the gripper was not opened.",
        "Copy the details for the maintainers, then start Touchdown again.",
    )


BEHIND_S = 0.25  # a live bench this late against the wall clock skips the delay
JOIN_S = 5.0
HUNG_S, HUNG_JOIN_S = 2.0, 0.5  # A thread without a step for HUNG_S is joined for HUNG_JOIN_S only


class LiveThread:
    """Calls ``step`` every ``step_s`` of bench time; ``failed`` receives the error that ended it.

    ``still`` is called on a watch thread every ``WATCH_PERIOD_S`` while no step is made.
    """

    def __init__(
        self,
        step: Callable[[], None],
        step_s: float,
        failed: Callable[[BaseException], None],
        still: Callable[[core.Fault], None],
    ) -> None:
        self._step, self._step_s, self._failed, self._still = step, step_s, failed, still
        self._thread: threading.Thread | None = None
        self._closing, self._over = threading.Event(), threading.Event()
        self._hung_at = -1  # step count at which a stall was reported
        self._speed, self._stepped_s, self._steps = 1.0, 0.0, 0
        self.pace = 0.0  # bench seconds per wall second, measured every second

    @property
    def running(self) -> bool:
        """True if it was opened and not closed."""
        return self._thread is not None

    @property
    def still_s(self) -> float:
        """Time since the last step, 0 while closed."""
        return time.monotonic() - self._stepped_s if self._thread is not None else 0.0

    def open(self, speed: float) -> None:
        """Start with ``speed`` bench seconds per wall second; a second call changes nothing."""
        if self._thread is None:
            self._closing.clear()
            self._over.clear()
            self._speed, self._stepped_s = speed, time.monotonic()
            self._thread = threading.Thread(target=self._live, name="bench", daemon=True)
            self._thread.start()
            threading.Thread(
                target=self._watch, args=(self._thread,), name="bench watch", daemon=True
            ).start()

    def close(self, settle: Callable[[], object]) -> None:
        """End the thread; ``settle`` is called first, while time still passes."""
        hung = self.still_s > HUNG_S
        thread, self._thread = self._thread, None
        if thread is None:
            return
        settle()
        self._closing.set()
        begun_s = waited_s = time.monotonic()
        # The watchdog may report the stall only now.
        while waited_s - begun_s < (HUNG_JOIN_S if hung else JOIN_S) and thread.is_alive():
            thread.join(WATCH_PERIOD_S)
            waited_s, hung = time.monotonic(), hung or self._hung_at == self._steps
        self._over.set()

    def _live(self) -> None:
        try:
            self._keep_pace()
        except BaseException as error:
            # Latch, stop and end the run; the exception hooks show the error.
            self._failed(error)
            raise

    def _keep_pace(self) -> None:
        due_s = time.monotonic()
        measured_s, steps = due_s, 0
        while not self._closing.is_set():
            self._step()
            self._steps += 1
            steps += 1
            due_s += self._step_s / self._speed
            now_s = self._stepped_s = time.monotonic()
            if now_s - measured_s >= 1.0:
                self.pace = steps * self._step_s / (now_s - measured_s)
                measured_s, steps = now_s, 0
            if now_s - due_s > BEHIND_S:
                due_s = now_s
            self._closing.wait(max(0.0, due_s - now_s))

    def _watch(self, thread: threading.Thread) -> None:
        assert thread.native_id is not None
        step_s = self._step_s / self._speed
        watch = ThreadWatchdog(thread.native_id, lambda: self._steps, step_s, self._hangs)
        while thread.is_alive() and not self._over.wait(WATCH_PERIOD_S):
            watch.look(time.monotonic())

    def _hangs(self, fault: core.Fault) -> None:
        self._hung_at = self._steps
        self._still(fault)
