"""The plan of a comparison of strategies: which trials its jobs hold."""

from __future__ import annotations

import pytest

from touchdown.backend.config.simulation import load_simulation
from touchdown.backend.experiments.strategies import ClosedLoopComparison


@pytest.mark.parametrize(("bottom", "trials"), [("long", 5), ("short+long", 23)])
def test_no_two_trials_of_a_cell_have_the_same_seed(bottom: str, trials: int) -> None:
    plan = ClosedLoopComparison(
        load_simulation(preset="bench-v1"), "1", {"pot": "m", "barrel": "m"}, ("pot", "barrel"),
        (bottom,), ("paper",), trials,
    )  # fmt: skip
    cells: dict[str, list[int]] = {"pot": [], "barrel": []}
    for job in plan.jobs():
        cells[job.params["piece"]] += range(job.seed, job.seed + job.params["trials"])
    for seeds in cells.values():
        assert seeds == list(range(seeds[0], seeds[0] + trials))
    assert not set(cells["pot"]) & set(cells["barrel"])
