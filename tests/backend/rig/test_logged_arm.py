"""The log of an emulated arm that figures of starved rigs are judged by sees a burst as one."""

import numpy as np
import pytest

from tests.bench.children.logged_arm import ahead_of
from touchdown.backend.devices.melfa.realtime_protocol import CYCLE_S


@pytest.mark.promise("P4")
def test_what_was_missed_and_is_made_up_is_a_burst_and_one_late_command_is_none():
    grid_s = 1e3 + CYCLE_S * np.arange(100.0)
    assert ahead_of(np.array([])) == 0.0
    assert ahead_of(grid_s) == pytest.approx(0.0, abs=1e-6)
    late_s = grid_s.copy()
    late_s[50] += 0.99 * CYCLE_S
    assert 0.9 < ahead_of(late_s) <= 1.0
    skipped_s = np.delete(late_s, range(30, 50))
    assert ahead_of(skipped_s) == ahead_of(late_s)
    made_up_s = grid_s.copy()
    made_up_s[30:50] = grid_s[50] - 1e-4
    assert ahead_of(made_up_s) > 15.0
