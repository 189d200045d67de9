"""Without a jig the operator hands the piece over; the jaws move only after confirmation."""

from __future__ import annotations

import shutil
from collections.abc import Callable

import pytest

from tests.backend.brisk import brisk_bench, brisk_method
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.bench.assembly import simulated_session
from touchdown.backend.bench.session import Session
from touchdown.backend.core.events import (
    Event,
    HandOverAwaited,
    MountingAwaited,
    PhaseEntered,
    RunFinished,
)
from touchdown.backend.runs.campaign import newest_campaign, read_campaign
from touchdown.backend.runs.recorder import RecordingOptions
from touchdown.backend.runs.requests import CollectRequest


def collected(dataset: Dataset, answer: Callable[[Event], bool], **asked):
    """Collect by hand-over; return the session, the events, and the times of the prompts."""
    session: Session = simulated_session(
        brisk_bench("quiet"), keep=RecordingOptions(None), method=brisk_method()
    )
    session.dataset = dataset
    facts: list[Event] = []
    session.events.subscribe(facts.append)
    asked_of: list[tuple[str, bool]] = []

    def hold(fact: Event) -> None:
        if isinstance(fact, MountingAwaited):
            asked_of.append((f"fitted since {fact.mounting}", session.hand.holding))
            session.answer(answer(fact))
        elif isinstance(fact, HandOverAwaited):
            what = "fit anew" if fact.anew else "give" if fact.gives else "take"
            asked_of.append((what, session.hand.holding))
            session.answer(answer(fact))

    session.events.subscribe(hold)
    session.run(CollectRequest(seed=2, person="ann", hand_over=True, **asked))
    session.close()
    return session, facts, asked_of


@pytest.mark.slow
def test_each_grip_is_handed_over_and_taken_back(tmp_path) -> None:
    answers = iter([True, True, True, True, False])
    with Dataset.open(tmp_path / "ds", person="ann") as dataset:
        session, facts, asked_of = collected(
            dataset, lambda _: next(answers), count=2, probes_per_grip=1
        )
        # Asked with open jaws before they close, and with the piece held before they open.
        # Between two mountings somebody has to fit bottom and gels: the program says so.
        assert asked_of == [
            ("give", False), ("take", True), ("fit anew", False), ("give", False), ("take", True)
        ]  # fmt: skip
        # Nobody took it the last time: the jaws stay closed, and nothing is lost.
        assert facts[-1].ending == "cancelled"
        assert session.hand.holding
        entries = dataset.episodes()
        assert len({entry.grip_id for entry in entries}) == 2
        assert len({entry.series for entry in entries}) == 2
        # 0.05 mm arm, 0.1 mm origin, and 0.5 mm of the hand instead of 0.1 mm of a jig.
        assert {dataset.labels.head(e.uuid).label.sigma_um for e in entries} == {512}


def test_the_jaws_do_not_close_on_a_no(tmp_path) -> None:
    with Dataset.open(tmp_path / "ds", person="ann") as dataset:
        session, facts, _ = collected(dataset, lambda _: False, count=1)
        assert isinstance(facts[-1], RunFinished)
        assert facts[-1].ending == "cancelled"
        assert not session.hand.holding
        assert [f.phase for f in facts if isinstance(f, PhaseEntered)] == ["shift"]
        assert dataset.episodes() == []


@pytest.fixture(scope="module")
def broken_off(tmp_path_factory):
    """Return a dataset whose campaign ended after the first of two grips."""
    folder = tmp_path_factory.mktemp("broken-off") / "ds"
    with Dataset.open(folder, person="ann") as dataset:
        answers = iter([True, True, False])
        collected(dataset, lambda _: next(answers), count=2, probes_per_grip=1)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("anew", [False, True])
def test_a_campaign_that_goes_on_asks_whether_bottom_and_gels_were_fitted_anew(
    broken_off, tmp_path, anew
) -> None:
    """Splits go by mounting: a restart without refitting must not begin another one."""
    shutil.copytree(broken_off, tmp_path / "ds")
    with Dataset.open(tmp_path / "ds", person="ann") as dataset:
        uuid = newest_campaign(dataset.folder)
        assert read_campaign(dataset.folder, uuid).mountings == 1
        answers = iter([anew, True, True])
        _, facts, asked_of = collected(
            dataset, lambda _: next(answers), campaign=uuid, probes_per_grip=1
        )
        # Asked before anything is handed over or moves.
        assert [what for what, _ in asked_of] == ["fitted since 1", "give", "take"]
        moves = [type(fact) for fact in facts]
        assert moves.index(MountingAwaited) < moves.index(PhaseEntered)
        assert facts[-1].ending == "finished"
        first, second = dataset.episodes()
        assert (first.series == second.series) is not anew
        assert (first.mounting_id == second.mounting_id) is not anew
        assert first.grip_id != second.grip_id
        number, grip = (2, 1) if anew else (1, 2)
        assert second.grip_id == f"{uuid}/mounting-{number}/grip-{grip}"
        assert read_campaign(dataset.folder, uuid).mountings == number
