"""Trials without ground truth: set up, started beside the stable region, judged by the operator."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.backend.brisk import brisk_bench, brisk_method
from touchdown.backend.bench.assembly import simulated_session
from touchdown.backend.cli.connection import parse_outcome
from touchdown.backend.core.events import (
    Event,
    FaultRaised,
    HandOverAwaited,
    OutcomeAwaited,
    PhaseEntered,
    RunFinished,
    SetUpAwaited,
    TrialFinished,
)
from touchdown.backend.core.values import Outcome
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.geometry.tower import Tower, judge_tower
from touchdown.backend.runs.outcome import outcome_from_signals
from touchdown.backend.runs.recorder import RecordingOptions
from touchdown.backend.runs.requests import StackRequest

POT = load_pieces().piece("pot")
HEAVY = replace(POT, mass_g=200.0)


class Attended:
    """Simulated bench that hides its truth, with an operator who answers."""

    def __init__(self, tmp_path, seen=(Outcome.PLACED, ""), faults=()):
        bench, keep = (
            brisk_bench("quiet", faults=faults),
            RecordingOptions(tmp_path, episodes=False),
        )
        self.session = simulated_session(bench, keep=keep, method=brisk_method())
        make = self.session._make_stage
        self.stages = []

        def blind(choice, raw):
            self.stages.append(make(choice, raw))
            return replace(self.stages[-1], scoring=None)

        self.session._make_stage = blind
        self.seen, self.ready, self.facts, self.asks = seen, True, list[Event](), []
        self.session.events.subscribe(self._answer)

    def _answer(self, fact: Event) -> None:
        self.facts.append(fact)
        if isinstance(fact, SetUpAwaited | HandOverAwaited):
            self.asks.append((self.session.status().asks, self.session.hand.holding))
            if self.ready is not None:
                self.session.answer(self.ready)
        elif isinstance(fact, OutcomeAwaited):
            self.asks.append((self.session.status().asks, self.session.hand.holding))
            self.session.prompt.see(*self.seen)

    def run(self, **asked):
        self.session.run(StackRequest(piece="pot", bottoms=("short",), seed=7, **asked))
        self.session.close()
        return self.of(TrialFinished)

    def of(self, kind):
        return [fact for fact in self.facts if isinstance(fact, kind)]


@pytest.mark.slow
def test_a_trial_is_set_up_started_where_it_would_fall_and_judged_by_the_operator(tmp_path):
    attended = Attended(tmp_path, (Outcome.KNOCKED_OVER, "I bumped into it."))
    (finished,) = attended.run(origin_mm=(1.0, -2.0))
    (asked,) = attended.of(SetUpAwaited)
    assert attended.asks == [
        ("set the scene", False), ("a hand at the jaws", False), ("say the outcome", False)
    ]  # fmt: skip
    # The static judge, asked here once more: the piece would fall from where it starts.
    at = Tower((load_pieces().piece("short").body(),)).with_top(POT.body(asked.start_mm))
    assert judge_tower(at).margin_mm < 0
    pressed = next(f for f in attended.facts if isinstance(f, PhaseEntered) and f.phase == "press")
    poses = attended.session.raw.poses.window(0.0, pressed.t_s).values
    assert poses[-1, :2] == pytest.approx(np.add(asked.start_mm, (1.0, -2.0)), abs=0.2)
    assert finished.outcome is Outcome.KNOCKED_OVER
    assert finished.reason == "The operator saw the bottom disturbed. I bumped into it."
    assert (finished.margin_mm, finished.excess_probes) == (None, None)
    # What the signals said agrees with the truth that the bench keeps to itself.
    (proposal,) = attended.of(OutcomeAwaited)
    assert (proposal.proposed is Outcome.PLACED) == attended.stages[-1].scoring.verdict().stands


def test_without_a_set_scene_nothing_moves(tmp_path):
    attended = Attended(tmp_path)
    attended.ready = False
    (finished,) = attended.run(trials=3)
    assert finished.outcome is Outcome.ABORTED
    assert attended.of(PhaseEntered) == []
    assert attended.of(RunFinished)[-1].ending == "cancelled"


@pytest.mark.promise("S10")
@pytest.mark.parametrize(
    ("fault", "code", "asked"),
    [
        ("force_torque:nan@1.5", "FT-STALE", True),
        ("tactile_left:stop@1.5", "CAMERA-STALE", True),
        ("force_torque:nan@3.5", "FT-STALE", False),
        ("force_torque:stop@3.5", "FT-STALE", False),
    ],
)
def test_a_device_lost_while_the_scene_is_set_up_ends_the_run_before_a_probe(
    tmp_path, fault, code, asked
):
    """While the operator is prompted, or while the piece is carried to its start."""
    attended = Attended(tmp_path, faults=(fault,))
    attended.ready = None if asked else True
    (finished,) = attended.run(trials=3)
    assert finished.outcome is Outcome.ABORTED
    (raised,) = attended.of(FaultRaised)
    assert raised.fault.code == code
    assert attended.of(RunFinished)[-1].ending == "failed"
    phases = [fact.phase for fact in attended.of(PhaseEntered)]
    assert not {"approach", "press", "release"} & set(phases)
    # Nothing moved for the hand that was at the bench; what was taken over stays held.
    assert phases == [] if asked else "grip" in phases
    assert attended.session.devices["gripper"].status().holding is not asked


def test_starts_follow_from_the_seed_and_differ(tmp_path):
    drawn = []
    for seed in (7, 8, 7):
        attended = Attended(tmp_path / str(len(drawn)))
        attended.ready = False
        attended.session.run(StackRequest(piece="pot", bottoms=("short",), seed=seed))
        attended.session.close()
        drawn.append(attended.of(SetUpAwaited)[0].start_mm)
    assert drawn[0] == drawn[2] != drawn[1]


@pytest.mark.parametrize(
    ("piece", "side_n", "left_n", "holding", "outcome"),
    [
        (HEAVY, 0.3, 1.9, False, Outcome.PLACED),
        (HEAVY, 3.0, 1.9, False, Outcome.FELL),
        (HEAVY, 0.3, 0.2, False, Outcome.ABORTED),
        (HEAVY, 0.3, 1.9, True, Outcome.ABORTED),
        (POT, 0.3, -0.1, False, Outcome.PLACED),
        (HEAVY, float("nan"), 1.9, False, Outcome.FELL),
    ],
)
def test_wrist_and_gripper_propose(piece, side_n, left_n, holding, outcome):
    found, why = outcome_from_signals(piece, side_n=side_n, left_n=left_n, holding=holding)
    assert found is outcome
    assert why.endswith(".")


ASKED = OutcomeAwaited(0.0, Outcome.PLACED, "Nothing pushed.")
STUCK = OutcomeAwaited(0.0, Outcome.ABORTED, "It hangs.")


@pytest.mark.parametrize(
    ("line", "asked", "said"),
    [
        ("\n", ASKED, (Outcome.PLACED, "")),
        ("\n", STUCK, (Outcome.ABORTED, "It hangs.")),
        ("F it leaned\n", ASKED, (Outcome.FELL, "it leaned")),
        ("d\n", ASKED, (Outcome.KNOCKED_OVER, "")),
        ("v wrong piece\n", ASKED, (Outcome.ABORTED, "wrong piece")),
        ("v\n", ASKED, None),
        ("yes\n", ASKED, None),
    ],
)
def test_a_line_says_what_was_seen(line, asked, said):
    assert parse_outcome(line, asked) == said
