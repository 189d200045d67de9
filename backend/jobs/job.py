"""A hashed job: its specification, its result on disk, and its execution.

A job is a pure function of its specification and of the results that it names as inputs. Equal
specifications have equal results and the same id. A job has one folder, complete or absent.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal, Self

from touchdown.backend import core

ID_DIGITS = 32


@dataclass(frozen=True)
class JobSpec:
    """Specification of a job: ``kind``, ``params`` (JSON values), ``seed`` and ``inputs``.

    ``inputs``: ids of the jobs, or hashes of the files, that the job reads. ``code``: version of
    the program. Immutable.
    """

    kind: str
    params: Mapping[str, Any] = field(default_factory=dict)
    seed: int = 0
    inputs: tuple[str, ...] = ()
    code: str = ""

    def canonical(self) -> str:
        """Return the canonical JSON text: sorted keys, no spaces, no NaN (ValueError)."""
        return json.dumps(asdict(self), sort_keys=True, separators=(",", ":"), allow_nan=False)

    @cached_property
    def id(self) -> str:
        """First 32 hex digits of the SHA-256 of the canonical text."""
        return sha256(self.canonical().encode()).hexdigest()[:ID_DIGITS]

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the spec of a canonical text; raises ValueError or KeyError for anything else."""
        facts = core.parse_json(text)
        return cls(
            kind=str(facts["kind"]),
            params=dict(facts["params"]),
            seed=int(facts["seed"]),
            inputs=tuple(facts["inputs"]),
            code=str(facts["code"]),
        )


RESULT_FILE = "result.json"
SPEC_FILE = "spec.json"
_PART_SUFFIX = ".part"


@dataclass(frozen=True, slots=True)
class JobStore:
    """Finished jobs below ``root``; processes may write different jobs concurrently."""

    root: Path

    def folder(self, job_id: str) -> Path:
        """Return the folder of a finished job."""
        return self.root / job_id

    def has(self, job_id: str) -> bool:
        """Return True if the job is finished."""
        return (self.folder(job_id) / RESULT_FILE).is_file()

    def result(self, job_id: str) -> dict[str, Any]:
        """Return the answer of a finished job; raises ``InputError`` naming a damaged file."""
        path = self.folder(job_id) / RESULT_FILE
        said, fix = "There is no readable result", "Delete the folder; run again."
        with core.errors_as_input(said, path, fix, OSError, ValueError):
            return dict(core.parse_json(path.read_bytes()))

    @contextmanager
    def writing(self, spec: JobSpec) -> Iterator[Path]:
        """Yield a folder for the job's files; it is deleted unless ``finish`` is called inside.

        Its name contains the process id, so that two processes can run the same job.
        """
        part = self.root / f".{spec.id}.{os.getpid()}{_PART_SUFFIX}"
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        try:
            core.write_atomically(part / SPEC_FILE, spec.canonical().encode())
            yield part
        finally:
            shutil.rmtree(part, ignore_errors=True)

    def finish(self, spec: JobSpec, part: Path, answer: Mapping[str, Any]) -> None:
        """Write the answer to the folder ``part`` and give it its final name.

        Raises ``InputError`` if the folder was swept meanwhile: it may lack files of the job.
        """
        if not (part / SPEC_FILE).is_file():
            what = "The folder of the job was deleted while it ran."
            raise core.InputError(what, str(part), "Run the job again.")
        text = json.dumps(answer, sort_keys=True, allow_nan=False)
        core.write_atomically(part / RESULT_FILE, text.encode())
        try:
            part.rename(self.folder(spec.id))
        except OSError:
            # Another process finished the same job first; its result is equal.
            if not self.has(spec.id):
                raise
        core.sync_folder(self.root)

    def sweep(self) -> int:
        """Delete folders of killed processes: unfinished jobs and job arrays; return their number.

        A process that still writes to one of them fails.
        """
        left = [*self.root.glob(f".*{_PART_SUFFIX}"), *self.root.glob(".slurm-*")]
        for part in left:
            shutil.rmtree(part, ignore_errors=True)
        return len(left)


@dataclass(frozen=True, slots=True)
class JobContext:
    """Resources of a running job: ``folder`` for its files, ``store`` with its inputs."""

    folder: Path
    store: JobStore


# Runs one kind of job and returns its answer (JSON values). A top-level function, so that other
# processes find it by name.
JobFunction = Callable[[JobSpec, JobContext], Mapping[str, Any]]
JobFunctions = Mapping[str, JobFunction]


@dataclass(frozen=True, slots=True)
class JobResult:
    """End of a job; ``error``: reason of a failure. Answers are read from the store."""

    id: str
    kind: str
    state: Literal["done", "failed"]
    seconds: float = 0.0
    error: str = ""


def run_job(spec: JobSpec, kinds: JobFunctions, store: JobStore) -> JobResult:
    """Run the job unless it is finished; an error of its function gives a failed result."""
    if store.has(spec.id):
        return JobResult(spec.id, spec.kind, "done")
    began_s = time.monotonic()
    try:
        if spec.kind not in kinds:
            known = ", ".join(sorted(kinds))
            raise core.InputError(
                f"There is no job kind '{spec.kind}'.", spec.id, f"Use one of: {known}."
            )
        with store.writing(spec) as folder:
            answer = kinds[spec.kind](spec, JobContext(folder, store))
            store.finish(spec, folder, answer)
    except core.TouchdownError as error:
        return JobResult(spec.id, spec.kind, "failed", time.monotonic() - began_s, str(error))
    except Exception as error:  # noqa: BLE001 - one bad job must not end a campaign of thousands
        why = traceback.format_exc(limit=-3)
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            why = f"{error.strerror}: {store.root}. Free some space, then run the call again."
        return JobResult(spec.id, spec.kind, "failed", time.monotonic() - began_s, why)
    return JobResult(spec.id, spec.kind, "done", time.monotonic() - began_s)
