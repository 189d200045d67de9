"""Fixtures of the window: one shows at once what is to be shown, others start quickly."""

import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.prompt_window import prompt
from tests.warm import WarmChild, WarmStart

__all__ = ["prompt"]


@pytest.fixture(scope="session")
def open_window() -> Iterator[Callable[[list[str], Path], WarmChild]]:
    """Return a function that opens the window of ``annotator`` for the parts to play."""
    module = "tests.journeys.annotator"
    warm = WarmStart(module)
    warm.connected()

    def start(parts: list[str], log: Path) -> WarmChild:
        with log.open("w") as errors:
            return warm.popen([sys.executable, "-m", module, *parts], env=os.environ, stderr=errors)

    yield start
    warm.close()
