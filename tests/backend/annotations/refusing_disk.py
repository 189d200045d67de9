"""Recorder whose n-th disk call of a kind fails, calls of SQLite included: ``python -m`` it FOLDER.

``disk_refusals.c`` must be preloaded. Prints one JSON object: calls refused by kind, and the
violated promises.
"""

from __future__ import annotations

import ctypes
import json
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

from tests.backend.annotations.conftest import context_for
from tests.backend.annotations.crash_trials import Known, forked, record_one, told, verify
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.core.faults import TouchdownError

# kinds of calls, in the order of disk_refusals.c, and which of them are refused: every n-th
KINDS = {"synchronising": 1, "writing": 25, "writing half": 25, "renaming": 1, "creating": 1}
# episodes recorded after the refusal was armed; more calls than there are of a kind
EPISODES, LIMIT = 2, 400


def _scenario(place: Path, kind: int, nth: int, tell: Callable[[str], None]) -> None:
    """Record and label in spite of a refusal; report what was acknowledged."""
    library = ctypes.CDLL(None)
    with Dataset.open(place, person="cleo") as dataset:
        context = context_for(dataset)
        library.arm(kind, nth)
        for seed in range(EPISODES + 1):
            # The disk works again: the last call must succeed.
            last = seed == EPISODES
            if last:
                tell(f"met {library.was_refused()} - -\n")
                library.arm(-1, 0)
            try:
                record_one(dataset, tell, seed, context)
            except TouchdownError as error:
                if last:
                    tell(f"stuck {type(error).__name__} {str(error).replace(' ', '_')} -\n")
        tell("end - - -\n")


def _one(place: Path, kind: int, nth: int) -> tuple[bool, list[str]]:
    """Return whether the call was refused, and the violated promises."""
    known, met, ended, wrong = Known(), False, False, list[str]()
    Dataset.open(place).close()
    pid, out = forked(lambda tell: _scenario(place, kind, nth, tell))
    for line in told(out):
        word, second, *_ = line.split()
        met = met or (word == "met" and second == "1")
        ended = ended or word == "end"
        if word == "stuck":
            wrong.append(line.strip())
        elif word in ("episode", "label"):
            known.take(line)
    os.waitpid(pid, 0)
    if not ended:
        wrong.append("an error of no known kind ended it")
    if len(known.episodes) < EPISODES:
        wrong.append("cost more than one episode")
    return met, wrong + verify(place, known)


def refuse_all(folder: Path) -> dict[str, object]:
    """Refuse calls of every kind until there is no n-th one."""
    refused, wrong = dict.fromkeys(KINDS, 0), list[str]()
    for kind, (name, step) in enumerate(KINDS.items()):
        for nth in range(1, LIMIT + 1, step):
            place = folder / f"{kind}-{nth}"
            met, found = _one(place, kind, nth)
            wrong += [f"{name} {nth}: {what}" for what in found]
            shutil.rmtree(place)
            if not met and not found:
                break
            refused[name] += 1
    return {"refused": refused, "wrong": wrong}


if __name__ == "__main__":
    sys.stdout.write(json.dumps(refuse_all(Path(sys.argv[1]))) + "\n")
