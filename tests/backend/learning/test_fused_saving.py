"""Checkpoints of the fusion network: complete on disk, or refused."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.backend.learning.fused.fused_writer import NAME, write
from touchdown.backend.core.faults import InputError
from touchdown.backend.learning.fused.checkpoint import load_fused

WRITER = [sys.executable, "-m", "tests.backend.learning.fused.fused_writer"]
ROOT = Path(__file__).parents[3]
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals and limits of POSIX")


@pytest.mark.parametrize("writes", [1, 2])
def test_killed_at_any_time_it_is_whole_or_refused(tmp_path: Path, writes: int) -> None:
    with subprocess.Popen(
        [*WRITER, str(tmp_path), "kill"], stdout=subprocess.PIPE, cwd=ROOT
    ) as child:
        assert child.stdout is not None
        for _ in range(writes):
            assert child.stdout.readline()
        child.kill()
    refused = ""
    try:
        found = load_fused(tmp_path / NAME)
    except InputError as error:
        refused = str(error)
    else:
        values = {float(v) for array in found.arrays.values() for v in np.unique(array)}
        assert values == {float(found.card.seed)}
    assert not refused or NAME in refused
    write(tmp_path, 1)
    assert load_fused(tmp_path / NAME).card.seed == 1


def test_weights_of_one_and_the_card_of_another_are_refused(tmp_path: Path) -> None:
    """As a kill between the two files leaves them."""
    write(tmp_path, 1)
    weights = (tmp_path / NAME).read_bytes()
    write(tmp_path, 2)
    (tmp_path / NAME).write_bytes(weights)
    with pytest.raises(InputError, match=r"not those of their card"):
        load_fused(tmp_path / NAME)


def test_a_disk_that_takes_no_more_leaves_the_former_network(tmp_path: Path) -> None:
    write(tmp_path, 1)
    refused = subprocess.run(
        [*WRITER, str(tmp_path), "full"], capture_output=True, text=True, check=False, cwd=ROOT
    )
    assert refused.returncode != 0
    assert "File too large" in refused.stderr
    assert load_fused(tmp_path / NAME).card.seed == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fused.json", NAME]
