"""Kinds of jobs for tests; top-level functions, so that other processes find them."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from touchdown.backend.core.faults import InputError
from touchdown.backend.jobs.job import JobContext, JobSpec


def draw(spec: JobSpec, place: JobContext) -> Mapping[str, Any]:
    """Sum random numbers, and leave them as a file."""
    values = np.random.default_rng(spec.seed).standard_normal(int(spec.params["n"]))
    np.save(place.folder / "values.npy", values)
    return {"sum": float(values.sum())}


def add(spec: JobSpec, place: JobContext) -> Mapping[str, Any]:
    """Add the answers of the inputs."""
    return {"sum": sum(float(place.store.result(i)["sum"]) for i in spec.inputs)}


def die(spec: JobSpec, _: JobContext) -> Mapping[str, Any]:
    """Kill the worker the first ``times`` times."""
    diary = Path(str(spec.params["diary"]))
    lived = diary.read_text().count("x") if diary.exists() else 0
    if lived < int(spec.params["times"]):
        diary.write_text("x" * (lived + 1))
        os._exit(9)
    return {"deaths": lived}


def refuse(spec: JobSpec, place: JobContext) -> Mapping[str, Any]:
    """Fail half-way, after a file was written."""
    (place.folder / "half").write_text("half")
    raise InputError("Bad.", spec.id, "Never mind.")


def threads(_: JobSpec, __: JobContext) -> Mapping[str, Any]:
    """Return the thread variables and the niceness of the worker."""
    nice = os.nice(0) if os.name == "posix" else None
    return {"omp": os.environ.get("OMP_NUM_THREADS"), "nice": nice}


def orphan(spec: JobSpec, place: JobContext) -> Mapping[str, Any]:
    """Kill the parent process, and go on."""
    (place.store.root / "worker").write_text(str(os.getpid()))
    os.kill(os.getppid(), signal.SIGKILL)
    threading.Event().wait(60.0)
    return {}


def linger(spec: JobSpec, place: JobContext) -> Mapping[str, Any]:
    """Say that it runs, and go on."""
    (place.store.root / "worker").write_text(str(os.getpid()))
    threading.Event().wait(60.0)
    return {}


KINDS = {
    "draw": draw, "add": add, "die": die, "refuse": refuse, "threads": threads, "orphan": orphan,
    "linger": linger,
}  # fmt: skip
