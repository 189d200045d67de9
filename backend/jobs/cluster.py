"""Execution of jobs on a Dask cluster, local or at an address.

Requires the optional extra ``cluster``.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

from touchdown.backend.core import InputError, require_package
from touchdown.backend.jobs.job import JobFunctions, JobResult, JobSpec, JobStore, run_job

JOBS_AHEAD = 2  # jobs submitted per worker thread, so that none is idle


class DaskCluster:
    """Runs jobs through ``dask.distributed``; all workers must have access to the store."""

    def __init__(self, kinds: JobFunctions, store: JobStore, client: Any) -> None:
        self._kinds, self._store, self._client = kinds, store, client
        self._running: dict[Any, JobSpec] = {}

    @classmethod
    def at(cls, kinds: JobFunctions, store: JobStore, address: str) -> DaskCluster:
        """Connect to the scheduler ``address`` (tcp://host:8786); raises ``InputError``."""
        distributed: Any = require_package("distributed", "cluster")
        try:
            return cls(kinds, store, distributed.Client(address, timeout="10s"))
        except (OSError, ValueError) as error:
            raise InputError(
                f"No Dask scheduler answers: {error}.", address, "Check the address."
            ) from error

    def room(self) -> int:
        """Return the number of jobs to submit: a few per thread of the cluster."""
        threads = sum(int(n) for n in self._client.nthreads().values())
        return JOBS_AHEAD * max(1, threads) - len(self._running)

    def submit(self, spec: JobSpec) -> None:
        """Submit the job; the scheduler repeats it if a worker dies."""
        future = self._client.submit(
            run_job, spec, self._kinds, self._store, key=f"{spec.kind}-{spec.id}", retries=2
        )
        self._running[future] = spec

    def finished(self) -> list[JobResult]:
        """Wait for at least one job."""
        wait = import_module("distributed").wait

        ended = wait(list(self._running), return_when="FIRST_COMPLETED").done
        results = []
        for future in ended:
            spec = self._running.pop(future)
            error = future.exception()
            if error is None:
                results.append(future.result())
            else:
                results.append(JobResult(spec.id, spec.kind, "failed", error=repr(error)))
        return results

    def close(self) -> None:
        """Cancel the running jobs and disconnect."""
        self._client.cancel(list(self._running))
        self._running.clear()
        self._client.close()
