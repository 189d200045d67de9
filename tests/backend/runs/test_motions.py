"""Release evidence consists of measurements at that moment, without assumed values."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from touchdown.backend.config.method import StackSettings
from touchdown.backend.core.streams import SampleStream
from touchdown.backend.devices.interlock import ReleaseEvidence
from touchdown.backend.devices.protocols import GripStatus
from touchdown.backend.runs.motions import release_evidence

NOW_S, JUDGED_S = 10.0, 8.75


def evidence(tare_s: float = 4.0, width_mm: float = 20.0, accepted: bool = True) -> ReleaseEvidence:
    """Wrench and poses of the last second; the fingers tell ``width_mm``, 20 mm before."""
    t_s = NOW_S - 1.0 + 0.01 * np.arange(101)
    wrench, poses = SampleStream("wrench", 6, 200), SampleStream("poses", 3, 200)
    wrench.put(t_s, np.tile([0.3, -0.4, 1.1, 0.01, -0.02, 0.03], (101, 1)))
    poses.put(t_s, np.array([5.0, -7.0, 30.0]) + np.outer(t_s - NOW_S, [0.1, -0.2, 0.05]))
    episode = SimpleNamespace(
        recording=None, onset_s=7.0, quality=SimpleNamespace(accepted=accepted)
    )
    bench: Any = SimpleNamespace(
        now_s=lambda: NOW_S,
        gripper=SimpleNamespace(status=lambda: GripStatus(width_mm, 9.0, True)),
        sensing=SimpleNamespace(wrench=wrench, tare_s=tare_s),
        arm=SimpleNamespace(poses=poses),
        settings=StackSettings(),
        wrench_late_s=0.005,
    )
    judged: Any = SimpleNamespace(
        pressed=SimpleNamespace(episode=episode),
        stability=SimpleNamespace(stable=True, margin_mm=1.25),
        at_s=JUDGED_S,
    )
    return release_evidence(bench, judged, 20.0, approved=True)


def test_all_of_it_is_read() -> None:
    found = evidence()
    assert (found.verdict_stable, found.quality_accepted, found.holding) == (True, True, True)
    assert (found.margin_mm, found.verdict_age_s) == (1.25, 1.25)
    assert found.press_n == pytest.approx(1.1)
    assert found.wrench_age_s == pytest.approx(0.0, abs=1e-9)
    assert found.wrench_age_limit_s == pytest.approx(0.02)
    assert found.moved_mm == pytest.approx(0.04, abs=2e-3)
    assert not evidence(accepted=False).quality_accepted


@pytest.mark.parametrize(("tare_s", "last"), [(JUDGED_S - 0.01, True), (JUDGED_S + 0.01, False)])
def test_a_verdict_from_before_the_last_tare_is_not_of_the_last_probe(
    tare_s: float, last: bool
) -> None:
    assert evidence(tare_s=tare_s).verdict_of_last_probe is last


def test_the_width_counts_from_the_grasp() -> None:
    assert evidence(width_mm=20.4).width_change_mm == pytest.approx(0.4)
    assert evidence(width_mm=19.9).width_change_mm == pytest.approx(-0.1)
