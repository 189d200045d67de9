"""Random faults in random motions: a few here, hundreds in the figures."""

import pytest

from tests.backend.devices.melfa.trials import trial


@pytest.mark.promise("R5", "R7")
@pytest.mark.parametrize("seed", range(3))
def test_whatever_goes_wrong_ends_as_documented(seed):
    ended = trial(seed)
    assert ended.broken == (), ended
