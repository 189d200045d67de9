"""The devices that a test of the contract is asked of."""

from collections.abc import Iterator

import pytest

from tests.backend.devices.contract_bench import DevicesUnderTest


@pytest.fixture
def bench(request: pytest.FixtureRequest) -> Iterator[DevicesUnderTest]:
    made: DevicesUnderTest = request.param()
    yield made
    made.close()
