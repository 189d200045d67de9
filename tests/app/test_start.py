"""What the window is started with."""

from pathlib import Path

import pytest

from touchdown import resources
from touchdown.app.__main__ import parser
from touchdown.app.start import open_bench
from touchdown.backend.core.faults import InputError

LAB = Path(resources.__path__[0]) / "benches" / "lab.toml"


def test_faults_on_demand_are_for_the_simulated_bench():
    args = parser().parse_args(["--inject", "arm:stall@3", "--inject", "gripper:stall@4"])
    assert args.inject == ["arm:stall@3", "gripper:stall@4"]
    with pytest.raises(InputError, match="Only the simulated bench"):
        open_bench(LAB, tuple(args.inject))


def test_a_fault_that_does_not_exist_is_named_before_the_bench_is_built():
    with pytest.raises(InputError, match="cup"):
        open_bench(None, ("cup:stop@3",))
