"""What is evidence that an arm stands: never one place alone."""

import math

import numpy as np
import pytest

from touchdown.backend.core.streams import SampleStream
from touchdown.backend.devices.interlock import recent_positions_mm, travelled_mm


def told(*rows):
    poses = SampleStream("arm", 3, 4096)
    t_s, z_mm = np.array(rows, dtype=float).reshape(-1, 2).T
    poses.put(t_s, np.column_stack([np.zeros_like(z_mm), np.zeros_like(z_mm), z_mm]))
    return poses


@pytest.mark.parametrize(
    ("rows", "travel_mm"),
    [
        ([], math.nan),
        ([(9.9, 60.0)], math.nan),  # told once: it may be on its way
        ([(9.1, 60.0), (9.15, 60.0)], math.nan),  # too long ago
        ([(9.5, 60.2), (9.7, 60.0), (9.99, 60.0)], 0.0),  # ten times a second: the last two
        ([(9.7, 60.2), (9.9, 60.0)], 0.2),
        ([(9.79, 61.0), *((t, 60.0) for t in np.arange(9.81, 10.0, 0.0035))], 0.0),
        ([*((t, 60.0 + (t > 9.9)) for t in np.arange(9.7, 10.0, 0.0035))], 1.0),
        ([(9.9, math.nan), (9.95, 60.0)], math.nan),
    ],
)
def test_the_last_two_places_at_least_tell_how_far_an_arm_moved(rows, travel_mm):
    found = travelled_mm(recent_positions_mm(told(*rows), 10.0))
    assert found == pytest.approx(travel_mm, nan_ok=True)
