"""A Dask cluster gives the numbers of one process (needs the extra ``cluster``)."""

from __future__ import annotations

import warnings

import pytest

from tests.backend.jobs.sample_kinds import KINDS
from touchdown.backend.jobs import DaskCluster, JobSpec, JobStore, SerialExecutor, run_campaign

pytestmark = [pytest.mark.optional, pytest.mark.slow]


@pytest.mark.allow_leaks
def test_two_dask_workers_give_the_numbers_of_one_process(tmp_path):
    distributed = pytest.importorskip("distributed")
    draws = [JobSpec("draw", {"n": 5}, seed) for seed in range(5)]
    total = JobSpec("add", inputs=tuple(spec.id for spec in draws))
    specs = [*draws, total, JobSpec("refuse")]
    alone, shared = JobStore(tmp_path / "1"), JobStore(tmp_path / "2")
    list(run_campaign(specs, SerialExecutor(KINDS, alone), alone))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=None
        ) as cluster:
            dask = DaskCluster.at(KINDS, shared, cluster.scheduler_address)
            results = list(run_campaign(specs, dask, shared))
    assert [r.kind for r in results if r.state == "failed"] == ["refuse"]
    for spec in [*draws, total]:
        assert shared.result(spec.id) == alone.result(spec.id)
