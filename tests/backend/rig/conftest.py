"""A connected rig in this process, and the reason of a refusal."""

import pytest

from tests.backend.rig.hosted import Hosted


@pytest.fixture
def rig():
    made = Hosted()
    yield made.connected()
    made.close()
