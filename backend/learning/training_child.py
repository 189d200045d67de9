"""Child process of a training: ``python -m touchdown.backend.learning.training_child``.

Reads one JSON line with the job from standard input and writes JSON lines to standard output. A
further line, or the end of the input, cancels the training.
"""

from __future__ import annotations

import os
import sys
import threading
import traceback

from pydantic import BaseModel, ValidationError

from touchdown.backend.core import InputError, lower_priority
from touchdown.backend.learning.fitting import fit_model
from touchdown.backend.learning.training_process import TrainingJob, TrainingRefused


def _send(message: BaseModel) -> None:
    sys.stdout.write(message.model_dump_json() + "\n")
    sys.stdout.flush()


def main() -> int:
    """Run one job; return 0 when finished or cancelled, 2 for invalid input."""
    cancelled = threading.Event()
    try:
        job = TrainingJob.model_validate_json(sys.stdin.readline())
    except ValidationError as error:
        _send(TrainingRefused(what=f"Bad job: {error}", where="job", fix="Correct the job."))
        return 2

    def listen() -> None:
        sys.stdin.readline()
        cancelled.set()

    threading.Thread(target=listen, name="listen", daemon=True).start()
    lower_priority()
    try:
        fit_model(job, _send, cancelled.is_set)
    except InputError as error:
        _send(TrainingRefused(what=error.what, where=error.where, fix=error.fix))
        return 2
    return 0


if __name__ == "__main__":
    try:
        code = main()
    except Exception:  # noqa: BLE001 - the end of this process, whatever it was
        # Printed here: a regular exit of the interpreter takes seconds.
        traceback.print_exc()
        code = 1
    sys.stdout.flush()
    # The listener may hold the lock of standard input, which a regular exit would wait for.
    os._exit(code)
