"""Results on disk: one folder per job, named by the job, complete or not there."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from backend.core.faults import InputError
from backend.core.files import sync_folder, write_atomically
from backend.jobs.spec import JobSpec

RESULT = "result.json"
SPEC = "spec.json"
_PART = ".part"


@dataclass(frozen=True, slots=True)
class JobStore:
    """Finished jobs below ``root``; any number of processes may write different jobs to it."""

    root: Path

    def folder(self, job_id: str) -> Path:
        """Return the folder of a finished job."""
        return self.root / job_id

    def has(self, job_id: str) -> bool:
        """Whether the job is finished."""
        return (self.folder(job_id) / RESULT).is_file()

    def result(self, job_id: str) -> dict[str, Any]:
        """Return what a finished job answered; raises ``InputError`` naming the damaged file."""
        path = self.folder(job_id) / RESULT
        try:
            answer = json.loads(path.read_bytes())
        except (OSError, ValueError) as error:
            raise InputError(
                f"There is no readable result: {error}.", str(path), "Delete the folder; run again."
            ) from error
        return dict(answer)

    @contextmanager
    def writing(self, spec: JobSpec) -> Iterator[Path]:
        """Yield a folder for the job's files; ``finish`` it inside, else it is thrown away.

        The folder carries the process in its name, so that two processes that do the same job by
        accident do not disturb each other.
        """
        part = self.root / f".{spec.id}.{os.getpid()}{_PART}"
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        try:
            yield part
        finally:
            shutil.rmtree(part, ignore_errors=True)

    def finish(self, spec: JobSpec, part: Path, answer: Mapping[str, Any]) -> None:
        """Give the folder ``part`` its spec and answer, and its final name."""
        write_atomically(part / SPEC, spec.canonical().encode())
        text = json.dumps(answer, sort_keys=True, allow_nan=False)
        write_atomically(part / RESULT, text.encode())
        try:
            part.rename(self.folder(spec.id))
        except OSError:
            # Another process finished the same job first: its result is the same.
            if not self.has(spec.id):
                raise
        sync_folder(self.root)

    def sweep(self) -> int:
        """Delete what killed processes left half done; returns how much there was.

        Only while nobody writes to the store.
        """
        left = list(self.root.glob(f".*{_PART}"))
        for part in left:
            shutil.rmtree(part, ignore_errors=True)
        return len(left)
