"""Jobs: equal specifications have one id, results are complete or absent, nothing runs twice."""

from __future__ import annotations

import errno
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import warnings
from collections.abc import Sequence
from concurrent.futures import process
from contextlib import suppress
from pathlib import Path
from unittest import mock

import numpy as np
import psutil
import pytest

from tests.backend.devices.waiting import until
from tests.backend.jobs.sample_kinds import KINDS
from touchdown.backend.core import write_atomically
from touchdown.backend.core.faults import InputError
from touchdown.backend.core.scheduling import NICENESS
from touchdown.backend.jobs import DaskCluster, SlurmArrays, cluster
from touchdown.backend.jobs.cluster import NOT_QUEUED, run_task
from touchdown.backend.jobs.execution import (
    MAX_WORKER_DEATHS,
    Executor,
    ProcessPool,
    SerialExecutor,
    independent_jobs,
    parse_shard,
    run_campaign,
    shard_of,
)
from touchdown.backend.jobs.job import RESULT_FILE, JobResult, JobSpec, JobStore, run_job
from touchdown.backend.jobs.sources import ROOT, source_files, source_hash


def draws(count: int) -> list[JobSpec]:
    return [JobSpec("draw", {"n": 5}, seed) for seed in range(count)]


def numbers(store: JobStore, specs: list[JobSpec]) -> list[float]:
    return [float(store.result(spec.id)["sum"]) for spec in specs]


def run(specs: list[JobSpec], executor: Executor, store: JobStore) -> dict[str, JobResult]:
    return {result.id: result for result in run_campaign(specs, executor, store)}


def test_the_name_of_the_reference_job():
    spec = JobSpec("simulate", {"pair": ["Pot", "circle15"], "n": 50}, 7, (), "1.0.0")
    assert spec.canonical() == (
        '{"code":"1.0.0","inputs":[],"kind":"simulate",'
        '"params":{"n":50,"pair":["Pot","circle15"]},"seed":7}'
    )
    assert spec.id == "ba22d47cd86cd1759532ae5c1083af87"


def test_every_part_of_a_spec_is_in_its_name():
    specs = [
        JobSpec("a"),
        JobSpec("b"),
        JobSpec("a", {"x": 1}),
        JobSpec("a", {"x": 2}),
        JobSpec("a", seed=1),
        JobSpec("a", inputs=("1",)),
        JobSpec("a", code="2"),
    ]
    assert len({spec.id for spec in specs}) == len(specs)
    assert all(JobSpec.parse(spec.canonical()).id == spec.id for spec in specs)


def test_a_spec_without_a_number_has_no_name():
    with pytest.raises(ValueError, match="not JSON compliant"):
        assert JobSpec("a", {"x": float("nan")}).id


def test_a_finished_job_is_not_done_again_and_a_damaged_result_is_named(tmp_path):
    store, spec = JobStore(tmp_path), draws(1)[0]
    assert run_job(spec, KINDS, store).state == "done"
    path = store.folder(spec.id) / RESULT_FILE
    path.write_text(json.dumps({"sum": 42.0}))
    assert run_job(spec, KINDS, store).state == "done"
    assert store.result(spec.id) == {"sum": 42.0}
    assert np.load(store.folder(spec.id) / "values.npy").shape == (5,)
    path.write_text("{")
    with pytest.raises(InputError, match="no readable result"):
        store.result(spec.id)


def test_a_failed_job_leaves_nothing_and_says_why(tmp_path):
    store, spec = JobStore(tmp_path), JobSpec("refuse")
    result = run_job(spec, KINDS, store)
    assert result.state == "failed"
    assert "Never mind" in result.error
    assert list(tmp_path.iterdir()) == []
    assert "no job kind 'unheard'" in run_job(JobSpec("unheard"), KINDS, store).error


def test_a_campaign_respects_inputs_and_survives_a_failure(tmp_path):
    store, parts = JobStore(tmp_path), draws(3)
    total = JobSpec("add", inputs=tuple(spec.id for spec in parts))
    bad = JobSpec("refuse")
    lost = JobSpec("add", inputs=(bad.id,))
    results = run([lost, total, bad, *parts], SerialExecutor(KINDS, store), store)
    assert store.result(total.id)["sum"] == pytest.approx(sum(numbers(store, parts)))
    assert {k for k, result in results.items() if result.state == "failed"} == {bad.id, lost.id}
    assert bad.id in results[lost.id].error


def test_a_resumed_campaign_does_only_what_is_missing(tmp_path):
    store, specs = JobStore(tmp_path), draws(4)
    first = run_campaign(specs, SerialExecutor(KINDS, store), store)
    for _ in range(2):
        next(first)
    first.close()
    before = {p.name: p.stat().st_mtime_ns for p in tmp_path.iterdir()}
    assert len(before) == 2
    assert len(run(specs, SerialExecutor(KINDS, store), store)) == 4
    after = {p.name: p.stat().st_mtime_ns for p in tmp_path.iterdir()}
    assert before.items() <= after.items()
    assert len(after) == 4


def test_two_processes_give_the_numbers_of_one(tmp_path):
    specs = draws(6)
    alone, shared = JobStore(tmp_path / "1"), JobStore(tmp_path / "2")
    run(specs, SerialExecutor(KINDS, alone), alone)
    told = JobSpec("threads")
    results = run([*specs, told], ProcessPool(KINDS, shared, 2), shared)
    assert all(result.state == "done" for result in results.values())
    assert numbers(alone, specs) == numbers(shared, specs)
    assert shared.result(told.id)["omp"] == "1"
    if os.name == "posix":
        # Started by one that has stepped back itself, it does not fall behind all others.
        assert shared.result(told.id)["nice"] == max(NICENESS, os.nice(0))


def test_a_killed_worker_loses_no_finished_job(tmp_path):
    store = JobStore(tmp_path / "store")
    mortal = JobSpec("die", {"diary": str(tmp_path / "diary"), "times": 1})
    specs = [*draws(3), mortal]
    results = run(specs, ProcessPool(KINDS, store, 2), store)
    assert {result.state for result in results.values()} == {"done"}
    assert store.result(mortal.id)["deaths"] == 1
    assert len(numbers(store, draws(3))) == 3
    # The pool ends the other worker too when one dies: it may leave a half-written job as well.
    assert store.sweep() in (1, 2)
    assert store.sweep() == 0


def test_a_job_swept_while_it_runs_gives_no_result_without_its_files(tmp_path):
    store, (spec,) = JobStore(tmp_path), draws(1)
    with store.writing(spec) as part:
        (part / "early").write_text("data")
        (tmp_path / ".slurm-left").mkdir()
        assert store.sweep() == 2
        write_atomically(part / "late", b"data")
        with pytest.raises(InputError, match="was deleted while it ran"):
            store.finish(spec, part, {})
    assert list(tmp_path.iterdir()) == []


CAMPAIGN = """
import sys
from pathlib import Path
from tests.backend.jobs.sample_kinds import KINDS
from touchdown.backend.jobs import JobSpec, JobStore, ProcessPool, run_campaign
store = JobStore(Path(sys.argv[1]))
list(run_campaign([JobSpec("orphan")], ProcessPool(KINDS, store, 1), store))
"""


@pytest.mark.skipif(os.name != "posix", reason="SIGKILL")
def test_workers_of_a_killed_program_end(tmp_path):
    folder = Path(__file__).parents[3]
    ended = subprocess.run(
        [sys.executable, "-c", CAMPAIGN, str(tmp_path)], cwd=folder, check=False, timeout=60
    )
    assert ended.returncode == -signal.SIGKILL
    worker = int((tmp_path / "worker").read_text())
    with suppress(psutil.NoSuchProcess):
        psutil.Process(worker).wait(30.0)


INTERRUPTED = CAMPAIGN.replace("orphan", "linger").replace("KINDS, store, 1", "KINDS, store, 2")


@pytest.mark.skipif(os.name != "posix", reason="process groups")
@pytest.mark.parametrize("busy", [False, True])
def test_an_interrupt_of_the_terminal_ends_workers_silently(busy, tmp_path):
    code = INTERRUPTED.replace("list(", "try: list(") + "except KeyboardInterrupt: sys.exit(130)"
    # A job in the background of a shell inherits an ignored SIGINT.
    code = f"import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n{code}"
    program = subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path)], cwd=Path(__file__).parents[3],
        start_new_session=True, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip

    def importing() -> bool:
        """Return True if a worker imports the program, which takes longer."""
        workers = [p for p in psutil.Process(program.pid).children() if "spawn" in str(p.cmdline())]
        return any(sum(worker.cpu_times()[:2]) > 0.05 for worker in workers)

    # A fast import may end between two looks.
    begun = (tmp_path / "worker").exists
    until(begun if busy else lambda: importing() or begun())
    os.killpg(program.pid, signal.SIGINT)
    _, said = program.communicate(timeout=60)
    assert (program.returncode, said) == (130, "")


def test_a_closed_pool_leaves_no_thread(tmp_path, monkeypatch):
    store, before = JobStore(tmp_path), set(threading.enumerate())
    kind = process._ExecutorManagerThread
    last_step = kind.join_executor_internals

    def late(thread):
        last_step(thread)
        threading.Event().wait(0.3)

    monkeypatch.setattr(kind, "join_executor_internals", late)
    found = run(draws(1), ProcessPool(KINDS, store, 1), store)  # which closes it
    assert {result.state for result in found.values()} == {"done"}
    assert set(threading.enumerate()) <= before


@pytest.mark.promise("P7", "P10")
def test_a_job_that_always_kills_its_worker_is_given_up(tmp_path):
    store = JobStore(tmp_path / "store")
    deadly = JobSpec("die", {"diary": str(tmp_path / "diary"), "times": 99})
    results = run([deadly], ProcessPool(KINDS, store, 1), store)
    assert results[deadly.id].state == "failed"
    assert f"died {MAX_WORKER_DEATHS + 1} times" in results[deadly.id].error
    assert (tmp_path / "diary").read_text() == "x" * (MAX_WORKER_DEATHS + 1)


def test_shards_are_a_partition(tmp_path):
    specs = draws(11)
    parts = [shard_of(specs, i, 3) for i in range(3)]
    assert sorted(s.id for part in parts for s in part) == sorted(s.id for s in specs)
    assert {len(part) for part in parts} <= {3, 4}
    assert shard_of(list(reversed(specs)), 1, 3) == parts[1]
    store = JobStore(tmp_path)
    total = JobSpec("add", inputs=(specs[0].id, specs[1].id))
    everything = [*specs, total]
    assert independent_jobs(everything, [total, specs[0]], store) == [specs[0]]
    for spec in specs[:2]:
        run_job(spec, KINDS, store)
    assert independent_jobs(everything, [total, specs[0]], store) == [total, specs[0]]


@pytest.mark.parametrize("text", ["", "1", "2/2", "-1/2", "1/0", "a/b", "0/"])
def test_a_bad_shard_is_bad_input(text):
    with pytest.raises(InputError, match="--shard"):
        parse_shard(text)
    assert parse_shard("1/2") == (1, 2)


def test_the_id_of_a_job_follows_its_sources(tmp_path: Path) -> None:
    """A copy of the sources: a module that the job needs changes its hash, no other one does."""
    copy = tmp_path / "backend"
    shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns("__pycache__"))
    asked = ("touchdown.backend.experiments.strategies", "run_closed_loop")

    def now() -> str:
        source_hash.cache_clear()  # but not what is parsed, which comments do not change
        return source_hash(*asked, copy)

    before = now()
    for unrelated in ("exchange/csv_tables.py", "cli/stack.py", "experiments/document.py"):
        with (copy / unrelated).open("a") as file:
            file.write("# changed\n")
    assert now() == before
    for needed in ("simulation/mechanics.py", "sensing/slip.py", "experiments/strategies.py"):
        with (copy / needed).open("a") as file:
            file.write("# changed\n")
        assert now() != before, needed
        before = now()
    piece = tmp_path / "resources" / "objects" / "short.toml"
    piece.parent.mkdir(parents=True)
    piece.write_text("height_mm = 1.0\n")
    assert now() != before


def test_only_what_a_function_uses_of_its_module_counts() -> None:
    module = "touchdown.backend.experiments.job_kinds"
    devices = source_files(module, "run_on_devices")
    assert "touchdown.backend.bench.assembly" in devices
    simulated = source_files(module, "simulate_collection")
    assert "touchdown.backend.simulation.batch" in simulated
    assert not any(name.startswith("touchdown.backend.bench") for name in simulated)
    # a package by its own name: learning.load_checkpoint
    loaded = source_files("touchdown.backend.experiments.models", "load_model")
    assert "touchdown.backend.learning.checkpoint" in loaded
    assert "touchdown.backend.learning.fitting" not in loaded


@pytest.mark.optional
@pytest.mark.slow
@pytest.mark.allow_leaks
def test_two_dask_workers_give_the_numbers_of_one_process(tmp_path: Path) -> None:
    """Needs the extra ``cluster``."""
    distributed = pytest.importorskip("distributed")
    apart = draws(5)
    total = JobSpec("add", inputs=tuple(spec.id for spec in apart))
    specs = [*apart, total, JobSpec("refuse")]
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
    for spec in [*apart, total]:
        assert shared.result(spec.id) == alone.result(spec.id)


def test_dask_workers_of_another_folder_write_to_the_store(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    client = mock.Mock()
    DaskCluster(KINDS, JobStore(Path("jobs")), client).submit(draws(1)[0])
    assert client.submit.call_args.args[-1] == JobStore(tmp_path / "jobs")


class FakeSlurm:
    """Runs the tasks of an array at once; tasks of the arrays ``lost`` end without a result."""

    def __init__(self, lost: int = 0, silent: int = 0) -> None:
        self.lost, self.silent, self.arrays, self.cancelled = lost, silent, 0, list[str]()

    def __call__(self, words: Sequence[str]) -> str:
        if words[0] == "squeue":
            self.silent -= 1
            raise InputError("Unable to contact" if self.silent >= 0 else NOT_QUEUED, "", "")
        if words[0] == "scancel":
            self.cancelled += words[1:]
        if words[0] != "sbatch" or "--version" in words:
            return ""
        self.arrays += 1
        options = dict(word.split("=", 1) for word in words if "=" in word)
        if self.arrays > self.lost:
            path = Path(shlex.split(options["--wrap"])[-1])
            for index in range(int(options["--array"].partition("-")[2]) + 1):
                run_task(path, index)
        return f"{self.arrays};cluster\n"


def test_job_arrays_give_the_numbers_of_one_process(tmp_path: Path) -> None:
    apart = draws(5)
    total = JobSpec("add", inputs=tuple(spec.id for spec in apart))
    specs = [*apart, total, JobSpec("refuse"), JobSpec("unknown")]
    alone, shared = JobStore(tmp_path / "1"), JobStore(tmp_path / "Ann's 2")
    list(run_campaign(specs, SerialExecutor(KINDS, alone), alone))
    slurm = FakeSlurm(lost=1, silent=2)
    results = list(run_campaign(specs, SlurmArrays(KINDS, shared, slurm, 0.0, 0.0), shared))
    assert sorted(r.kind for r in results if r.state == "failed") == ["refuse", "unknown"]
    assert "Bad." in next(r.error for r in results if r.kind == "refuse")
    assert [shared.result(s.id) for s in specs[:6]] == [alone.result(s.id) for s in specs[:6]]
    # one lost array, its repetition, and the job that waited for them
    assert slurm.arrays == 3
    assert sorted(p.name for p in shared.root.iterdir()) == sorted(s.id for s in specs[:6])


def test_a_task_that_never_leaves_a_result_is_given_up_and_the_queue_is_emptied(tmp_path) -> None:
    store = JobStore(tmp_path)
    slurm = FakeSlurm(lost=9)
    (end,) = run_campaign(draws(1), SlurmArrays(KINDS, store, slurm, 0.0, 0.0), store)
    assert (end.state, slurm.arrays) == ("failed", 3)
    assert "3 times" in end.error
    stopped = SlurmArrays(KINDS, store, slurm, 0.0, 0.0)
    stopped.submit(draws(1)[0])
    assert stopped.room() == 999
    stopped._submit_array()
    stopped.close()
    assert slurm.cancelled == ["4"]


def test_a_job_on_a_full_disk_names_the_disk(tmp_path) -> None:
    full = mock.Mock(side_effect=OSError(errno.ENOSPC, "No space left on device"))
    end = run_job(draws(1)[0], {"draw": full}, JobStore(tmp_path))
    free = "Free some space, then run the call again."
    assert end.error == f"No space left on device: {tmp_path}. {free}"


def test_tasks_on_a_full_disk_name_the_disk(tmp_path, monkeypatch) -> None:
    arrays = SlurmArrays(KINDS, JobStore(tmp_path), FakeSlurm(), 0.0, 0.0)
    monkeypatch.setattr(cluster, "write_atomically", mock.Mock(side_effect=OSError(28, "Full")))
    with pytest.raises(InputError, match="The tasks cannot be written: Full"):
        list(run_campaign(draws(1), arrays, JobStore(tmp_path)))


def test_without_slurm_the_command_that_is_missing_is_named(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match="Slurm is not available"):
        SlurmArrays(KINDS, JobStore(tmp_path))
