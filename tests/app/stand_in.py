"""A small bench for tests of the window: it keeps every order and moves only when it is turned."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from touchdown.backend.bench import Session
from touchdown.backend.config.bench_description import BenchDescription, BenchIdentity
from touchdown.backend.config.method import StackSettings
from touchdown.backend.core.event_bus import EventBus
from touchdown.backend.core.events import (
    ActionChosen,
    BeliefUpdated,
    FaultRaised,
    FaultsReset,
    PatchEstimated,
    PhaseEntered,
    Released,
    RunFinished,
    RunStarted,
    Said,
    StabilityJudged,
    TrialFinished,
    TrialStarted,
)
from touchdown.backend.core.faults import Fault, RefusedError
from touchdown.backend.core.scheduling import RepaintHold
from touchdown.backend.core.streams import SampleStream, Stream
from touchdown.backend.core.values import (
    FINGERS,
    BeliefMap,
    ContactPatch,
    MarkerField,
    Outcome,
    PlaceAction,
    Pose,
    Stability,
    SupportKind,
    TactileFrame,
)
from touchdown.backend.devices.interlock import Interlock
from touchdown.backend.devices.protocols import (
    ArmStatus,
    DeviceState,
    GripStatus,
    Health,
    Identity,
    RobotMode,
    SafetyMode,
)
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.runs import OperatorPrompt, RunState, RunStatus, SceneChoice
from touchdown.widgets.views.decision import signed_mm

ROWS, COLS = np.mgrid[0:7, 0:9]
REST = np.stack([34.0 + 31.5 * COLS.ravel(), 30.0 + 30.0 * ROWS.ravel()], axis=1)


class StandInDevice:
    """A device that is ready and has counted something."""

    def __init__(self, name, rate_hz):
        self.name, self.state = name, DeviceState.READY
        self.identity = Identity("Touchdown", "stand-in", "0001", "1")
        self.rate_hz, self.received, self.lost = rate_hz, 1, 0
        self.poses = SampleStream("arm", 3, 100)
        self.mode, self.width_mm = RobotMode.READY, 24.0
        self.turn_rad = (0.0, 0.0, 0.0)

    def pose(self, max_age_s):
        _, at_mm = self.poses.latest(0.0, float("inf"))
        return Pose(*at_mm.tolist(), *self.turn_rad)

    @property
    def health(self):
        return Health(self.rate_hz, 0.012, self.received, self.lost)

    def status(self):
        closed = self.state is DeviceState.CLOSED
        if self.name == "arm" and closed:
            return ArmStatus(RobotMode.DISCONNECTED, SafetyMode.UNKNOWN, 0.0, 0)
        if self.name == "arm":
            return ArmStatus(self.mode, SafetyMode.NORMAL, 1.0, 0)
        return GripStatus(self.width_mm, 10.0, not closed)

    def describe(self):
        return {}


class StandInEngine:
    """Keeps the orders."""

    def __init__(self, bench):
        self._bench, self.orders = bench, []

    def pause(self):
        self.orders.append("pause")
        self._bench.set_state(RunState.PAUSED)

    def resume(self):
        self.orders.append("resume")
        self._bench.set_state(RunState.RUNNING)

    def cancel(self):
        self.orders.append("cancel")
        self._bench.set_state(RunState.IDLE)


class StandInBench:
    """Satisfies ``touchdown.backend.bench.Session``."""

    simulated = True
    description = BenchDescription(mode="simulated")
    identity, method = BenchIdentity("stand-in"), StackSettings()
    name, limits_source, connection, run_id = "", "the program itself", None, "run"
    usual, hand, model, dataset = SceneChoice(), None, None, None
    calibrations = guard = None
    degraded = ()
    drift = None

    def __init__(self):
        self.events, self.interlock, self.catalogue = EventBus(), Interlock(), load_pieces()
        self.repaint_hold, self.prompt, self.run_folder = RepaintHold(), OperatorPrompt(), None
        self.frames = {f: Stream(f"tactile_{f}", 8) for f in FINGERS}
        self.fields = {f: Stream(f"markers_{f}", 8) for f in FINGERS}
        self.wrench = SampleStream("wrench", 6, 20_000)
        self.engine = StandInEngine(self)
        self.pace, self.still_s = 1.0, 0.0
        rates = {"arm": 100.0, "gripper": 20.0, "force_torque": 1000.0,
                 "tactile_left": 25.0, "tactile_right": 25.0}  # fmt: skip
        self.devices = {name: StandInDevice(name, rate) for name, rate in rates.items()}
        self.decisions, self.silent = [], set[str]()
        self.started, self.answers, self.stops, self.resets = [], [], 0, 0
        self.opened = self.closed = False
        self._status = RunStatus(RunState.IDLE)
        self._now_us = self._trial = 0
        self._rng = np.random.default_rng(3)
        self.press = 0.0
        # The face in the frame of the bench: offset under load, height at contact and in air.
        self.at_mm, self.contact_z_mm, self.clear_mm = None, 24.0, 3.0
        self._background = {f: _gel(1 if f == "left" else 2) for f in FINGERS}

    # -- Link -------------------------------------------------------------------------------------

    def clock_s(self):
        return self._now_us * 1e-6

    def status(self):
        return self._status

    def set_state(self, state, **more):
        self._status = replace(self._status, state=state, **more)

    def start(self, request):
        if self.interlock.latched:
            raise RefusedError("LATCHED", "The bench is stopped: press Reset first.")
        self.started.append(request)
        self.set_state(RunState.RUNNING)

    @property
    def day_checks(self):
        return Session.day_checks.fget(self)

    def change_limits(self, limits, person):
        self.interlock.change_limits(limits, self.clock_s())

    def stop(self):
        self.stops += 1
        self.interlock.stop()
        self.set_state(RunState.IDLE, awaiting=None)

    def reset(self):
        self.resets += 1
        self.interlock.reset()
        self.events.publish(FaultsReset(self.clock_s()))

    def answer(self, yes):
        self.answers.append(yes)

    def guard_of(self, method):
        return self.guard if method.strategy == "fused" else None

    def decide(self, decision):
        self.decisions.append(decision)

    def open(self):
        self.opened = True

    def close(self):
        self.closed = True

    # -- time -------------------------------------------------------------------------------------

    def turn(self, seconds):
        """Move on: 1 kHz wrench, 25 Hz frames."""
        for _ in range(round(seconds * 25)):
            t0 = self.clock_s()
            self._now_us += 40_000
            t_s = t0 + 0.001 * np.arange(1, 41)
            values = self._rng.normal(0, [0.1, 0.1, 0.1, 0.004, 0.004, 0.004], (40, 6))
            values += self.press * np.array([0.9, -0.6, 7.8, 0.04, -0.07, 0.01])
            self.wrench.put(t_s, values)
            x, y = self.at_mm or (4.0 - 1.5 * self.press, 1.0)
            z = self.contact_z_mm + self.clear_mm * (1 - self.press)
            self.devices["arm"].poses.put(t_s[-1:], np.array([[x, y, z]]))
            for name, device in self.devices.items():
                device.received += name not in self.silent
            for finger in FINGERS:
                self._put_frame(finger)

    def _put_frame(self, finger):
        sign = 1.0 if finger == "left" else -1.0
        away = (REST - (160.0, 120.0)) / 160.0
        shift = self.press * np.stack([1.5 + 2.5 * away[:, 1] * sign, -4.0 - 3.0 * away[:, 0]], 1)
        state = np.zeros(63, dtype=np.uint8)
        state[[5, 17]] = 1
        field = MarkerField(finger, 1, self.clock_s(), REST + shift, shift, state, 0.98)
        image = self._background[finger].copy()
        for x, y in np.rint(REST + shift).astype(int):
            image[max(y - 4, 0) : y + 5, max(x - 4, 0) : x + 5] = 30
        self.fields[finger].put(self.clock_s(), field)
        stream = self.frames[finger]
        stream.put(self.clock_s(), TactileFrame(finger, stream.count, self.clock_s(), image))

    # -- facts ------------------------------------------------------------------------------------

    def tell_start(self, piece="pot", bottom="short", trials=3):
        """Announce a run and its first trial."""
        t = self.clock_s()
        self.events.publish(RunStarted(t, "run", piece, bottom, "paper", 7, trials, True, "{}"))
        self.tell_trial(1)

    def tell_trial(self, trial):
        """Announce a trial."""
        self._trial = trial
        self.events.publish(TrialStarted(self.clock_s(), trial, 6 + trial, (7.2, 3.1)))

    def tell_probe(self, probe, offset, margin):
        """Announce all that is known after a probe at ``offset``."""
        t, publish = self.clock_s(), self.events.publish
        publish(PhaseEntered(t, "press", probe))
        points = np.mgrid[-12:13, -12:13].reshape(2, -1).T.astype(float)
        publish(PatchEstimated(t, ContactPatch(points, np.full(len(points), 0.4)), offset, probe))
        publish(BeliefUpdated(t, belief(probe, offset), probe))
        publish(StabilityJudged(t, stability(offset, margin), probe))
        publish(ActionChosen(t, action(offset, margin), probe, 4.2))
        words = f"contact on 38 % of the face. Verdict {signed_mm(margin)}."
        publish(Said(t, f"Probe {probe}: {words}"))

    def tell_end(self, outcome=Outcome.PLACED, margin=1.6):
        """Announce release and the end of the trial."""
        t = self.clock_s()
        self.events.publish(Released(t, 3, outcome is Outcome.PLACED, margin, None))
        stands = outcome is Outcome.PLACED
        reason = f"The piece {'stands' if stands else 'tips'}, {abs(margin):.1f} mm "
        reason += f"{'inside' if margin > 0 else 'outside'} its support."
        self.events.publish(
            TrialFinished(t, self._trial, 6 + self._trial, outcome, reason, 3, 0, margin)
        )

    def tell_finish(self):
        """Announce the end of the run."""
        self.events.publish(RunFinished(self.clock_s(), "run", "finished", ""))

    def tell_fault(self, code="FT-TRIP"):
        """Latch and announce a fault."""
        fault = Fault(code, "Force trip: 41.3 N over 40 N.",
                      "The arm draws back by 2 mm; the gripper was not opened.",
                      "Check the piece and the support, then press Reset.",
                      "force_torque")  # fmt: skip
        self.interlock.raise_fault(fault)
        self.events.publish(FaultRaised(self.clock_s(), fault))


def belief(probes, offset):
    """A belief map: support near the true bottom, seen where the face has been."""
    axis = np.arange(-32.0, 33.0)
    x, y = np.meshgrid(axis, axis)
    inside = 10.0 - np.hypot(x - 0.4, y + 0.3)
    covered = np.hypot(x - offset[0], y - offset[1]) < 12.7
    for k in range(1, probes):
        covered |= np.hypot(x - offset[0] - 2.6 * k, y - offset[1] - 1.1 * k) < 12.7
    log_odds = np.where(covered, np.clip(1.6 * inside * probes / 2, -8, 8), 0.0)
    return BeliefMap(log_odds, covered, (-32.0, -32.0), 1.0, probes)


def stability(offset, margin):
    """A hull in the overlap of bottom and face."""
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    hull = np.stack([0.6 * offset[0] + 7 * np.cos(turn), 0.6 * offset[1] + 8 * np.sin(turn)], 1)
    return Stability(margin > 0, margin, SupportKind.AREA, hull, offset, "belief")


def action(offset, margin):
    """Release inside the hull, else step towards it."""
    if margin > 0:
        reason = f"The centre of mass is {margin:.1f} mm inside the support: release here."
        return PlaceAction("release", (0.0, 0.0), None, False, reason)
    reason = f"The centre of mass is {-margin:.1f} mm outside the support."
    length = float(np.hypot(*offset))
    step = (-3.0 * offset[0] / length, -3.0 * offset[1] / length)
    return PlaceAction("shift", step, (0.3, -0.2), True, reason)


@cache
def _gel(seed):
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[0:240, 0:320]
    image = np.stack([90 + 40 * np.sin(u / 90.0), 95 + 40 * np.cos(v / 70.0),
                      100 + 30 * np.sin((u + v) / 120.0)], axis=-1)  # fmt: skip
    return np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)
