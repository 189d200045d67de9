"""Random faults of every device on the wire: a few here, hundreds in the figures."""

import pytest

from tests.backend.devices import trials_camera, trials_gripper, trials_wrist


@pytest.mark.promise("S1")
@pytest.mark.parametrize("kind", sorted(trials_wrist.EMULATED))
def test_a_wrist_sensor_ends_as_documented(kind):
    ended = trials_wrist.trial(sorted(trials_wrist.EMULATED).index(kind), kind)
    assert ended.broken == (), ended


@pytest.mark.parametrize("seed", range(8))
def test_a_gripper_ends_as_documented(seed):
    ended = trials_gripper.trial(seed)
    assert ended.broken == (), ended


@pytest.mark.parametrize("seed", range(10))
def test_a_camera_ends_as_documented(seed):
    ended = trials_camera.trial(seed)
    assert ended.broken == (), ended
