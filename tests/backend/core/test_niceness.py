"""Work in bulk steps back to one place, from wherever it was started."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from backend.core.niceness import NICENESS

TWICE = """
import os
from backend.core.niceness import step_back
os.nice(5)
step_back()
step_back()
print(os.nice(0))
"""


@pytest.mark.skipif(os.name != "posix", reason="only there is a niceness")
def test_what_has_stepped_back_already_does_not_step_back_again() -> None:
    told = subprocess.run([sys.executable, "-c", TWICE], capture_output=True, text=True, check=True)
    assert int(told.stdout) == max(NICENESS, min(os.nice(0) + 5, 19))
