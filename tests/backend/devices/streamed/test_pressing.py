"""A press counts its depth from where the arm touched, not from where its command was by then."""

import numpy as np
import pytest

from touchdown.backend.devices.protocols import ArmPress, PressCommand
from touchdown.backend.devices.streamed.arm import PressProgram
from touchdown.backend.devices.streamed.compliance import LoopDelays, admittance_law
from touchdown.backend.devices.streamed.motion_programs import CycleInput

SURFACE_MM, SPRING_N_MM = 20.0, 3.0
AIR_N = np.array([0.5, -0.8, -14.0])
"""What the untared wrist reads in air."""
COMMAND = PressCommand(1.5, 1.0, 2.0, 4.0, 1.0, 10.0, (30.0, 25.0, 15.0))


@pytest.mark.parametrize(("cycle_s", "arm_lag_s"), [(0.0035, 0.01), (0.02, 0.05)])
def test_the_depth_counts_from_the_touch_whatever_the_delay_of_the_loop(cycle_s, arm_lag_s):
    """The arm follows its command two cycles and a lag later: that is up to 0.36 mm."""
    loop = LoopDelays(cycle_s, arm_lag_s=arm_lag_s)
    late_s = loop.dead_cycles * cycle_s + arm_lag_s
    law = admittance_law(loop, COMMAND.stiffness_n_mm)
    before_s = np.arange(-0.6, 0.0, 0.001)
    motion = ArmPress({})
    press = PressProgram(motion, COMMAND, law, loop, (before_s, np.tile(AIR_N, (600, 1))))
    sent_s, sent_mm = [0.0], [np.array([4.0, -6.0, 25.0])]
    now_s = 0.0
    while not motion.done:
        t_s = np.arange(now_s, now_s + cycle_s, 0.001)
        now_s += cycle_s
        there_mm = np.interp(t_s - late_s, sent_s, [place[2] for place in sent_mm])
        force_n = np.tile(AIR_N, (len(t_s), 1))
        force_n[:, 2] += SPRING_N_MM * np.maximum(SURFACE_MM - there_mm, 0.0)
        felt = CycleInput(now_s, cycle_s, sent_mm[-1], sent_mm[-1], t_s, force_n)
        sent_mm.append(press.next_mm(felt))
        sent_s.append(now_s)
    motion.result()
    assert press.compliance is not None
    reference_mm = press.compliance.reference_mm
    assert reference_mm[:2] == pytest.approx((4.0, -6.0))
    assert reference_mm[2] == pytest.approx(SURFACE_MM - COMMAND.depth_mm, abs=0.02)
