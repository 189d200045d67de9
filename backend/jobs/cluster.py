"""Execution of jobs on a cluster: through Dask, or as job arrays of Slurm.

Dask requires the optional extra ``cluster``. A task of a job array calls ``main`` of this module.
"""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import Any

from touchdown.backend.core import (
    InputError,
    disk_errors,
    errors_as_input,
    parse_json,
    require_package,
    write_atomically,
)
from touchdown.backend.jobs.execution import MAX_WORKER_DEATHS, THREAD_VARIABLES
from touchdown.backend.jobs.job import JobFunctions, JobResult, JobSpec, JobStore, run_job

JOBS_AHEAD = 2  # jobs submitted per worker thread, so that none is idle


class DaskCluster:
    """Runs jobs through ``dask.distributed``; all workers must have access to the store."""

    def __init__(self, kinds: JobFunctions, store: JobStore, client: Any) -> None:
        # Workers may have another working folder.
        self._kinds, self._store = kinds, JobStore(store.root.resolve())
        self._client = client
        self._running: dict[Any, JobSpec] = {}

    @classmethod
    def at(cls, kinds: JobFunctions, store: JobStore, address: str) -> DaskCluster:
        """Connect to the scheduler ``address`` (tcp://host:8786); raises ``InputError``."""
        distributed: Any = require_package("distributed", "cluster")
        said, fix = "No Dask scheduler answers", "Check the address."
        with errors_as_input(said, address, fix, OSError, ValueError):
            return cls(kinds, store, distributed.Client(address, timeout="10s"))

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


MAX_ARRAY = 1000  # tasks of a job array; Slurm allows 1001 unless configured otherwise
ONE_THREAD = ",".join(f"{name}=1" for name in THREAD_VARIABLES)
NOT_QUEUED = "Invalid job id"


def call_slurm(words: Sequence[str]) -> str:
    """Return the output of a command of Slurm; raises ``InputError`` with its message."""
    fix = "Run on a computer that submits jobs."
    with errors_as_input("Slurm is not available", words[0], fix, OSError):
        done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        raise InputError(
            f"Slurm refused: {done.stderr.strip()}.", words[0], "Correct this, then run again."
        )
    return done.stdout


class SlurmArrays:
    """Runs jobs as job arrays of Slurm; all nodes must have access to the store and the program.

    Partition, account and time are set by the variables of ``sbatch`` (``SBATCH_PARTITION`` ...).
    A job whose task left the queue without a result for ``gone_s`` is submitted again, at most
    ``MAX_WORKER_DEATHS`` times; the results on a shared disk may come late.
    """

    def __init__(
        self,
        kinds: JobFunctions,
        store: JobStore,
        call: Callable[[Sequence[str]], str] = call_slurm,
        look_s: float = 1.0,
        gone_s: float = 15.0,
    ) -> None:
        self._kinds, self._store, self._call = kinds, store, call
        self._look_s, self._gone_s = look_s, gone_s
        call(["sbatch", "--version"])
        with disk_errors("The folder of the jobs cannot be used", store.root, "Name another one."):
            store.root.mkdir(parents=True, exist_ok=True)
            self._folder = Path(tempfile.mkdtemp(prefix=".slurm-", dir=store.root)).resolve()
        self._waiting: list[JobSpec] = []
        # jobs and the files of their ends, by task, such as "12_3"
        self._running: dict[str, tuple[JobSpec, Path]] = {}
        self._gone: dict[str, float] = {}
        self._deaths: Counter[str] = Counter()

    def room(self) -> int:
        """Return the number of jobs to submit: none until half an array is free."""
        free = MAX_ARRAY - len(self._running) - len(self._waiting)
        return free if 2 * free >= MAX_ARRAY else 0

    def submit(self, spec: JobSpec) -> None:
        """Keep the job for the next array."""
        self._waiting.append(spec)

    def finished(self) -> list[JobResult]:
        """Submit the waiting jobs as one array, then wait for at least one job."""
        while True:
            if self._waiting:
                self._submit_array()
            if results := self._look():
                return results
            if not self._waiting:
                threading.Event().wait(self._look_s)

    def close(self) -> None:
        """Cancel the tasks in the queue."""
        if self._running:
            self._call(["scancel", *self._arrays()])
        shutil.rmtree(self._folder, ignore_errors=True)

    def _submit_array(self) -> None:
        specs, root = self._waiting, self._store.root.resolve()
        kinds = {k: f"{call.__module__}:{call.__qualname__}" for k, call in self._kinds.items()}
        jobs = [spec.canonical() for spec in specs]
        tasks = json.dumps({"store": str(root), "kinds": kinds, "jobs": jobs})
        with disk_errors("The tasks cannot be written", root, "Free some space; run again."):
            folder = Path(tempfile.mkdtemp(dir=self._folder))
            write_atomically(folder / "tasks.json", tasks.encode())
        code = f"from {__name__} import main; main()"
        command = shlex.join(["exec", sys.executable, "-c", code, str(folder / "tasks.json")])
        number = self._call([
            "sbatch", "--parsable", "--job-name=touchdown", f"--array=0-{len(specs) - 1}",
            f"--output={folder}/%a.log", f"--export=ALL,{ONE_THREAD}", f"--wrap={command}",
        ]).strip().partition(";")[0]  # fmt: skip
        self._waiting = []
        for index, spec in enumerate(specs):
            self._running[f"{number}_{index}"] = spec, folder / f"{index}.json"

    def _look(self) -> list[JobResult]:
        queued, results, now_s = self._queued(), list[JobResult](), time.monotonic()
        for task, (spec, end) in list(self._running.items()):
            if end.is_file():
                results.append(JobResult(**parse_json(end.read_bytes())))
            elif task in queued or now_s - self._gone.setdefault(task, now_s) < self._gone_s:
                continue
            elif self._deaths[spec.id] < MAX_WORKER_DEATHS:
                self._deaths[spec.id] += 1
                self._waiting.append(spec)
            else:
                why = f"Its task ended {MAX_WORKER_DEATHS + 1} times without a result: {task}."
                results.append(JobResult(spec.id, spec.kind, "failed", error=why))
            del self._running[task]
        return results

    def _arrays(self) -> list[str]:
        return sorted({task.partition("_")[0] for task in self._running})

    def _queued(self) -> set[str]:
        words = ["squeue", "--noheader", "--array", "--format=%i", "--jobs"]
        try:
            return set(self._call([*words, ",".join(self._arrays())]).split())
        except InputError as error:  # the controller does not answer now, or knows no such array
            return set() if NOT_QUEUED in error.what else set(self._running)


def run_task(path: Path, index: int) -> JobResult:
    """Run task ``index`` of the file of a job array, and write its end beside the file."""
    tasks = parse_json(path.read_bytes())
    spec = JobSpec.parse(tasks["jobs"][index])
    module, _, function = tasks["kinds"].get(spec.kind, "").partition(":")
    kinds = {spec.kind: getattr(import_module(module), function)} if module else {}
    result = run_job(spec, kinds, JobStore(Path(tasks["store"])))
    write_atomically(path.with_name(f"{index}.json"), json.dumps(asdict(result)).encode())
    return result


def main() -> None:
    """Run the task of this process: its file is the first argument."""
    run_task(Path(sys.argv[1]), int(os.environ["SLURM_ARRAY_TASK_ID"]))
