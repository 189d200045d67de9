"""Positions of a campaign's probes relative to its origin, and the items that count as done."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from touchdown.backend.calibration.applied import UNCALIBRATED
from touchdown.backend.config.method import StackSettings
from touchdown.backend.core.values import Pose
from touchdown.backend.episodes.quality import count_coverage
from touchdown.backend.geometry.outlines import circle
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.runs.bench import PendingDecision
from touchdown.backend.runs.campaign import Campaign
from touchdown.backend.runs.collector import BottomOrigin, Collector

SEEN = count_coverage(np.empty((0, 2)), circle(15.0), circle(25.0))


class Reached(Exception):  # noqa: N818
    """Raised with the first target of the arm."""


def collector(*entries: Any) -> Collector:
    campaign = Campaign("c", "pot", "circle25", "random", 2, 5, skipped=(4,))
    return Collector(campaign, None, PendingDecision(), SEEN, list(entries))  # type: ignore[arg-type]


def test_a_probe_goes_to_its_displacement_from_the_origin() -> None:
    ordered: list[Pose] = []

    def move_to(place: Pose, speed_mm_s: float) -> None:
        ordered.append(place)
        raise Reached

    bench: Any = SimpleNamespace(
        settings=StackSettings(),
        piece=load_pieces().top("pot"),
        placed=UNCALIBRATED,
        real_time=False,
        arm=SimpleNamespace(move_to=move_to),
    )
    origin = BottomOrigin(10.0, -4.0, 0.1)
    with pytest.raises(Reached):
        list(collector()._probe(bench, 0, (1.5, -2.25), origin, 21.0))
    above_mm = StackSettings().probe.start_height_mm
    assert ordered == [Pose(11.5, -6.25, 21.0 + above_mm)]


def test_what_was_deleted_or_rejected_is_neither_done_nor_left_out() -> None:
    def entry(item: int, accepted: bool, deleted: bool) -> Any:
        return SimpleNamespace(
            plan_item=item, quality=SimpleNamespace(accepted=accepted), deleted=deleted
        )

    resumed = collector(
        entry(0, accepted=True, deleted=False),
        entry(1, accepted=True, deleted=True),
        entry(2, accepted=False, deleted=False),
        entry(3, accepted=True, deleted=False),
    )
    assert resumed.done == 2
    assert list(resumed.todo) == [1, 2]
