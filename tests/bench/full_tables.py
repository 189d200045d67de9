"""How long the full tables take: a part of every kind of their jobs, for one piece."""

from __future__ import annotations

import tempfile
import time
from collections import defaultdict
from pathlib import Path

from tests.bench.registry import Figure, figure
from touchdown.backend.config.simulation import load_simulation
from touchdown.backend.experiments.job_kinds import KINDS
from touchdown.backend.experiments.tables import FULL, PIECES, Recipe, Scale
from touchdown.backend.jobs.job import JobStore, run_job
from touchdown.backend.learning.training import use_one_thread

PART = Scale("part", FULL.probes, epochs=2, groups=20, trials=5, pictured=100, repeated=2)
TIMES = {
    "train": FULL.epochs / PART.epochs,
    "static": FULL.groups / PART.groups,
    "stack": FULL.trials / PART.trials,
    "devices": FULL.repeated / PART.repeated,
    "twins": FULL.pictured / PART.pictured,
}
"""How much more of a kind of job the full tables do; all other kinds are done whole."""
WORKERS, LIMIT_H = 2, 2.0


@figure("experiments")
def tables_in_full() -> list[Figure]:
    """Processor time of the parts, scaled; fixed costs are scaled with them, which is too much."""
    use_one_thread()
    spent_s: dict[str, float] = defaultdict(float)
    recipe = Recipe(PART, load_simulation(preset="bench-v1"), "bench", pieces=("mushroom",))
    with tempfile.TemporaryDirectory() as folder:
        store = JobStore(Path(folder))
        for spec in recipe.jobs():
            began_s = time.process_time()
            result = run_job(spec, KINDS, store)
            assert result.state == "done", result.error
            spent_s[spec.kind] += time.process_time() - began_s
    whole_h = {
        kind: len(PIECES) * seconds * TIMES.get(kind, 1.0) / 3600.0
        for kind, seconds in spent_s.items()
    }
    total_h = sum(whole_h.values())
    note = ", ".join(f"{kind} {hours:.2f}" for kind, hours in whole_h.items())
    return [
        Figure("full tables, processor time", total_h, "h", "stated", None, f"{note} h"),
        Figure(
            "full tables, two workers that share it evenly", total_h / WORKERS, "h",
            f"<= {LIMIT_H:g}", total_h / WORKERS <= LIMIT_H, "from parts",
        ),
    ]  # fmt: skip
