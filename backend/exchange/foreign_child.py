"""Child process that opens foreign files.

Usage: ``python -m touchdown.backend.exchange.foreign_child KIND SRC DIR [MAPPING]``. Its standard
input ends when the parent is killed. It then deletes DIR and exits. KIND ``contents`` lists the
signals of a recording.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from importlib import import_module
from pathlib import Path

from touchdown.backend.core import InputError
from touchdown.backend.exchange.features import ForeignEpisode, save_foreign

READERS = {"lerobot": ("lerobot_reader", "read"), "contents": ("mapping", "read_contents")}
MEMORY_BYTES = 8_000_000_000

REMOVALS = 20  # tries to delete DIR, into which the reader may write meanwhile


def main(kind: str, source: str, folder: str, mapping: str = "") -> None:
    """Read all episodes; every error becomes one line of output."""
    if sys.platform != "win32":
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    watch = threading.Thread(target=_leave_with_parent, args=(folder,), daemon=True)
    watch.start()
    name, function = ("mapping", "read") if mapping else READERS[kind]
    read = getattr(import_module(f"touchdown.backend.exchange.{name}"), function)
    given = (kind, Path(source), Path(mapping)) if mapping else (Path(source),)
    try:
        episodes: Iterator[ForeignEpisode] = read(*given)
        for number, episode in enumerate(episodes):
            path = Path(folder) / f"{number:06d}.npz"
            save_foreign(episode, path)
            _tell({"episode": str(path)})
    except InputError as error:
        _tell({"error": error.what, "where": error.where, "fix": error.fix})
    except Exception as error:  # noqa: BLE001 - a foreign file may raise anything
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            fix = "Make room on it, or name a folder on another disk in TMPDIR."
            _tell({"error": "The disk of temporary files is full.", "where": folder, "fix": fix})
        else:
            what = f"The file is damaged or foreign: {type(error).__name__}: {error}."
            _tell({"error": what, "where": source, "fix": "Use another copy, or export it again."})
    else:
        _tell({"done": True})
    watch.join()  # DIR is in use until the parent ends this process


def _leave_with_parent(folder: str) -> None:
    os.read(0, 1)  # not sys.stdin, whose lock would hinder the end of the interpreter
    for _ in range(REMOVALS):
        shutil.rmtree(folder, ignore_errors=True)
        if not Path(folder).exists():
            break
    os._exit(1)


def _tell(answer: dict[str, object]) -> None:
    # If the parent was killed, the other thread still has to delete DIR.
    with suppress(BrokenPipeError):
        sys.stdout.write(json.dumps(answer) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main(*sys.argv[1:])
