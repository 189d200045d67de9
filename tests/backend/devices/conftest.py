"""The devices that a test of the contract is asked of."""

import pytest

from tests.backend.devices.contract_bench import DevicesUnderTest


@pytest.fixture
def bench(request: pytest.FixtureRequest) -> DevicesUnderTest:
    made: DevicesUnderTest = request.param()
    return made
