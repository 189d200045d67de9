"""The parent's side of a training in its own process."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from types import TracebackType
from typing import Self

from backend.core.faults import Fault, FaultError, InputError
from backend.learning.job import REPORT, Cancelled, Epoch, Finished, Loaded, Refused, TrainingJob

EXIT_WAIT_S = 10.0
IDLE_THREADS = {"OMP_WAIT_POLICY": "PASSIVE"}
"""Threads sleep while they wait for each other. Spinning, as is usual, two of them took 9 times the
processor time of one beside other work; asleep 1.04 times."""


class TrainingProcess:
    """Runs one job at low priority; leave the ``with`` block and the child is gone.

    ``reports`` may be read on one thread while ``cancel`` is called on another.
    """

    def __init__(self, job: TrainingJob) -> None:
        self._complaints = tempfile.TemporaryFile()  # noqa: SIM115 - closed by close()
        environment = IDLE_THREADS | os.environ
        self._child = subprocess.Popen(
            [sys.executable, "-m", "backend.learning.process"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._complaints,
            env=environment,
            text=True,
            encoding="utf-8",
        )
        self._send(job.model_dump_json())

    @property
    def number(self) -> int:
        """Number of the process."""
        return self._child.pid

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        self.close()

    def reports(self) -> Iterator[Loaded | Epoch | Finished | Cancelled]:
        """Yield what the child says until it ends.

        Raises ``InputError`` for what it refused, ``FaultError`` if it died.
        """
        assert self._child.stdout is not None
        last: object = None
        for line in self._child.stdout:
            report = REPORT.validate_json(line)
            if isinstance(report, Refused):
                raise InputError(report.what, report.where, report.fix)
            last = report
            yield report
        self._child.wait(EXIT_WAIT_S)
        if not isinstance(last, Finished | Cancelled):
            raise FaultError(self._death())

    def cancel(self) -> None:
        """Ask the child to stop after the present batch; whole epochs are kept for a resume."""
        self._send("cancel")

    def kill(self) -> None:
        """End the child at once: what it does since the last whole epoch is lost."""
        self._child.kill()

    def close(self) -> None:
        """End the child, whatever it does, and wait for it."""
        for pipe in (self._child.stdin, self._child.stdout):
            if pipe is not None:
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()
        try:
            self._child.wait(EXIT_WAIT_S)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()
        self._complaints.close()

    def _send(self, line: str) -> None:
        assert self._child.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._child.stdin.write(line + "\n")
            self._child.stdin.flush()

    def _death(self) -> Fault:
        self._complaints.seek(0)
        said = self._complaints.read().decode("utf-8", "replace").strip().splitlines()
        why = said[-1] if said else f"exit code {self._child.returncode}"
        return Fault(
            "TRAINING-DIED",
            f"The training process ended early: {why}.",
            "There is no new model; whole epochs are kept.",
            "Free memory if it ran short, then train again with --resume.",
        )
