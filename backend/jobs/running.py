"""Run one job: a pure function of its spec and of the results it names as inputs."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from backend.core.faults import InputError, TouchdownError
from backend.jobs.spec import JobSpec
from backend.jobs.store import JobStore


@dataclass(frozen=True, slots=True)
class Workplace:
    """Where a job works: ``folder`` for files it leaves, ``store`` to read its inputs from."""

    folder: Path
    store: JobStore


Work = Callable[[JobSpec, Workplace], Mapping[str, Any]]
"""Does one kind of job and returns its answer (JSON values). A top-level function, so that other
processes find it by its name."""
Kinds = Mapping[str, Work]


@dataclass(frozen=True, slots=True)
class JobResult:
    """How a job ended; ``error`` says why it failed. Answers are read from the store."""

    id: str
    kind: str
    state: Literal["done", "failed"]
    seconds: float = 0.0
    error: str = ""


def run_job(spec: JobSpec, kinds: Kinds, store: JobStore) -> JobResult:
    """Do the job unless it is done already; an error of its function is a failed result."""
    if store.has(spec.id):
        return JobResult(spec.id, spec.kind, "done")
    began_s = time.monotonic()
    try:
        if spec.kind not in kinds:
            known = ", ".join(sorted(kinds))
            raise InputError(f"There is no job '{spec.kind}'.", spec.id, f"Use one of: {known}.")
        with store.writing(spec) as folder:
            answer = kinds[spec.kind](spec, Workplace(folder, store))
            store.finish(spec, folder, answer)
    except TouchdownError as error:
        return JobResult(spec.id, spec.kind, "failed", time.monotonic() - began_s, str(error))
    except Exception:  # noqa: BLE001 - one bad job must not end a campaign of thousands
        why = traceback.format_exc(limit=-3)
        return JobResult(spec.id, spec.kind, "failed", time.monotonic() - began_s, why)
    return JobResult(spec.id, spec.kind, "done", time.monotonic() - began_s)
